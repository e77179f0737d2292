"""Direct and iterative solvers for the simulator's linear systems."""
