"""The first frame: a static equilibrium under virtual forces that match the markers to the recorded ones."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.registration.first_frame import FirstFrame, linear_modes
from rafl.capture.registration.rigid import IDENTITY, RigidTransform
from rafl.common.errors import SimulationError
from rafl.data.views import pose_jacobian

Array = NDArray[Any]

# Prior sigmas of the local part of a nodal force [N]: what does not vary linearly over the nodes would dent the mesh to
# match single markers. It is fitted three times: practically without it, with little of it, and with more, which is
# kept if it halves the remaining residual.
LOCAL_FORCE_SIGMAS = 1e-5, 5e-3, 5e-2
SURFACE_FORCE_SIGMA = 0.3  # of the local part, if forces act on the whole surface [N]
INITIAL_DAMPING, MAX_DAMPING = 1e4, 1e16  # of a Levenberg-Marquardt step, as a multiple of the prior
MAX_ITERATIONS = 100
FORCE_CHANGE_RATE = 60.0  # 1/s: forces change as in an oscillation of about 10 Hz
# The search ends if a step promises or gives a smaller decrease: relative to the objective, plus absolute.
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-4, 1e-3
MODULUS_SIGMA = 0.5  # prior standard deviation of log E around the assumed material


@dataclass(frozen=True)
class InitialState:
    """State of the mesh in the first frame.

    Attributes:
        q: node positions [m], (N, 3).
        force: virtual nodal forces, without gravity [N], (N, 3).
        residual: root mean square marker distance over the observed axes [m].
        pose: from the frame of the target to the specimen frame; the identity if it was not fitted.
        marker_sigma: largest standard deviation of each marker's position in any direction [m], (M); NaN where the
            marker was not measured, and in fits without Young's modulus.
    """

    q: Array
    force: Array
    residual: float
    pose: RigidTransform
    marker_sigma: Array


def fit_first_frame(frame: FirstFrame, pose: RigidTransform | None = None) -> InitialState:
    """Fit virtual forces such that the markers of the equilibrium match the first frame.

    Levenberg-Marquardt minimises sum |x(q(f)) - target|^2 / sigma^2 + (f - f0) . C^-1 (f - f0), where f0 and C are
    mean and covariance of the forces' prior. The implicit function theorem gives the Jacobian through the equilibrium,
    dx/df = dx/dq K^-1.

    The mesh only approximates the specimen. If forces act on the free end, the first fit allows only forces that vary
    linearly over the nodes. Its residual beyond sigma is added to sigma in the fits that follow, so that they do not
    dent the mesh to match markers that it cannot match.

    Args:
        frame: observation.
        pose: initial guess of the pose, if the pose is fitted too.

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    with_pose, zero = pose is not None, np.zeros_like(frame.simulator.mesh.vertices)
    marker_sigma = np.full(len(frame.target), np.nan)
    if frame.whole_surface:
        search = _LevenbergMarquardt(frame, with_pose, SURFACE_FORCE_SIGMA, 0.0)
        best = search.minimise(zero, pose or IDENTITY, None)
    else:
        least, little, more = LOCAL_FORCE_SIGMAS
        # The modulus decides how far the weight bends a body, which no force at the tip makes up for. An unknown pose
        # would: the two can hardly be told apart. So would positions in a plane that is assumed, not measured.
        with_modulus = not with_pose and (frame.axes is not None or bool(frame.observed_axes.all()))
        first = _LevenbergMarquardt(frame, with_pose, least, 0.0, with_modulus).minimise(zero, pose or IDENTITY, None)
        sigma = frame.sigma[frame.measured][frame.observed_axes]
        model_sigma = np.sqrt(max(_rms(frame, first.residual) ** 2 - float((sigma**2).mean()), 0.0))

        def refine(local_sigma: float, start: _Estimate) -> tuple[_LevenbergMarquardt, _Estimate]:
            search = _LevenbergMarquardt(frame, with_pose, local_sigma, model_sigma, with_modulus)
            return search, search.minimise(start.force, start.pose, start.q, start.log_modulus)

        search, best = refine(little, first)
        other, trial = refine(more, best)
        if _rms(frame, trial.residual) < 0.5 * _rms(frame, best.residual):
            search, best = other, trial
        if with_modulus:
            marker_sigma[frame.measured] = search.marker_sigma(best)
    weight = frame.simulator.weight
    # With the assumed modulus, the same shape needs forces that are larger by the ratio of the moduli.
    force = np.exp(-best.log_modulus) * (weight + best.force) - weight
    return InitialState(best.q, force, np.sqrt(3.0) * _rms(frame, best.residual), best.pose, marker_sigma)


