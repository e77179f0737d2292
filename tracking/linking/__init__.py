"""Markers followed from frame to frame: prediction, assignment, late-detected markers, names."""
