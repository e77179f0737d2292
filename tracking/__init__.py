"""Dots in videos: found, followed, named and placed in 3-D."""
