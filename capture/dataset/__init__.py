"""Datasets from tracks and a table of recordings."""
