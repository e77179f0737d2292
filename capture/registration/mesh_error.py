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

# Of the smooth error, as a share of the specimen's largest extent. Of 0.15, 0.25, 0.4 and 0.7, this one gave the
# modulus of a rubber beam best that was bent by 15 and 31 mm, and its markers were as probable as with any other.
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
    """The distribution of the specimen's markers about those of the mesh, and of their measurements.

    Attributes:
        frame: observation.
        observed: index of each observed axis among the 3 M' of the measured markers, (K).
        sigma: of the measurements along them [m], (K).
        covariance: of all measured markers along their axes, of a smooth error as large as the deflection [m^2],
            (3 M', 3 M').
        modes: independent directions of the measurements over `sigma`, the columns of (K, K).
        variance: of the modes by such an error, (K).
        deflection: root mean square of the measured deflections along the observed axes [m].
    """

    frame: FirstFrame
    observed: NDArray[np.int64]
    sigma: Array
    covariance: Array
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
        axes = np.eye(3)[None].repeat(len(rest), axis=0) if frame.axes is None else frame.axes[frame.measured]
        alike = np.einsum("mn,mik,njk->minj", _correlation(frame, rest), axes, axes)
        covariance = deflection**2 * alike.reshape(3 * len(rest), -1)
        own = covariance[np.ix_(observed, observed)] / np.outer(sigma, sigma)
        variance, modes = np.linalg.eigh(own)
        return cls(frame, observed, sigma, covariance, modes, np.maximum(variance, 0.0), deflection)

    def whitening(self, sizes: ErrorSizes) -> Array:
        """Matrix (K, 3 M') [1/m] that makes independent numbers of variance one of the markers' residuals."""
        result = np.zeros((len(self.observed), len(self.covariance)))
        result[:, self.observed] = self.modes.T / self.sigma
        return result / np.sqrt(self._mode_variance(sizes))[:, None]

    def total_sigma(self, sizes: ErrorSizes) -> float:
        """Root mean square standard deviation of a measurement about the mesh [m]."""
        by_single = (1.0 + sizes.single**2) * float((self.sigma**2).mean())
        return float(np.sqrt((sizes.smooth * self.deflection) ** 2 + by_single))

    def correction(self, sizes: ErrorSizes, residual: Array) -> Array:
        """The most probable smooth error of the nodes [m], (N, 3): what to add to those of the mesh.

        residual: markers of the mesh minus measured markers along their axes [m], (3 M').
        """
        frame, whitening = self.frame, self.whitening(sizes)
        weighted = (whitening.T @ (whitening @ residual)).reshape(-1, 3)
        along = weighted if frame.axes is None else np.einsum("mij,mi->mj", frame.axes[frame.measured], weighted)
        moved = np.asarray(-_correlation(frame, frame.simulator.mesh.vertices) @ along)
        moved[frame.simulator.fixed] = 0.0
        return (sizes.smooth * self.deflection) ** 2 * moved

    def marker_sigma(self, sizes: ErrorSizes, slopes: Array, covariance: Array) -> Array:
        """Largest standard deviations of the specimen's measured markers in any direction [m], (M').

        Args:
            sizes: of the error.
            slopes: derivatives of the mesh's markers along their axes by unknowns [m], (3 M', U).
            covariance: of the unknowns before the measurement, (U, U).
        """
        before = slopes @ covariance @ slopes.T + sizes.smooth**2 * self.covariance
        seen = before[:, self.observed]
        measured = seen[self.observed] + np.diag((1.0 + sizes.single**2) * self.sigma**2)
        after = before - seen @ np.linalg.solve(measured, seen.T)
        blocks = np.einsum("mimj->mij", after.reshape(len(before) // 3, 3, -1, 3))
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(blocks)[:, -1], 0.0)))

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


def _correlation(frame: FirstFrame, points: Array) -> Array:
    """Correlation of the smooth error at undeformed points (P, 3) with that at the measured markers, (P, M')."""
    length = CORRELATION_LENGTH * float(np.ptp(frame.simulator.mesh.vertices, axis=0).max())
    square = cdist(points, frame.markers.rest[frame.measured], "sqeuclidean")
    return np.asarray(np.exp(-0.5 * square / length**2))
