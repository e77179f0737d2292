"""The observation of a first frame: where the markers were measured, along which axes, and which forces may act."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.data.markers import Markers
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]

RESULTANT_SIGMA = 1.0  # of a force on the nodes [N]; of a moment, with a lever as long as the specimen
# Of the force of a known load, as a share of its weight: a string within three degrees of the vertical.
LOAD_SIGMA = 0.05
# Angle between gravity, as the specimen file has it, and the pull of a hanging weight [rad]: a hand levels a clamp, and
# places a board, to about a degree.
LEVEL_SIGMA = 0.02
HANGING_SIGMA = 3e-3  # distance of the place where the load hangs from the middle of its nodes [m]
# The mesh follows the shape of a bent specimen to about this fraction of its deflection.
MODEL_FRACTION = 0.01
LEAST_ARM = 1e-3  # of nodes about an axis, relative to the largest; with less, they are in line with it
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
        moving: whether the body is in motion, so that no load hangs on it at rest.
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
    moving: bool = False
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

    def resultant_modes(self) -> tuple[Array, Array]:
        """Nodal forces that make up a force and a moment: F / L + a x (x - middle) at a node x.

        Returns:
            Orthonormal modes, (3 L, up to 6), and prior standard deviations of their amplitudes [N], (up to 6). Nodes
            in a line take no moment about it.
        """
        modes, size = rigid_modes(self.simulator.mesh.vertices[self.nodes])
        if self.load == 0.0:
            lever = float(np.ptp(self.simulator.mesh.vertices, axis=0).max())
            return modes, RESULTANT_SIGMA * np.concatenate([1.0 / size[:3], lever / size[3:]])
        weight = self.load * float(np.linalg.norm(self.simulator.gravity))
        force = np.full(3, weight * LOAD_SIGMA / np.sqrt(len(self.nodes)))
        return modes, np.concatenate([force, weight * HANGING_SIGMA / size[3:]])

    def hanging_precision(self, weight: float) -> Array:
        """Inverse prior covariance of the modes' amplitudes [1/N^2], for a weight that hangs on the nodes.

        It pulls along gravity, and at a place near their middle. Its size is as unknown as that of any force.

        weight: [N], about.
        """
        _, size = rigid_modes(self.simulator.mesh.vertices[self.nodes])
        gravity = np.asarray(self.simulator.gravity)
        down = gravity / np.linalg.norm(gravity)
        along, sideways = np.outer(down, down), weight * LEVEL_SIGMA / size[0]
        precision = np.diag(np.concatenate([np.zeros(3), (weight * HANGING_SIGMA / size[3:]) ** -2.0]))
        precision[:3, :3] = along * (size[0] / RESULTANT_SIGMA) ** 2 + (np.eye(3) - along) / sideways**2
        return precision

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which markers are not missing, (M)."""
        return np.isfinite(self.target[:, 0])

    @property
    def observed_axes(self) -> NDArray[np.bool_]:
        """Along which axes at least one camera observed the M' measured markers, (M', 3)."""
        sigma = self.sigma[self.measured]
        return np.asarray(sigma < UNOBSERVED_SIGMA_FACTOR * np.median(sigma[np.isfinite(sigma)]))


def rigid_modes(positions: Array) -> tuple[Array, Array]:
    """Orthonormal motions of points (L, 3) [m] that do not deform them: along x, y, z, and about their principal axes.

    Returns:
        Modes, (3 L, up to 6), and their sizes: square roots of the number of points, for a turn of the sum of their
        squared distances from the axis [m]. Points in a line do not move by a turn about it.
    """
    arms = positions - positions.mean(axis=0)
    shifts = np.tile(np.eye(3), (len(arms), 1))
    axes = np.linalg.svd(arms)[2]
    turns = np.stack([np.cross(axis, arms).ravel() for axis in axes], axis=1)
    size = np.linalg.norm(turns, axis=0)
    kept = size > LEAST_ARM * max(float(size.max()), np.finfo(float).tiny)
    modes = np.concatenate([shifts, turns[:, kept]], axis=1)
    sizes = np.concatenate([np.full(3, np.sqrt(len(arms))), size[kept]])
    return modes / sizes, sizes
