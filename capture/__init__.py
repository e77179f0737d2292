"""Specimens and recordings: from tracked markers to datasets, and from simulations to videos."""
