"""A Gaussian prior over the body's shapes. It predicts the markers that are out of sight from those in sight.

A moving body takes similar shapes again and again. The visible markers show which of the earlier shapes the present
one resembles, and so where the hidden markers are. A shape never seen before is at least smooth. The markers' positions
x (2 M values) are modelled as normally distributed, x = mean + W a + e:

- The mean is that of the earlier shapes nearest to the visible markers.
- The columns of W are deformation modes, scaled so that the amplitudes a are standard normal. Some are the differences
  between those nearest shapes. The others are generic: translation, rotation, bending and smooth stretching. Their
  scale falls as the number of known shapes grows.
- e is independent noise.

Conditioning on the visible markers gives the position and sigma of the hidden ones.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.spatial import cKDTree

Array = NDArray[Any]

# The unit of length below: the median distance from a marker to its UNIT_NEIGHBOUR-th nearest one.
UNIT_NEIGHBOUR = 4
MAX_SHAPES = 128  # shapes kept; a longer recording keeps only every second, fourth, ... of them
NEAREST_SHAPES = 8  # shapes whose mean and differences give the local model
SHAPE_MODE_SCALE = 4.0  # factor on the differences between the nearest shapes: an extrapolation this far is normal
MAX_STRETCH_MODES = 32
MIN_VARIANCE_RATIO = 1e-8  # of a stretching mode, relative to the largest
RIGID_SIGMA = 5.0  # of translation [units]; that of bending is much smaller
# Of rotation [rad], and of the change of scale, which a rotation by one radian needs in a linear model.
ROTATION_SIGMA, SCALING_SIGMA = 1.2, 0.6
BENDING_DEGREES = 6  # polynomial degrees, from 0, of the bending modes
BENDING_DECAY = 4  # their sigma falls with this power of the degree
STRETCH_SIGMA, STRETCH_LENGTH = 0.4, 5.0  # sigma and correlation length of stretching and shear [units]
RIGID_HALVING_SHAPES, OTHER_HALVING_SHAPES = 5.0, 10.0  # known shapes after which a generic mode's scale has halved
MIN_CHANGE = 0.1  # displacement of any marker since the last kept shape that makes a new one [units]
NOISE_SIGMA = 0.01  # of e [units]
CLUTTER_SIDE = 8.0  # side of the square in which an arbitrary dot may lie [units]


class Belief(NamedTuple):
    """Where the markers are: a normal distribution.

    Attributes:
        position: mean [px], (M, 2).
        covariance: of x and y of all markers in turn [px^2], (2 M, 2 M).
    """

    position: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviation along x and along y, root mean square of both [px], (M)."""
        sigma: Array = np.sqrt(0.5 * np.diag(self.covariance).reshape(-1, 2).sum(axis=1))
        return sigma