def _softened(frame: FirstFrame, log_modulus: float) -> FirstFrame:
    """The frame with another Young's modulus, by the logarithm of its ratio to the assumed one."""
    if log_modulus == 0.0:
        return frame
    material = frame.simulator.material
    modulus = material.youngs_modulus * float(np.exp(log_modulus))
    return replace(frame, simulator=replace(frame.simulator, material=replace(material, youngs_modulus=modulus)))


def modulus_slope(frame: FirstFrame, q: Array, force: Array) -> Array:
    """Derivatives of the measured markers by log E at an equilibrium q (N, 3) under forces (N, 3) [m], (M', 3).

    The internal forces are proportional to E, and in equilibrium equal to the weight and the virtual forces.
    """
    by_modulus = -frame.simulator.solve_tangent(q[None], (frame.simulator.weight + force)[None])[0]
    corners = frame.markers.corner_jacobian(torch.from_numpy(q)).numpy()
    slope: Array = np.einsum("micj,mcj->mi", corners, by_modulus[frame.markers.quad])[frame.measured]
    return slope


@dataclass(frozen=True)
class LinearFit:
    """A fit of the first frame by virtual forces that vary linearly over their nodes.

    Attributes:
        force: virtual nodal forces [N], (N, 3).
        q: node positions [m], (N, 3).
        residual: markers of the mesh minus measured markers along their axes [m], (3 M').
        weight: of the residuals in the objective [1/m], (3 M').
    """

    force: Array
    q: Array
    residual: Array
    weight: Array


