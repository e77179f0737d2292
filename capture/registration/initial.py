"""The first frame: a static equilibrium under virtual forces that match the markers to the recorded ones."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.registration.first_frame import MODEL_FRACTION, FirstFrame
from rafl.capture.registration.force_search import (
    Estimate,
    ForcePrior,
    ForceSearch,
    marker_jacobian,
)
from rafl.capture.registration.rigid import IDENTITY, RigidTransform

Array = NDArray[Any]

# A load hangs from the free end, and practically only its force and moment act; or a hand holds the end, so that it
# hardly deforms (by 10 um, as little as a first frame tells), under any forces; or forces are local, and dent the mesh.
HUNG, HELD = ForcePrior("hanging load", 1e-5), ForcePrior("held end", 10.0, shape_sigma=1e-5)
LOCAL = tuple(ForcePrior("local forces", sigma) for sigma in (5e-3, 5e-2, 0.5))
SURFACE_PRIOR = ForcePrior("forces on the whole surface", 0.3)  # if forces act on the whole surface
REFITS = 5  # at most, with the model's error that the last fit left
SETTLED = 1.2  # ratio of standard deviations of the observation in successive fits; a smaller one ends the refits
HANGING_ODDS = 3.0  # logarithm of how much likelier a hanging load is beforehand than forces of another kind
EXPLAINED = 1.2  # root mean square residual over sigma of a fit that leaves nothing for other forces to explain
FORCE_CHANGE = LOCAL[0]  # prior of the forces whose change gives the velocity of a body in motion
FORCE_CHANGE_RATE = 60.0  # 1/s: they change as in an oscillation of about 10 Hz


@dataclass(frozen=True)
class InitialState:
    """State of the mesh in the first frame.

    Attributes:
        q: node positions [m], (N, 3).
        force: virtual nodal forces, without gravity [N], (N, 3).
        residual: root mean square marker distance over the observed axes [m].
        pose: from the frame of the target to the specimen frame; the identity if it was not fitted.
        marker_sigma: largest standard deviation of each marker's position in any direction [m], (M); NaN where the
            marker was not measured, and in fits with a pose.
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

    Levenberg-Marquardt minimises sum |x(q(f)) - target|^2 / (sigma^2 + s^2) + (f - f0) . C^-1 (f - f0), where f0 and C
    are mean and covariance of the forces' prior. The implicit function theorem gives the Jacobian through the
    equilibrium, dx/df = dx/dq K^-1.

    The mesh only approximates the specimen, by s, which is what a fit leaves beyond sigma. If forces act on the free
    end, several priors are tried, and the one is kept under which the observation is most probable. Forces that dent
    the mesh so pay for themselves only where they explain more than an error of the mesh does.

    Args:
        frame: observation.
        pose: initial guess of the pose, if the pose is fitted too.

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    with_pose, zero = pose is not None, np.zeros_like(frame.simulator.mesh.vertices)
    marker_sigma = np.full(len(frame.target), np.nan)
    if frame.whole_surface:
        search = ForceSearch(frame, SURFACE_PRIOR, 0.0, with_pose, False)
        best = search.minimise(zero, pose or IDENTITY, None)
    else:
        # The modulus decides how far the weight bends a body, which no force at the tip makes up for. An unknown pose
        # would: the two can hardly be told apart.
        with_modulus = not with_pose
        first = ForceSearch(frame, HUNG, _assumed_error(frame, pose), with_pose, with_modulus)
        search, best = _choose(first, first.minimise(zero, pose or IDENTITY, None))
        if with_modulus:
            marker_sigma[frame.measured] = search.marker_sigma(best)
    weight = frame.simulator.weight
    # With the assumed modulus, the same shape needs forces that are larger by the ratio of the moduli.
    force = np.exp(-best.log_modulus) * (weight + best.force) - weight
    return InitialState(best.q, force, np.sqrt(3.0) * search.rms(best), best.pose, marker_sigma, search.prior.name)


