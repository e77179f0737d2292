"""Tracks over their videos: what the page shows, and corrections."""
