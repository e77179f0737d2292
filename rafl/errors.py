"""What can go wrong in a simulation."""


class SimulationError(Exception):
    """A step or an equilibrium that could not be solved: says which, how far it came, what to try."""
