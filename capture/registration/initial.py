"""The first frame: a static equilibrium under virtual forces that match the markers to the recorded ones."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.force_search import Estimate, ForcePrior, ForceSearch, node_force_slopes, on_loaded_nodes
from rafl.capture.registration.mesh_error import ASSUMED, EXACT, ErrorSizes, MeshError
from rafl.capture.registration.rigid import IDENTITY, RigidTransform

Array = NDArray[Any]

# What may load the free end: a weight that hangs from it; any force and moment, and practically nothing else; a hand
# that holds it, so that it hardly deforms (by 10 um, as little as a first frame tells); local forces, which dent it.
WEIGHT = ForcePrior("hanging weight", 1e-5, hanging=True)
PULL, HELD = ForcePrior("force and moment", 1e-5), ForcePrior("held end", 10.0, shape_sigma=1e-5)
LOCAL = tuple(ForcePrior("local forces", sigma) for sigma in (5e-3, 5e-2, 0.5))
SURFACE_PRIOR = ForcePrior("forces on the whole surface", 0.3)  # if forces act on the whole surface
# Of the body's own weight. Where E is too small by its prior's sigma, a beam on which nothing hangs seems to be pushed
# up at its tip by 3/8 (1 - exp(-0.5)) of it.
UPWARD_SHARE = 0.15
REFITS = 5  # at most, with the error of the mesh that the last fit makes most probable
SETTLED = 1.2  # ratio of standard deviations of the markers in successive fits; a smaller one ends the refits
FORCE_CHANGE = LOCAL[0]  # prior of the forces whose change gives the velocity of a body in motion
FORCE_CHANGE_RATE = 60.0  # 1/s: they change as in an oscillation of about 10 Hz


@dataclass(frozen=True)
class InitialState:
    """State of the mesh in the first frame.

    Attributes:
        q: node positions [m], (N, 3).
        force: nodal forces that balance the body with the assumed material, without gravity and the clamp [N], (N, 3).
        residual: root mean square distance between the markers and those of the mesh in equilibrium, over the observed
            axes [m].
        pose: from the frame of the target to the specimen frame; the identity if it was not fitted.
        marker_sigma: largest standard deviation of each marker's position in any direction [m], (M), whatever loads the
            body; NaN where the marker was not measured, and in fits with a pose.
        loading: what loads the body, in words.
    """

    q: Array
    force: Array
    residual: float
    pose: RigidTransform
    marker_sigma: Array
    loading: str


def fit_first_frame(frame: FirstFrame, pose: RigidTransform | None = None) -> InitialState:
    """Fit virtual forces such that the markers of the equilibrium match the first frame.

    Levenberg-Marquardt minimises (x(q(f)) - target) . R^-1 (x(q(f)) - target) + (f - f0) . C^-1 (f - f0), where R is
    the covariance of measurement and mesh, and f0 and C are mean and covariance of the forces' prior. The implicit
    function theorem gives the Jacobian through the equilibrium, dx/df = dx/dq K^-1.

    The mesh only approximates the specimen (`MeshError`); the sizes of its error are those that the fit makes most
    probable. If forces act on the free end, several priors are tried, and the one is kept under which the observation
    is most probable. Forces that dent the mesh are tried only where the mesh's error would be larger than is assumed.
    The markers' standard deviations are those of the mixture of all fits, each as probable as the observation under it.

    Args:
        frame: observation.
        pose: initial guess of the pose, if the pose is fitted too.

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    start, marker_sigma = pose or IDENTITY, np.full(len(frame.target), np.nan)
    error = MeshError.of(frame, start.apply(frame.target[frame.measured]))
    fits = [_fit_surface(frame, error, pose)] if frame.whole_surface else _fit_tip(frame, error, pose)
    best = max(fits, key=lambda fit: fit.evidence)
    search, found = best.search, best.found
    if not frame.whole_surface and pose is None:
        marker_sigma[frame.measured] = _mixed_sigma(fits, best, error)
    # What balances the shape with the assumed material; what the clamp does is no virtual force.
    force = frame.simulator.elastic_gradient(found.q[None])[0] - frame.simulator.weight
    force[frame.simulator.fixed] = 0.0
    return InitialState(found.q, force, np.sqrt(3.0) * search.rms(found), found.pose, marker_sigma, search.prior.name)


@dataclass(frozen=True)
class _Fit:
    """A fit of the first frame.

    Attributes:
        search: that found it.
        found: the loaded body.
        sizes: of the mesh's error.
        evidence: logarithm of how probable the prior, the sizes and the observation are together, up to a constant.
    """

    search: ForceSearch
    found: Estimate
    sizes: ErrorSizes
    evidence: float


