"""The specimen: its description, shape, mesh and markers."""
