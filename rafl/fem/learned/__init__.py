"""A learned strain energy and a learned viscosity, added to the elastic law."""
