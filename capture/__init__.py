"""Specimens, registration, datasets and synthetic recordings."""
