"""Differentiable soft-body simulation, residual acceleration fields, fitting and evaluation."""

import os

# A kernel's thread that waits for another spins only briefly: on a busy machine the other may not even run.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")
