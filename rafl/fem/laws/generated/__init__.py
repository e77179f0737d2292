"""Derivatives of the laws that come with the package; `make laws` writes these files."""
