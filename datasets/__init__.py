"""Descriptions of specimens and experiments, results, and built dataset files; no code."""