def _assumed_error(frame: FirstFrame, pose: RigidTransform | None) -> float:
    """The error of the mesh from which the search starts [m], by the deflection that was measured.

    Without it, a mesh that cannot match the markers would be bent by forces and a modulus out of all proportion.
    """
    target = frame.target[frame.measured] if pose is None else pose.apply(frame.target[frame.measured])
    moved = frame.along_axes(target - frame.markers.rest[frame.measured])[frame.observed_axes]
    return MODEL_FRACTION * float(np.sqrt((moved**2).mean()))


def _choose(first: ForceSearch, found: Estimate) -> tuple[ForceSearch, Estimate]:
    """The most probable fit; forces that dent the mesh are tried only if no others explain the observation.

    first, found: the fit to a hanging load, of a mesh with the error that is assumed.
    """
    fits = [_refit(first, HUNG, found), _refit(first, HELD, found)]
    search, best = _most_probable(fits)
    if search.residual_sigmas(best) < EXPLAINED:
        return search, best
    return _most_probable([*fits, *(_refit(first, prior, found) for prior in LOCAL)])


def _most_probable(fits: list[tuple[ForceSearch, Estimate]]) -> tuple[ForceSearch, Estimate]:
    odds = [HANGING_ODDS if search.prior is HUNG else 0.0 for search, _ in fits]
    evidence = [search.log_evidence(found) + odd for (search, found), odd in zip(fits, odds, strict=True)]
    return fits[int(np.argmax(evidence))]


def _refit(first: ForceSearch, prior: ForcePrior, found: Estimate) -> tuple[ForceSearch, Estimate]:
    """The fit under a prior, with the model's error that this fit leaves, from that to a hanging load."""
    last = np.inf
    for _ in range(REFITS):
        search = first.with_prior(prior, first.model_error(found))
        found = search.minimise(found.force, found.pose, found.q, found.log_modulus)
        sigma = search.observation_sigma
        if last < SETTLED * sigma:
            break
        last = sigma
    return search, found


@dataclass(frozen=True)
class ResultantFit:
    """A fit of the first frame by a force and a moment on the nodes.

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


def fit_resultant(frame: FirstFrame, model_sigma: float, start: ResultantFit | None = None) -> ResultantFit:
    """Fit a force and a moment, from an earlier fit.

    model_sigma: standard deviation of the difference between mesh and specimen [m].

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    search = ForceSearch(frame, HUNG, model_sigma, False, False)
    force = np.zeros_like(frame.simulator.mesh.vertices)
    force[frame.nodes] = frame.expected_force().reshape(-1, 3)
    if start is not None:
        force = start.force
    found = search.minimise(force, IDENTITY, start.q if start else None)
    return ResultantFit(found.force, found.q, found.residual, search.weight)


def resultant_jacobian(frame: FirstFrame, fit: ResultantFit) -> tuple[Array, Array]:
    """Weighted residuals (3 M' + n) of markers and of the forces' prior, and their derivatives by the amplitudes.

    Returns:
        The derivatives by the amplitudes of the n modes, (3 M' + n, n), and the residuals.
    """
    modes, sigma = frame.resultant_modes()
    prior = 1.0 / sigma
    amplitude = modes.T @ (fit.force[frame.nodes].ravel() - frame.expected_force())
    jacobian = fit.weight[:, None] * (marker_jacobian(frame, fit.q) @ modes)
    return np.concatenate([jacobian, np.diag(prior)]), np.concatenate([fit.weight * fit.residual, prior * amplitude])


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
    own = SURFACE_PRIOR if frame.whole_surface else FORCE_CHANGE
    prior = own.precision(frame) / FORCE_CHANGE_RATE**2
    gradient = weighted.T @ (weight * velocity[known])
    force_rate = np.zeros_like(q)
    force_rate[frame.nodes] = np.linalg.solve(weighted.T @ weighted + prior, gradient).reshape(-1, 3)
    return np.asarray(frame.simulator.solve_tangent(q[None], force_rate[None])[0])