def _fit_surface(frame: FirstFrame, error: MeshError, pose: RigidTransform | None) -> _Fit:
    """The fit of forces on the whole surface, which leave no error of the mesh."""
    search = ForceSearch(frame, SURFACE_PRIOR, error.whitening(EXACT), pose is not None, False, 0.0)
    found = search.minimise(np.zeros_like(frame.simulator.mesh.vertices), pose or IDENTITY, None)
    return _Fit(search, found, EXACT, 0.0)


def _fit_tip(frame: FirstFrame, error: MeshError, pose: RigidTransform | None) -> list[_Fit]:
    """The fits of forces on the free end, by what may load it.

    The material decides how far and to what shape the weight bends a body, which no force at the tip makes up for. An
    unknown pose would: the two can hardly be told apart.
    """
    first = ForceSearch(frame, PULL, error.whitening(ASSUMED), pose is not None, pose is None, 0.0)
    found = first.minimise(np.zeros_like(frame.simulator.mesh.vertices), pose or IDENTITY, None)
    fits = [_refit(first, prior, found, error) for prior in (PULL, HELD)]
    if np.any(frame.simulator.gravity) and not frame.moving:
        hung = _refit(first, WEIGHT, found, error)
        if _may_hang(frame, hung.found.force):
            fits.append(hung)
    best = max(fits, key=lambda fit: fit.evidence)
    if (best.sizes.values > ASSUMED.values).any():
        fits += [_refit(first, prior, found, error) for prior in LOCAL]
    return fits


def _mixed_sigma(fits: list[_Fit], best: _Fit, error: MeshError) -> Array:
    """Standard deviations of the measured markers about those of the best fit [m], (M'), over all fits."""
    probability = np.exp([fit.evidence - best.evidence for fit in fits])
    markers, measured = best.search.frame.markers, best.search.frame.measured
    positions = markers.positions(torch.from_numpy(np.stack([fit.found.q for fit in fits]))).numpy()[:, measured]
    middle = markers.positions(torch.from_numpy(best.found.q)).numpy()[measured]
    variance = ((positions - middle) ** 2).sum(axis=-1)
    for k, fit in enumerate(fits):
        variance[k] += fit.search.marker_sigma(fit.found) ** 2 + error.mesh_sigma(fit.sizes) ** 2
    return np.asarray(np.sqrt(probability @ variance / probability.sum()))


def _refit(first: ForceSearch, prior: ForcePrior, found: Estimate, error: MeshError) -> _Fit:
    """The fit under a prior, with the most probable error of the mesh, from that of any force and moment."""
    sizes, last = ASSUMED, np.inf
    for _ in range(REFITS):
        search = _search(first, prior, error.whitening(sizes), found)
        found = search.minimise(found.force, found.pose, found.q, found.change)
        fit = _Fit(search, found, sizes, search.log_evidence(found) + error.log_probability(sizes))
        sigma = error.total_sigma(sizes)
        if 1.0 / SETTLED < sigma / last < SETTLED:
            break
        last, sizes = sigma, error.most_probable(*search.linearised(found), sizes)
    return fit


def _search(first: ForceSearch, prior: ForcePrior, whitening: Array, found: Estimate) -> ForceSearch:
    """The search for the same unknowns under another prior; a weight that hangs is about the one found."""
    pull = _pull(first.frame, found.force)
    return ForceSearch(first.frame, prior, whitening, first.with_pose, first.with_material, pull)


def _pull(frame: FirstFrame, force: Array) -> float:
    """The sum of forces (N, 3) along gravity [N]; zero without gravity."""
    gravity = np.asarray(frame.simulator.gravity)
    return float(force.sum(axis=0) @ gravity / max(np.linalg.norm(gravity), np.finfo(float).tiny))


def _may_hang(frame: FirstFrame, force: Array) -> bool:
    """Whether forces (N, 3) may be those of a weight, or of none, which do not push upwards."""
    return _pull(frame, force) > -UPWARD_SHARE * _pull(frame, frame.simulator.weight)


