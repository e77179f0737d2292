"""Synthetic recordings: simulated motion, rendered images, encoded videos."""
