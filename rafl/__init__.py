"""Differentiable soft-body simulation, residual acceleration fields, fitting and evaluation."""
