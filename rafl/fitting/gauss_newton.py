"""Gauss-Newton descent of a loss over recordings within bounds, with a prior whose weight follows the loss."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

Array = NDArray[Any]

# Largest decrease of the loss, relative to it, that the model still expects where a search ends: of values that are
# reported, of a model that is only compared, and of an early stage.
EXACT, GOOD, EARLY = 1e-3, 3e-2, 0.1
NEGLIGIBLE_LOSS = 1e-14  # of markers within a nanometre
MIN_LOSS = 1e-30  # smallest divisor, for a loss of zero
MIN_RELATIVE_CURVATURE = 1e-12  # of the Gauss-Newton matrix; directions of less are taken as undetermined
# Gain of a step relative to the expected one between which the matrix is kept: it changes slowly.
GOOD_MODEL = (0.5, 1.5)
INDEPENDENT_ERRORS = 10.0  # see `Prior`
MIN_STEP = 0.05  # fraction of a step below which the search ends


@dataclass(frozen=True)
class Evaluation:
    """The loss at some variables (n), for R training recordings.

    Attributes:
        losses: of every recording, see `rafl.data.objective.recording_losses`, (R).
        gradients: of every recording's loss, exact, (R, n).
    """

    losses: list[float]
    gradients: list[list[float]]

    @property
    def loss(self) -> float:
        """Mean loss of the recordings."""
        return float(np.mean(self.losses))

    @property
    def gradient(self) -> Array:
        """Of the loss, (n)."""
        mean: Array = np.mean(self.gradients, axis=0)
        return mean


@dataclass(frozen=True)
class Prior:
    """Independent normal distributions of the variables (n): their means and standard deviations.

    The size of the model's errors is not known beforehand, and they are systematic: those of a whole fit tell as much
    as `INDEPENDENT_ERRORS` independent ones. So the search minimises log loss + (2 / INDEPENDENT_ERRORS) p, where p is
    half the sum of the squared deviations: a deviation by one standard deviation must lower the loss by a tenth.
    """

    mean: Array
    deviation: Array

    def value(self, x: Array) -> float:
        """What it adds to log loss."""
        return float((((x - self.mean) / self.deviation) ** 2).sum()) / INDEPENDENT_ERRORS

    def slope(self, x: Array) -> Array:
        """Gradient of `value`, (n)."""
        slope: Array = 2.0 * (x - self.mean) / (self.deviation**2 * INDEPENDENT_ERRORS)
        return slope

    @property
    def curvature(self) -> Array:
        """Second derivatives of `value` by each variable, (n)."""
        curvature: Array = 2.0 / (self.deviation**2 * INDEPENDENT_ERRORS)
        return curvature

    @classmethod
    def flat(cls, count: int) -> "Prior":
        """A prior that says nothing about `count` variables."""
        return cls(np.zeros(count), np.full(count, np.inf))


@dataclass(frozen=True)
class Minimum:
    """Where a search ended.

    Attributes:
        x: the variables, (n).
        loss: at x.
        curvature: Gauss-Newton matrix of the recordings' mean loss, computed at x or near it, (n, n).
    """

    x: Array
    loss: float
    curvature: Array


class Objective(Protocol):
    """What `descend` minimises."""

    def evaluate(self, x: Array) -> Evaluation:
        """The loss of every recording at variables x (n), and its gradient."""

    def curvature(self, x: Array) -> Array:
        """Gauss-Newton matrix of the mean loss at x, (n, n)."""

    def agree(self, x: Array) -> Array:
        """The variables to try next; where several processes search, those of one of them, in all."""

    def record(self, x: Array) -> None:
        """Called with the variables of every accepted step."""


def descend(
    objective: Objective,
    start: Array,
    bounds: tuple[Array, Array],
    prior: Prior,
    evaluations: int,
    tolerance: float = EXACT,
) -> Minimum:
    """Minimise within bounds from a starting point by the Gauss-Newton method.

    Every step minimises a quadratic model of the loss with the exact gradient and a Gauss-Newton matrix. A step
    that does not lower the loss is halved. The matrix is computed again where the model foretold a gain badly. The
    search ends where the model expects to gain less than `tolerance` times the loss, or after some evaluations.
    """
    lows, highs = bounds
    x, found, matrix = start, objective.evaluate(start), objective.curvature(start)
    at, length = start, 1.0  # where the matrix was computed; the fraction of a step to try
    for _ in range(evaluations):
        model = matrix + found.loss * np.diag(prior.curvature)
        gradient = found.gradient + found.loss * prior.slope(x)
        step = bounded_step(model, gradient, lows - x, highs - x)
        converged = not -(gradient @ step + 0.5 * step @ model @ step) > tolerance * found.loss
        if (converged or length < MIN_STEP) and (at != x).any() and tolerance < EARLY:
            matrix, at, length = objective.curvature(x), x, 1.0
            continue
        if converged or length < MIN_STEP or found.loss < NEGLIGIBLE_LOSS:
            break
        step *= length
        expected = -(gradient @ step + 0.5 * step @ model @ step)
        end = objective.agree(np.clip(x + step, lows, highs))
        trial = objective.evaluate(end)
        gained = (found.loss - trial.loss * np.exp(prior.value(end) - prior.value(x))) / expected
        if gained > 0.0:
            x, found, length = end, trial, min(2.0 * length, 1.0)
            objective.record(x)
        else:
            length *= 0.5
        if not GOOD_MODEL[0] <= gained <= GOOD_MODEL[1] and (at != x).any():
            matrix, at = objective.curvature(x), x
    return Minimum(x, found.loss, matrix)


def bounded_step(matrix: Array, gradient: Array, low: Array, high: Array) -> Array:
    """The step d (n) with low <= d <= high that minimises gradient . d + d . matrix d / 2."""
    values, vectors = np.linalg.eigh(matrix)
    roots = np.sqrt(np.maximum(values, MIN_RELATIVE_CURVATURE * max(values[-1], MIN_LOSS)))
    right = -(vectors.T @ gradient) / roots
    margin = 1e-15 + 1e-12 * (high - low)  # bounds that meet at zero leave the solver no room
    found = lsq_linear(roots[:, None] * vectors.T, right, (low - margin, high + margin), method="bvls")
    step: Array = np.clip(found.x, low, high)
    return step
