"""Errors that a user can act on."""


class InputError(Exception):
    """An error in the user's input. The message says what was expected, what was found and what to do."""


class SimulationError(Exception):
    """The solver did not converge for a step or an equilibrium. The message names the trajectory, step and residual."""
