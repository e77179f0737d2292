"""A specimen's description made from a recording of it at rest, and a layout of dots to print."""
