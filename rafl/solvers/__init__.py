"""Direct and iterative solvers of the simulator's linear systems."""
