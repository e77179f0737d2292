"""Synthetic videos of simulated specimens."""
