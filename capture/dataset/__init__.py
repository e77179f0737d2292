"""Datasets built from tracks and a table of recordings."""
