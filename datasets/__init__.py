"""Specimen descriptions and built dataset files; no code."""