def fit_linear_forces(frame: FirstFrame, model_sigma: float, start: LinearFit | None = None) -> LinearFit:
    """Fit forces that vary linearly over the nodes, from an earlier fit.

    model_sigma: standard deviation of the difference between mesh and specimen [m].

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    search = _LevenbergMarquardt(frame, False, LOCAL_FORCE_SIGMAS[0], model_sigma)
    force = np.zeros_like(frame.simulator.mesh.vertices)
    force[frame.nodes] = frame.expected_force().reshape(-1, 3)
    if start is not None:
        force = start.force
    found = search.minimise(force, IDENTITY, start.q if start else None)
    return LinearFit(found.force, found.q, found.residual, search.weight)


def linear_jacobian(frame: FirstFrame, fit: LinearFit) -> tuple[Array, Array]:
    """Weighted residuals (3 M' + n) of the markers and of the forces' prior, and their derivatives by the linear modes.

    Returns:
        The derivatives by the amplitudes of the n modes, (3 M' + n, n), and the residuals.
    """
    modes = np.kron(linear_modes(frame.simulator.mesh.vertices[frame.nodes]), np.eye(3))
    prior = np.repeat(1.0 / frame.linear_force_sigma(), 3)
    amplitude = modes.T @ (fit.force[frame.nodes].ravel() - frame.expected_force())
    jacobian = fit.weight[:, None] * (marker_jacobian(frame, fit.q) @ modes)
    return np.concatenate([jacobian, np.diag(prior)]), np.concatenate([fit.weight * fit.residual, prior * amplitude])


def _rms(frame: FirstFrame, residual: Array) -> float:
    """Root mean square of the residuals (3 M') along observed axes [m]."""
    return float(np.sqrt((residual.reshape(-1, 3)[frame.observed_axes] ** 2).mean()))


@dataclass(frozen=True)
class _Estimate:
    frame: FirstFrame  # with a simulator of the modulus that is tried
    log_modulus: float  # logarithm of that modulus over the assumed one
    force: Array  # [N], (N, 3)
    pose: RigidTransform
    q: Array  # [m], (N, 3)
    residual: Array  # markers of the mesh minus measured markers along their axes [m], (3 M')
    objective: float


class _LevenbergMarquardt:
    """One minimisation.

    Args:
        frame: observation.
        with_pose: whether the pose is fitted too.
        local_sigma: prior sigma of the local part of the forces [N].
        model_sigma: of the difference between mesh and specimen [m].
        with_modulus: whether Young's modulus is fitted too, around the assumed one.
    """

    def __init__(
        self,
        frame: FirstFrame,
        with_pose: bool,
        local_sigma: float,
        model_sigma: float,
        with_modulus: bool = False,
    ) -> None:
        self.frame, self.with_pose, self.with_modulus = frame, with_pose, with_modulus
        precision = force_precision(frame, local_sigma)
        self.prior = np.kron(precision, np.eye(3))
        self.expected = frame.expected_force()
        self.weight = 1.0 / np.sqrt(frame.sigma[frame.measured].ravel() ** 2 + model_sigma**2)

    def evaluate(self, force: Array, pose: RigidTransform, start: Array | None, log_modulus: float) -> _Estimate:
        """Equilibrium, residual and objective, with the solve started at `start` (N, 3) if given."""
        frame = _softened(self.frame, log_modulus)
        simulator = frame.simulator
        total, label = (simulator.weight + force)[None], f"{frame.recording}: first frame"
        if start is None:
            q = simulator.equilibrium(total, label=label)[0]
        else:  # `minimise` fails at once where `equilibrium` would increase the load in small steps
            zero = np.zeros(total.shape[:2])
            q = simulator.minimise(start[None], zero, start[None], total, simulator.constitutive_state(1), label)[0]
        positions = frame.markers.positions(torch.from_numpy(q)).numpy()[frame.measured]
        residual = frame.along_axes(positions - pose.apply(frame.target[frame.measured])).ravel()
        f = force[frame.nodes].ravel() - self.expected
        by_prior = f @ self.prior @ f + (log_modulus / MODULUS_SIGMA) ** 2
        objective = float(((self.weight * residual) ** 2).sum() + by_prior)
        return _Estimate(frame, log_modulus, force, pose, q, residual, objective)

    def minimise(self, force: Array, pose: RigidTransform, start: Array | None, log_modulus: float = 0.0) -> _Estimate:
        """Best estimate, from initial forces (N, 3), pose, node positions (N, 3) and modulus."""
        current = self.evaluate(force, pose, start, log_modulus)
        damping, growth = INITIAL_DAMPING, 2.0  # updated as by H. B. Nielsen
        for _ in range(MAX_ITERATIONS):
            gradient, hessian = self._normal_equations(current)
            if gradient @ np.linalg.solve(hessian, gradient) < self._tolerance(current):
                break
            damping_matrix, decrease = self._damping_matrix(hessian), -np.inf
            while decrease <= 0.0 and damping <= MAX_DAMPING:
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
                else:
                    damping, growth = damping * growth, 2.0 * growth
            if decrease <= 0.0:
                break
            current = trial
            if decrease < self._tolerance(current):
                break
        return current

    @staticmethod
    def _tolerance(current: _Estimate) -> float:
        return RELATIVE_TOLERANCE * current.objective + ABSOLUTE_TOLERANCE

    def _normal_equations(self, current: _Estimate) -> tuple[Array, Array]:
        """Half the gradient and half the Gauss-Newton Hessian by forces (3 L) and, if fitted, the pose (6) or log E."""
        jacobian = self._marker_slopes(current)
        if self.with_pose:
            posed = current.pose.apply(self.frame.target[self.frame.measured])
            jacobian = np.concatenate([jacobian, -pose_jacobian(posed).reshape(-1, 6)], axis=1)
        jacobian *= self.weight[:, None]
        gradient, hessian = jacobian.T @ (self.weight * current.residual), jacobian.T @ jacobian
        count = len(self.prior)
        gradient[:count] += self.prior @ (current.force[self.frame.nodes].ravel() - self.expected)
        hessian[:count, :count] += self.prior
        if self.with_modulus:
            gradient[-1] += current.log_modulus / MODULUS_SIGMA**2
            hessian[-1, -1] += MODULUS_SIGMA**-2.0
        return gradient, hessian

    def _marker_slopes(self, current: _Estimate) -> Array:
        """Derivatives of the measured markers, along their axes, by forces and, if fitted, log E, (3 M', 3 L [+ 1])."""
        slopes = marker_jacobian(current.frame, current.q)
        if self.with_modulus:
            by_modulus = self.frame.along_axes(modulus_slope(current.frame, current.q, current.force))
            slopes = np.concatenate([slopes, by_modulus.reshape(-1, 1)], axis=1)
        return slopes

    def marker_sigma(self, found: _Estimate) -> Array:
        """Largest standard deviations of the measured markers [m], (M'), in a fit without a pose.

        By Laplace's approximation: the covariance of forces and log E is the inverse of the Gauss-Newton Hessian.
        """
        slopes = self._marker_slopes(found)
        by_unknowns = slopes.reshape(-1, 3, slopes.shape[1])
        solved = np.linalg.solve(self._normal_equations(found)[1], slopes.T).T.reshape(by_unknowns.shape)
        sigma: Array = np.sqrt(np.linalg.eigvalsh(by_unknowns @ solved.swapaxes(1, 2))[:, -1])
        return sigma

    def _damping_matrix(self, hessian: Array) -> Array:
        """The prior of the forces; for the pose, which has no prior, a small multiple of its Hessian diagonal."""
        matrix, count = np.diag(1e-6 * np.diag(hessian)), len(self.prior)
        matrix[:count, :count] = self.prior
        if self.with_modulus:
            matrix[-1, -1] = MODULUS_SIGMA**-2.0
        return matrix

    def _take_step(self, current: _Estimate, step: Array) -> _Estimate:
        force, count = current.force.copy(), len(self.prior)
        force[self.frame.nodes] += step[:count].reshape(-1, 3)
        pose = current.pose.followed_by(step[count : count + 6]) if self.with_pose else current.pose
        log_modulus = current.log_modulus + float(step[-1]) if self.with_modulus else current.log_modulus
        return self.evaluate(force, pose, current.q, log_modulus)


def fit_velocity(frame: FirstFrame, q: Array, velocity: Array, sigma: Array) -> Array:
    """Node velocities [m/s], (N, 3), that match marker velocities, as if the virtual forces changed over time.

    Args:
        frame: observation, and the nodes on which forces act.
        q: the mesh in the first frame [m], (N, 3).
        velocity, sigma: velocities of the markers and their sigmas [m/s], (M, 3); NaN and infinite if unknown.
    """
    jacobian = marker_jacobian(frame, q)
    velocity = frame.along_axes(np.where(np.isfinite(velocity), velocity, 0.0)[frame.measured]).ravel()
    if frame.axes is not None:
        sigma = np.where(np.isfinite(frame.sigma), np.sqrt((frame.axes**2 @ sigma[..., None] ** 2)[..., 0]), np.inf)
    sigma = sigma[frame.measured].ravel()
    known = np.isfinite(sigma)
    weight = 1.0 / sigma[known]
    weighted = weight[:, None] * jacobian[known]
    local = SURFACE_FORCE_SIGMA if frame.whole_surface else LOCAL_FORCE_SIGMAS[1]
    precision = force_precision(frame, local)
    prior = np.kron(precision, np.eye(3)) / FORCE_CHANGE_RATE**2
    gradient = weighted.T @ (weight * velocity[known])
    force_rate = np.zeros_like(q)
    force_rate[frame.nodes] = np.linalg.solve(weighted.T @ weighted + prior, gradient).reshape(-1, 3)
    return np.asarray(frame.simulator.solve_tangent(q[None], force_rate[None])[0])


def force_precision(frame: FirstFrame, local_sigma: float) -> Array:
    """Inverse prior covariance [1/N^2], (L, L), of one component of the forces on the frame's nodes."""
    modes = linear_modes(frame.simulator.mesh.vertices[frame.nodes])
    linear = (modes * frame.linear_force_sigma() ** -2.0) @ modes.T
    precision: Array = linear + (np.eye(len(modes)) - modes @ modes.T) / local_sigma**2
    return precision


def marker_jacobian(frame: FirstFrame, q: Array) -> Array:
    """Derivatives of the measured markers, along their axes, by the forces on the nodes [m/N], (3 M', 3 L).

    q: equilibrium [m], (N, 3).
    """
    measured = np.flatnonzero(frame.measured)
    by_corner = frame.along_axes(frame.markers.corner_jacobian(torch.from_numpy(q)).numpy()[measured])  # (M', 3, 4, 3)
    rows = np.zeros((len(measured), 3, *q.shape))
    for corner in range(4):
        rows[np.arange(len(measured)), :, frame.markers.quad[measured, corner]] += by_corner[:, :, corner]
    solved = frame.simulator.solve_tangent(q[None], np.moveaxis(rows.reshape(-1, *q.shape), 0, -1)[None])[0]
    jacobian: Array = np.moveaxis(solved[frame.nodes], -1, 0).reshape(3 * len(measured), -1)
    return jacobian
