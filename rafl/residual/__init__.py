"""Residual forces: the acceleration field of the paper and the supervised network."""
