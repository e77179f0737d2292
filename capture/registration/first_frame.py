"""The observation of a first frame: where the markers were measured, along which axes, and which forces may act."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.data.markers import Markers
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]

LINEAR_FORCE_SIGMA = 1.0  # prior sigma of the part that varies linearly over the nodes, a force and a moment [N]
# Of the force of a known load, as a share of its weight: a string within three degrees of the vertical.
LOAD_SIGMA = 0.05
HANGING_SIGMA = 3e-3  # distance of the place where the load hangs from the middle of its nodes [m]
UNOBSERVED_SIGMA_FACTOR = 10.0  # a larger multiple of the median sigma marks an axis that no camera observed


@dataclass(frozen=True)
class FirstFrame:
    """Observation of the first frame.

    Attributes:
        simulator: of the specimen.
        markers: embedded in its mesh.
        nodes: nodes on which virtual forces act, (L).
        target: recorded marker positions [m], (M, 3), NaN where missing.
        sigma: of the target along `axes` [m], (M, 3), infinite where not measured; equal along all axes if the pose is
            fitted too.
        recording: name, for messages.
        whole_surface: whether `nodes` are the whole surface, each with an independent force.
        load: known load [kg] that hangs on `nodes`; 0 if the forces are unknown.
        axes: unit vectors along which every marker was measured, the rows of (M, 3, 3); x, y, z if None.
    """

    simulator: Simulator
    markers: Markers
    nodes: NDArray[np.int64]
    target: Array
    sigma: Array
    recording: str
    whole_surface: bool = False
    load: float = 0.0
    axes: Array | None = None

    def along_axes(self, vectors: Array) -> Array:
        """Components along `axes` of vectors or matrices of the measured markers, (M', 3, ..)."""
        if self.axes is None:
            return vectors
        components: Array = np.einsum("mij,mj...->mi...", self.axes[self.measured], vectors)
        return components

    def expected_force(self) -> Array:
        """Mean of the forces' prior [N], (3 L)."""
        weight = self.load * np.asarray(self.simulator.gravity)
        return np.tile(weight / len(self.nodes), len(self.nodes))

    def linear_force_sigma(self) -> Array:
        """Prior standard deviations of the amplitudes of `linear_modes` [N], (up to 4).

        A force F that acts at a distance d from the middle of nodes at x has the amplitude F d / sqrt(sum x^2).
        """
        positions = self.simulator.mesh.vertices[self.nodes]
        count = linear_modes(positions).shape[1]
        if self.load == 0.0:
            return np.full(count, LINEAR_FORCE_SIGMA)
        weight = self.load * float(np.linalg.norm(self.simulator.gravity))
        arms = np.linalg.svd(positions - positions.mean(0), compute_uv=False)[: count - 1]
        return weight * np.concatenate([[LOAD_SIGMA / np.sqrt(len(positions))], HANGING_SIGMA / arms])

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which markers are not missing, (M)."""
        return np.isfinite(self.target[:, 0])

    @property
    def observed_axes(self) -> NDArray[np.bool_]:
        """Along which axes at least one camera observed the M' measured markers, (M', 3)."""
        sigma = self.sigma[self.measured]
        return np.asarray(sigma < UNOBSERVED_SIGMA_FACTOR * np.median(sigma[np.isfinite(sigma)]))


def linear_modes(positions: Array) -> Array:
    """Orthonormal values at `positions` (L, 3) of functions that are linear in the position, (L, up to 4)."""
    extent = np.ptp(positions, axis=0).max()
    functions = np.column_stack([np.ones(len(positions)), (positions - positions.mean(0)) / extent])
    u, s, _ = np.linalg.svd(functions, full_matrices=False)
    return np.asarray(u[:, s > 1e-9 * s[0]])
