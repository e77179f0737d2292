"""Finite elements: meshes, quadrature, materials, elastic laws and their compiled kernels."""
