"""Derivatives of an elastic energy, as source text. Importing it imports sympy, so only a new law does."""
