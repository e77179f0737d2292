"""The search for the virtual forces of a first frame, under one prior of how the body is loaded."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.registration.first_frame import FirstFrame, rigid_modes
from rafl.capture.registration.material_change import (
    MATERIAL_SIGMA,
    UNCHANGED,
    material_loads,
    with_changed_material,
)
from rafl.capture.registration.rigid import RigidTransform, kabsch
from rafl.common.errors import SimulationError
from rafl.data.views import pose_jacobian

Array = NDArray[Any]

LEAST_PULL = 1e-3  # taken for a weight where what is found is less, or upwards [N]
INITIAL_DAMPING = 1e4  # of a Levenberg-Marquardt step, as a multiple of the prior
MAX_ITERATIONS, MAX_TRIALS = 100, 6  # of one search, and of one step; the sixth is damped 2^15 times as much
# Of Newton's method from one equilibrium to the next. Those that a search keeps take fewer than ten.
MAX_NEWTON_ITERATIONS = 30
# The search ends where an undamped step promises a smaller decrease: relative to the objective, plus absolute.
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-4, 1e-3


@dataclass(frozen=True)
class ForcePrior:
    """How a body may be loaded in its first frame.

    Attributes:
        name: of what loads it.
        local_sigma: standard deviation of what a nodal force has beyond its part of a force and a moment on all nodes
            [N].
        shape_sigma: standard deviation of the loaded nodes from a rigid motion of them all [m]; infinite if they may
            deform.
        hanging: whether the force is that of a weight, which pulls along gravity (`FirstFrame.hanging_precision`).
    """

    name: str
    local_sigma: float
    shape_sigma: float = np.inf
    hanging: bool = False

    def precision(self, frame: FirstFrame, pull: float) -> Array:
        """Inverse prior covariance of the forces on the frame's nodes [1/N^2], (3 L, 3 L).

        pull: of what hangs on the nodes [N], about; of no account for other loads.
        """
        modes, _ = frame.resultant_modes()
        local = (np.eye(len(modes)) - modes @ modes.T) / self.local_sigma**2
        return np.asarray(modes @ self.resultant_precision(frame, pull) @ modes.T + local)

    def resultant_precision(self, frame: FirstFrame, pull: float) -> Array:
        """That of the amplitudes of `FirstFrame.resultant_modes` [1/N^2], (n, n)."""
        if self.hanging:
            return frame.hanging_precision(max(pull, LEAST_PULL))
        return np.diag(frame.resultant_modes()[1] ** -2.0)


@dataclass(frozen=True)
class Estimate:
    """A loaded body.

    Attributes:
        frame: observation, with a simulator of the material that is tried.
        change: of that material from the assumed one, (3): see `material_change`.
        force: virtual nodal forces [N], (N, 3).
        pose: from the frame of the target to the specimen frame.
        q: node positions in equilibrium [m], (N, 3).
        residual: markers of the mesh minus measured markers along their axes [m], (3 M').
        shape: of the loaded nodes, less their rigid motion, over `ForcePrior.shape_sigma`, (3 L).
        objective: that is minimised.
    """

    frame: FirstFrame
    change: Array
    force: Array
    pose: RigidTransform
    q: Array
    residual: Array
    shape: Array
    objective: float


class ForceSearch:
    """One minimisation, by the Levenberg-Marquardt method.

    Args:
        frame: observation.
        prior: of the forces.
        whitening: that turns the markers' residuals into independent numbers of variance one [1/m], (K, 3 M'). A depth
            that no camera observed is an assumption, and the same one for all markers: it has no part in them.
        with_pose: whether the pose is fitted too.
        with_material: whether the material is fitted too, around the assumed one.
        pull: of what hangs on the nodes [N], about, for the prior of a hanging weight.
    """

    def __init__(
        self,
        frame: FirstFrame,
        prior: ForcePrior,
        whitening: Array,
        with_pose: bool,
        with_material: bool,
        pull: float,
    ) -> None:
        self.frame, self.prior, self.with_pose, self.with_material = frame, prior, with_pose, with_material
        self.whitening = whitening
        self.precision = prior.precision(frame, pull)
        self.expected = frame.expected_force()

    def evaluate(self, force: Array, pose: RigidTransform, start: Array | None, change: Array) -> Estimate:
        """Equilibrium, residual and objective, with the solve started at `start` (N, 3) if given."""
        frame = replace(self.frame, simulator=with_changed_material(self.frame.simulator, change))
        simulator = frame.simulator
        total, label = (simulator.weight + force)[None], f"{frame.recording}: first frame"
        if start is None:
            q = simulator.equilibrium(total, label=label)[0]
        else:  # `minimise` fails at once where `equilibrium` would increase the load in small steps
            zero, state = np.zeros(total.shape[:2]), simulator.constitutive_state(1)
            q = simulator.minimise(
                start[None], zero, start[None], total, state, label, max_iterations=MAX_NEWTON_ITERATIONS
            )[0]
        positions = frame.markers.positions(torch.from_numpy(q)).numpy()[frame.measured]
        residual = frame.along_axes(positions - pose.apply(frame.target[frame.measured])).ravel()
        shape = self._shape(q)
        f = force[frame.nodes].ravel() - self.expected
        by_prior = f @ self.precision @ f + shape @ shape + ((change / MATERIAL_SIGMA) ** 2).sum()
        objective = float(((self.whitening @ residual) ** 2).sum() + by_prior)
        return Estimate(frame, change, force, pose, q, residual, shape, objective)

    def minimise(self, force: Array, pose: RigidTransform, start: Array | None, change: Array = UNCHANGED) -> Estimate:
        """Best estimate, from initial forces (N, 3), pose, node positions (N, 3) and change of the material.

        Positions from which no equilibrium is found are left: the search then starts from the undeformed body.
        """
        try:
            current = self.evaluate(force, pose, start, change)
        except SimulationError:
            if start is None:
                raise
            current = self.evaluate(force, pose, None, change)
        damping, growth = INITIAL_DAMPING, 2.0  # updated as by H. B. Nielsen
        for _ in range(MAX_ITERATIONS):
            gradient, hessian = self._normal_equations(current)
            promised = gradient @ np.linalg.solve(hessian, gradient)
            if promised < RELATIVE_TOLERANCE * current.objective + ABSOLUTE_TOLERANCE:
                break
            damping_matrix = self._damping_matrix(hessian)
            for _ in range(MAX_TRIALS):
                step = np.linalg.solve(hessian + damping * damping_matrix, -gradient)
                try:
                    trial = self._take_step(current, step)
                except SimulationError:  # the step was too long; more damping shortens it
                    decrease = -np.inf
                else:
                    decrease = current.objective - trial.objective
                if decrease > 0.0:
                    predicted = -float(step @ (2.0 * gradient + hessian @ step))
                    damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * decrease / predicted - 1.0) ** 3), 2.0
                    break
                damping, growth = damping * growth, 2.0 * growth
            if decrease <= 0.0:
                break
            current = trial
        return current

    def rms(self, found: Estimate) -> float:
        """Root mean square of the residuals along observed axes [m]."""
        return float(np.sqrt((found.residual.reshape(-1, 3)[self.frame.observed_axes] ** 2).mean()))

    def linearised(self, found: Estimate) -> tuple[Array, Array, Array]:
        """The problem near an estimate, by the U unknowns less their expected values.

        Returns:
            The markers' residuals where the unknowns are as expected, and their derivatives [m], (3 M', 1 + U); those
            of `Estimate.shape`, (S, 1 + U); the inverse prior covariance of the unknowns, (U, U).
        """
        slopes, count = self._slopes(found), len(self.precision)
        unknowns = slopes.shape[1]
        precision, deviation = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        precision[:count, :count] = self.precision
        deviation[:count] = found.force[self.frame.nodes].ravel() - self.expected
        if self.with_material:
            precision[-3:, -3:], deviation[-3:] = np.diag(MATERIAL_SIGMA**-2.0), found.change
        by_shape = np.zeros((0, unknowns))
        if np.isfinite(self.prior.shape_sigma):
            by_shape = np.zeros((len(found.shape), unknowns))
            by_shape[:, self._deforming(unknowns)] = self._shape_slopes(found)
        shape = found.shape[: len(by_shape)]
        rows = np.column_stack([found.residual - slopes @ deviation, slopes])
        return rows, np.column_stack([shape - by_shape @ deviation, by_shape]), precision

    def log_evidence(self, found: Estimate) -> float:
        """Logarithm of the probability of the observation under the prior, up to a constant.

        By Laplace's approximation at the minimum. Fits with other priors and model errors of the same unknowns are
        compared by it.
        """
        _, hessian = self._normal_equations(found)
        by_shape = self._shape_slopes(found) if np.isfinite(self.prior.shape_sigma) else np.zeros((0, len(hessian)))
        known = slice(0, len(self.precision))
        prior = self.precision + by_shape[:, known].T @ by_shape[:, known]
        spread = np.linalg.slogdet(prior)[1] - np.linalg.slogdet(hessian)[1]
        spread += np.linalg.slogdet(self.whitening @ self.whitening.T)[1]
        return float(0.5 * (spread - found.objective))

    def marker_sigma(self, found: Estimate) -> Array:
        """Largest standard deviations of the measured markers [m], (M'), in a fit without a pose.

        By Laplace's approximation: the covariance of forces and material is the inverse of the Gauss-Newton Hessian.
        """
        slopes = self._marker_slopes(found)
        by_unknowns = slopes.reshape(-1, 3, slopes.shape[1])
        solved = np.linalg.solve(self._normal_equations(found)[1], slopes.T).T.reshape(by_unknowns.shape)
        sigma: Array = np.sqrt(np.linalg.eigvalsh(by_unknowns @ solved.swapaxes(1, 2))[:, -1])
        return sigma

    def _normal_equations(self, current: Estimate) -> tuple[Array, Array]:
        """Half the gradient and half the Gauss-Newton Hessian by forces (3 L) and, if fitted, pose or material."""
        jacobian = self.whitening @ self._slopes(current)
        gradient, hessian = jacobian.T @ (self.whitening @ current.residual), jacobian.T @ jacobian
        count = len(self.precision)
        gradient[:count] += self.precision @ (current.force[self.frame.nodes].ravel() - self.expected)
        hessian[:count, :count] += self.precision
        if self.with_material:
            gradient[-3:] += current.change / MATERIAL_SIGMA**2
            hessian[-3:, -3:] += np.diag(MATERIAL_SIGMA**-2.0)
        if np.isfinite(self.prior.shape_sigma):
            slopes = self._shape_slopes(current)
            own = self._deforming(len(gradient))
            gradient[own] += slopes.T @ current.shape
            hessian[np.ix_(own, own)] += slopes.T @ slopes
        return gradient, hessian

    def _deforming(self, unknowns: int) -> NDArray[np.int64]:
        """Indices of the unknowns that deform the body: all but the pose."""
        count = len(self.precision)
        return np.asarray(np.r_[:count, count + 6 * self.with_pose : unknowns])

    def _slopes(self, current: Estimate) -> Array:
        """Derivatives of the residual by the unknowns: forces and, if fitted, pose (6) or material (3), (3 M', U)."""
        slopes = self._marker_slopes(current)
        if self.with_pose:
            posed = current.pose.apply(self.frame.target[self.frame.measured])
            slopes = np.concatenate([slopes, -pose_jacobian(posed).reshape(-1, 6)], axis=1)
        return slopes

    def _marker_slopes(self, current: Estimate) -> Array:
        """Derivatives of the measured markers along their axes by forces and material if fitted, (3 M', 3 L [+ 3])."""
        by_force = node_force_slopes(current.frame, current.q)
        slopes = on_loaded_nodes(self.frame, by_force)
        if self.with_material:
            loads = material_loads(self.frame.simulator, current.change, current.q)
            slopes = np.concatenate([slopes, np.tensordot(by_force, loads)], axis=1)
        return slopes

    def _shape(self, q: Array) -> Array:
        """`Estimate.shape` of node positions (N, 3)."""
        nodes = self.frame.nodes
        if not np.isfinite(self.prior.shape_sigma):
            return np.zeros(3 * len(nodes))
        undeformed = self.frame.simulator.mesh.vertices[nodes]
        rigid = kabsch(undeformed, q[nodes])
        return np.asarray((q[nodes] - rigid.apply(undeformed)).ravel() / self.prior.shape_sigma)

    def _shape_slopes(self, current: Estimate) -> Array:
        """Derivatives of `Estimate.shape` by forces and material if fitted, (3 L, 3 L [+ 3]); small strains assumed."""
        nodes, simulator, size = self.frame.nodes, current.frame.simulator, 3 * len(self.frame.nodes)
        loads = np.zeros((*current.q.shape, size + 3 * self.with_material))
        loads[nodes, :, :size] = np.eye(size).reshape(len(nodes), 3, size)
        if self.with_material:
            loads[..., -3:] = material_loads(self.frame.simulator, current.change, current.q)
        slopes = simulator.solve_tangent(current.q[None], loads[None])[0][nodes].reshape(size, -1)
        rigid, _ = rigid_modes(current.q[nodes])
        return np.asarray((slopes - rigid @ (rigid.T @ slopes)) / self.prior.shape_sigma)

    def _damping_matrix(self, hessian: Array) -> Array:
        """The prior of the forces; for the pose, which has no prior, a small multiple of its Hessian diagonal."""
        matrix, count = np.diag(1e-6 * np.diag(hessian)), len(self.precision)
        matrix[:count, :count] = self.precision
        if self.with_material:
            matrix[-3:, -3:] = np.diag(MATERIAL_SIGMA**-2.0)
        return matrix

    def _take_step(self, current: Estimate, step: Array) -> Estimate:
        force, count = current.force.copy(), len(self.precision)
        force[self.frame.nodes] += step[:count].reshape(-1, 3)
        pose = current.pose.followed_by(step[count : count + 6]) if self.with_pose else current.pose
        change = current.change + step[-3:] if self.with_material else current.change
        return self.evaluate(force, pose, current.q, change)


def node_force_slopes(frame: FirstFrame, q: Array) -> Array:
    """Derivatives of the measured markers, along their axes, by forces on all nodes [m/N], (3 M', N, 3).

    q: equilibrium [m], (N, 3).
    """
    measured = np.flatnonzero(frame.measured)
    by_corner = frame.along_axes(frame.markers.corner_jacobian(torch.from_numpy(q)).numpy()[measured])  # (M', 3, 4, 3)
    rows = np.zeros((len(measured), 3, *q.shape))
    for corner in range(4):
        rows[np.arange(len(measured)), :, frame.markers.quad[measured, corner]] += by_corner[:, :, corner]
    solved = frame.simulator.solve_tangent(q[None], np.moveaxis(rows.reshape(-1, *q.shape), 0, -1)[None])[0]
    return np.moveaxis(solved, -1, 0)  # the tangent is symmetric


def on_loaded_nodes(frame: FirstFrame, by_force: Array) -> Array:
    """The part of `node_force_slopes` (3 M', N, 3) by the forces on the loaded nodes [m/N], (3 M', 3 L)."""
    return by_force[:, frame.nodes].reshape(len(by_force), -1)
