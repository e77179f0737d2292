"""Errors that a user can act on."""


class InputError(Exception):
    """A mistake in the user's input. The message says what was expected, what was found and what to do."""


class SimulationError(Exception):
    """A step or an equilibrium that the solver did not reach. The message names the trajectory, step and residual."""
