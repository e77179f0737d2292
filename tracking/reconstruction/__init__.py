"""Triangulation, uncertainty, gap filling, and the tracks file."""
