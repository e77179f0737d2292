"""Specimens: description, shape, mesh and markers."""
