"""The error of a mesh: how the markers of a bent specimen differ from those of the mesh that should follow it.

The mesh's cells and its law of the material bend a little differently than the specimen does. Such an error varies
smoothly along the body, so markers near each other show it alike: many markers tell hardly more about it than one. It
is taken for a Gaussian process. Each marker has an error of its own besides, that of its place and its measurement.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from rafl.capture.registration.first_frame import MODEL_FRACTION, FirstFrame

Array = NDArray[Any]

# Of the smooth error, as a share of the specimen's largest extent. Over 40 first frames of beams of three laws and
# three shapes (tests/bench/unlike_material.py), errors over sigma are 0.95 with one camera and 1.11 with two.
CORRELATION_LENGTH = 0.25
SIZE_SIGMA = np.log(10.0)  # of the logarithm of a size around the assumed one: a factor of ten is no surprise
LEAST_FACTOR = 1e-6  # of a size from which a search starts, relative to the assumed one
LOG_TOLERANCE, OBJECTIVE_TOLERANCE = 0.05, 0.02  # of the search for the logarithms of the sizes


@dataclass(frozen=True)
class ErrorSizes:
    """Standard deviations of a mesh's error.

    Attributes:
        smooth: of the smooth part, relative to the deflection.
        single: of every marker's own part, beyond its measurement, relative to the standard deviation of that.
    """

    smooth: float
    single: float

    @property
    def values(self) -> Array:
        """Both, (2)."""
        return np.array([self.smooth, self.single])


EXACT = ErrorSizes(0.0, 0.0)
ASSUMED = ErrorSizes(MODEL_FRACTION, 1.0)


@dataclass(frozen=True)
class MeshError:
    """The distribution of the markers' measurements about the markers of the mesh.

    Attributes:
        count: number of measured markers, M'.
        observed: index of each observed axis among the 3 M' of the measured markers, (K).
        sigma: of the measurements along them [m], (K).
        modes: independent directions of the measurements over `sigma`, the columns of (K, K).
        variance: of the modes by a smooth error as large as the deflection, (K).
        deflection: root mean square of the measured deflections along the observed axes [m].
    """

    count: int
    observed: NDArray[np.int64]
    sigma: Array
    modes: Array
    variance: Array
    deflection: float

    @classmethod
    def of(cls, frame: FirstFrame, target: Array) -> "MeshError":
        """For measured positions (M', 3) [m] in the specimen frame."""
        observed, rest = np.flatnonzero(frame.observed_axes), frame.markers.rest[frame.measured]
        sigma = frame.sigma[frame.measured].ravel()[observed]
        moved = frame.along_axes(target - rest).ravel()[observed]
        deflection = float(np.sqrt((moved**2).mean()))
        length = CORRELATION_LENGTH * float(np.ptp(frame.simulator.mesh.vertices, axis=0).max())
        correlation = np.exp(-0.5 * cdist(rest, rest, "sqeuclidean") / length**2)
        axes = np.eye(3)[None].repeat(len(rest), axis=0) if frame.axes is None else frame.axes[frame.measured]
        alike = np.einsum("mn,mik,njk->minj", correlation, axes, axes).reshape(3 * len(rest), -1)
        scaled = deflection**2 * alike[np.ix_(observed, observed)] / np.outer(sigma, sigma)
        variance, modes = np.linalg.eigh(scaled)
        return cls(len(rest), observed, sigma, modes, np.maximum(variance, 0.0), deflection)

    def whitening(self, sizes: ErrorSizes) -> Array:
        """Matrix (K, 3 M') [1/m] that makes independent numbers of variance one of the markers' residuals."""
        result = np.zeros((len(self.observed), 3 * self.count))
        result[:, self.observed] = self.modes.T / self.sigma
        return result / np.sqrt(self._mode_variance(sizes))[:, None]

    def mesh_sigma(self, sizes: ErrorSizes) -> float:
        """Standard deviation of a marker about that of the mesh in any direction, less its measurement [m]."""
        return float(np.hypot(sizes.smooth * self.deflection, sizes.single * np.sqrt((self.sigma**2).mean())))

    def total_sigma(self, sizes: ErrorSizes) -> float:
        """Root mean square standard deviation of a measurement about the mesh [m]."""
        return float(np.hypot(self.mesh_sigma(sizes), np.sqrt((self.sigma**2).mean())))

    def log_probability(self, sizes: ErrorSizes) -> float:
        """Logarithm of how probable the sizes are beforehand, up to a constant."""
        return -0.5 * float((self._logarithms(sizes) ** 2).sum() / SIZE_SIGMA**2)

    def most_probable(self, rows: Array, known: Array, precision: Array, start: ErrorSizes) -> ErrorSizes:
        """The most probable sizes, over all values of the unknowns of a linear problem.

        Args:
            rows: errors of the markers along their axes where the unknowns are zero, and their derivatives by the
                unknowns [m], (3 M', 1 + U).
            known: the same of numbers of mean zero and variance one, (S, 1 + U).
            precision: inverse prior covariance of the unknowns, (U, U); singular for those without a prior.
            start: sizes from which the search starts.
        """
        scaled = self.modes.T @ (rows[self.observed] / self.sigma[:, None])

        def objective(logarithms: Array) -> float:
            sizes = ErrorSizes(*(ASSUMED.values * np.exp(logarithms)).tolist())
            variance = self._mode_variance(sizes)
            white = np.concatenate([scaled / np.sqrt(variance)[:, None], known])
            offset, slopes = white[:, 0], white[:, 1:]
            hessian, gradient = slopes.T @ slopes + precision, slopes.T @ offset
            left = offset @ offset - gradient @ np.linalg.solve(hessian, gradient)
            spread = np.log(variance).sum() + np.linalg.slogdet(hessian)[1]
            return float(left + spread - 2.0 * self.log_probability(sizes))

        begin = self._logarithms(start)
        simplex = begin - np.concatenate([np.zeros((1, 2)), np.eye(2)])
        options = {"xatol": LOG_TOLERANCE, "fatol": OBJECTIVE_TOLERANCE, "initial_simplex": simplex}
        found = minimize(objective, begin, method="Nelder-Mead", options=options)
        return ErrorSizes(*(ASSUMED.values * np.exp(found.x)).tolist())

    def _mode_variance(self, sizes: ErrorSizes) -> Array:
        result: Array = 1.0 + sizes.single**2 + sizes.smooth**2 * self.variance
        return result

    @staticmethod
    def _logarithms(sizes: ErrorSizes) -> Array:
        """Of the sizes over the assumed ones."""
        result: Array = np.log(np.maximum(sizes.values / ASSUMED.values, LEAST_FACTOR))
        return result