@dataclass(frozen=True)
class ResultantFit:
    """A fit of the first frame by a force and a moment on the nodes.

    Attributes:
        force: virtual nodal forces [N], (N, 3).
        q: node positions [m], (N, 3).
        residual: markers of the mesh minus measured markers along their axes [m], (3 M').
        by_force: derivatives of the measured markers, along their axes, by forces on all nodes [m/N], (3 M', N, 3).
        whitening: of the residuals in the objective [1/m], (K, 3 M').
        jacobian: derivatives of the whitened residuals by the amplitudes of the n modes [1/N], (K, n).
        amplitude: of the modes, less their expected values [N], (n).
        prior: of the force and the moment.
    """

    force: Array
    q: Array
    residual: Array
    by_force: Array
    whitening: Array
    jacobian: Array
    amplitude: Array
    prior: ForcePrior

    def most_probable_prior(self, frame: FirstFrame, shared: Array) -> ForcePrior:
        """A hanging weight or any force, whichever is more probable near this fit.

        shared: whitened derivatives of the residuals by numbers of mean zero and variance one that all first frames
            have in common, (K, S).
        """
        if not _may_hang(frame, self.force):
            return PULL
        pull = _pull(frame, self.force)
        residual = self.whitening @ self.residual - self.jacobian @ self.amplitude
        known = np.eye(len(residual)) + shared @ shared.T

        def log_evidence(prior: ForcePrior) -> float:
            by_force = self.jacobian @ np.linalg.solve(prior.resultant_precision(frame, pull), self.jacobian.T)
            covariance = known + by_force
            spread = np.linalg.slogdet(covariance)[1]
            return float(-0.5 * (residual @ np.linalg.solve(covariance, residual) + spread))

        return max((PULL, WEIGHT), key=log_evidence)


def fit_resultant(
    frame: FirstFrame, model_sigma: float, start: ResultantFit | None = None, prior: ForcePrior = PULL
) -> ResultantFit:
    """Fit a force and a moment, from an earlier fit.

    Args:
        frame: observation.
        model_sigma: standard deviation of the difference between mesh and specimen [m].
        start: earlier fit.
        prior: of the force and the moment; a weight that hangs is about the one of the earlier fit.

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    sigma = np.hypot(frame.sigma[frame.measured], model_sigma)
    weight = np.where(frame.observed_axes, 1.0 / sigma, 0.0).ravel()
    force = np.zeros_like(frame.simulator.mesh.vertices)
    force[frame.nodes] = frame.expected_force().reshape(-1, 3)
    if start is not None:
        force = start.force
    search = ForceSearch(frame, prior, np.diag(weight), False, False, _pull(frame, force))
    found = search.minimise(force, IDENTITY, start.q if start else None)
    modes, _ = frame.resultant_modes()
    by_force = node_force_slopes(frame, found.q)
    jacobian = search.whitening @ on_loaded_nodes(frame, by_force) @ modes
    amplitude = modes.T @ (found.force[frame.nodes].ravel() - frame.expected_force())
    return ResultantFit(found.force, found.q, found.residual, by_force, search.whitening, jacobian, amplitude, prior)


def resultant_jacobian(frame: FirstFrame, fit: ResultantFit) -> tuple[Array, Array]:
    """Weighted residuals (3 M' + n) of markers and of the forces' prior, and their derivatives by the amplitudes.

    Returns:
        The derivatives by the amplitudes of the n modes, (3 M' + n, n), and the residuals.
    """
    root = np.linalg.cholesky(fit.prior.resultant_precision(frame, _pull(frame, fit.force))).T
    residual = np.concatenate([fit.whitening @ fit.residual, root @ fit.amplitude])
    return np.concatenate([fit.jacobian, root]), residual


def fit_velocity(frame: FirstFrame, q: Array, velocity: Array, sigma: Array) -> Array:
    """Node velocities [m/s], (N, 3), that match marker velocities, as if the virtual forces changed over time.

    Args:
        frame: observation, and the nodes on which forces act.
        q: the mesh in the first frame [m], (N, 3).
        velocity, sigma: velocities of the markers and their sigmas [m/s], (M, 3); NaN and infinite if unknown.
    """
    jacobian = on_loaded_nodes(frame, node_force_slopes(frame, q))
    velocity = frame.along_axes(np.where(np.isfinite(velocity), velocity, 0.0)[frame.measured]).ravel()
    if frame.axes is not None:
        sigma = np.where(np.isfinite(frame.sigma), np.sqrt((frame.axes**2 @ sigma[..., None] ** 2)[..., 0]), np.inf)
    sigma = sigma[frame.measured].ravel()
    known = np.isfinite(sigma)
    weight = 1.0 / sigma[known]
    weighted = weight[:, None] * jacobian[known]
    own = SURFACE_PRIOR if frame.whole_surface else FORCE_CHANGE
    prior = own.precision(frame, 0.0) / FORCE_CHANGE_RATE**2
    gradient = weighted.T @ (weight * velocity[known])
    force_rate = np.zeros_like(q)
    force_rate[frame.nodes] = np.linalg.solve(weighted.T @ weighted + prior, gradient).reshape(-1, 3)
    return np.asarray(frame.simulator.solve_tangent(q[None], force_rate[None])[0])