class ShapePrior:
    """The prior, with shapes spread evenly over the recording so far."""

    def __init__(self, rest: Array) -> None:
        """Start without any shape; `rest` are the markers' positions at rest [px], (M, 2)."""
        self._rest = rest
        distance = cKDTree(rest).query(rest, min(UNIT_NEIGHBOUR + 1, len(rest)))[0]
        self._unit = float(np.median(distance[:, -1]))
        self._noise = NOISE_SIGMA * self._unit
        bending, stretching = self._bending_modes(), self._stretching_modes()
        self._generic_modes = np.concatenate([bending, stretching], axis=1)
        halving = [RIGID_HALVING_SHAPES, OTHER_HALVING_SHAPES]
        self._halving_shapes = np.repeat(halving, [4, self._generic_modes.shape[1] - 4])
        self._shapes = np.empty((0, 2 * len(rest)))  # displacements from rest
        self._keep_every, self._added = 1, 0
        self._times_seen = np.zeros(len(rest))  # shapes in which each marker was seen

    def __len__(self) -> int:
        """Number of shapes kept."""
        return len(self._shapes)

    def _bending_modes(self) -> Array:
        """Modes of translation, rotation, scaling and bending, times their sigmas [px], (2 M, K).

        They are conformal: rows of markers stay perpendicular to columns. Each is a Chebyshev polynomial of the complex
        position along (real part) and across (imaginary part) the body's long axis.
        """
        centred = self._rest - self._rest.mean(axis=0)
        axis = complex(*np.linalg.eigh(centred.T @ centred)[1][:, -1])
        position = (centred[:, 0] + 1j * centred[:, 1]) * np.conj(axis)
        half = max(float(np.abs(position.real).max()), self._unit)
        modes = []
        for degree in range(BENDING_DEGREES):
            scale = RIGID_SIGMA * self._unit / max(degree, 1) ** BENDING_DECAY
            along, across = (SCALING_SIGMA * half, ROTATION_SIGMA * half) if degree == 1 else (scale, scale)
            polynomial = np.polynomial.chebyshev.chebval(position / half, np.eye(BENDING_DEGREES)[degree])
            modes += [along * axis * polynomial, across * axis * 1j * polynomial]
        return np.stack([np.stack([mode.real, mode.imag], axis=1).ravel() for mode in modes], axis=1)

    def _stretching_modes(self) -> Array:
        """Modes of smooth stretching and shear, times their sigmas [px], (2 M, K)."""
        square = ((self._rest[:, None] - self._rest[None]) ** 2).sum(axis=2)
        variance, modes = np.linalg.eigh(np.exp(-0.5 * square / (STRETCH_LENGTH * self._unit) ** 2))
        variance, modes = variance[-MAX_STRETCH_MODES:], modes[:, -MAX_STRETCH_MODES:]
        large = variance > MIN_VARIANCE_RATIO * variance[-1]
        scaled: Array = np.kron(STRETCH_SIGMA * self._unit * modes[:, large] * np.sqrt(variance[large]), np.eye(2))
        return scaled

    def add_shape(self, position: Array, seen: NDArray[np.bool_]) -> None:
        """Add the shape of the next frame, unless it hardly differs from the last one.

        Args:
            position: of all markers, measured or predicted [px], (M, 2).
            seen: which of them were measured, (M).
        """
        displacement = position - self._rest
        if len(self._shapes) and np.abs(displacement.ravel() - self._shapes[-1]).max() < MIN_CHANGE * self._unit:
            return
        self._added += 1
        self._times_seen += seen
        if self._added % self._keep_every:
            return
        if len(self._shapes) == MAX_SHAPES:
            self._shapes = self._shapes[1::2]
            self._keep_every *= 2
        self._shapes = np.concatenate([self._shapes, displacement.reshape(1, -1)])

    def with_marker(self, rest: Array) -> "ShapePrior":
        """The same prior with one more marker, at rest at `rest` [px], (2); its position in each shape is predicted."""
        joined = ShapePrior(np.concatenate([self._rest, rest[None]]))
        known = np.arange(len(joined._rest)) < len(self._rest)
        for shape in self._shapes:
            position = joined._rest.copy()
            position[:-1] += shape.reshape(-1, 2)
            displacement = joined.predict(position, np.where(known, 0.0, np.inf)).position - joined._rest
            joined._shapes = np.concatenate([joined._shapes, displacement.reshape(1, -1)])
        joined._keep_every, joined._added = self._keep_every, self._added
        joined._times_seen = np.append(self._times_seen, 0.0)
        return joined

    def predict(self, position: Array, sigma: Array) -> Belief:
        """The belief about all markers, given where some are.

        Args:
            position: measured or predicted by the markers' own motion [px], (M, 2).
            sigma: of the predictions [px], (M). It is 0 for measured markers and infinite where nothing is known. The
                errors of the predictions may be common to all of them.

        Returns:
            Measured markers keep their position; their covariance is 0.
        """
        known = sigma == 0.0
        covariance = np.zeros((2 * len(known), 2 * len(known)))
        if known.all():
            return Belief(position.copy(), covariance)
        variance = (~known).sum() * sigma**2
        weight = self._noise**2 / (self._noise**2 + variance)  # relative to a measured marker
        predicted = np.where((weight > 0.0)[:, None], position, self._rest)
        weights, hidden = np.repeat(weight, 2), np.flatnonzero(np.repeat(~known, 2))
        mean, modes = self._local_model(predicted, weights, ~known)
        deviation = predicted.ravel() - mean
        factor, amplitudes = self._fit(deviation, weights, modes)
        residual = deviation - modes @ amplitudes
        mean_square = ((weights * residual**2).sum() / self._noise**2 + (amplitudes**2).sum()) / max(weights.sum(), 1.0)
        spread = self._noise * solve_triangular(factor, modes[hidden].T, lower=True)
        covariance[np.ix_(hidden, hidden)] = max(mean_square, 1.0) * (spread.T @ spread)
        covariance[hidden, hidden] += self._noise**2
        predicted[~known] = (mean + modes @ amplitudes).reshape(-1, 2)[~known]
        return Belief(predicted, covariance)

    def sample_shapes(self, count: int) -> list[Array]:
        """Up to `count` of the shapes, evenly spread: positions [px], (M, 2)."""
        chosen = np.unique(np.linspace(0, len(self._shapes) - 1, min(count, len(self._shapes))).astype(int))
        return [self._rest + self._shapes[k].reshape(-1, 2) for k in chosen]

    def _local_model(self, position: Array, weights: Array, queried: NDArray[np.bool_]) -> tuple[Array, Array]:
        """The mean (2 M) and the scaled modes (2 M, K) of the prior near the given positions [px].

        Args:
            position: of the markers [px], (M, 2).
            weights: of their coordinates, (2 M).
            queried: the markers whose position is sought, (M). The generic modes count for less the more shapes
                have shown all of these.
        """
        times_seen = self._times_seen[queried].min(initial=self._added)
        generic_modes = self._generic_modes * (self._halving_shapes / (self._halving_shapes + times_seen))
        if not len(self._shapes):
            return self._rest.ravel(), generic_modes
        distance = (self._shapes - (position - self._rest).ravel()) ** 2 @ weights
        nearest = self._shapes[np.argsort(distance)[:NEAREST_SHAPES]]
        mean = nearest.mean(axis=0)
        shape_modes = SHAPE_MODE_SCALE / np.sqrt(len(nearest)) * (nearest - mean).T
        return self._rest.ravel() + mean, np.concatenate([generic_modes, shape_modes], axis=1)

    def _fit(self, deviation: Array, weights: Array, modes: Array) -> tuple[Array, Array]:
        """Cholesky factor (K, K) of the regularised normal equations, and the modes' amplitudes (K) that solve them."""
        weighted = modes * weights[:, None]
        normal = modes.T @ weighted + self._noise**2 * np.eye(modes.shape[1])
        factor = np.linalg.cholesky(normal)
        return factor, cho_solve((factor, True), weighted.T @ deviation)
