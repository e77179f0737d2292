"""Places of the markers on the undeformed body, found from the first frames of all recordings together."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.registration.initial import FirstFrame, LinearFit, fit_linear_forces, linear_jacobian
from rafl.capture.registration.rigid import RigidTransform
from rafl.data.markers import Markers, embed

Array = NDArray[Any]

MODULUS_SIGMA = 0.5  # prior standard deviation of log E around the assumed material
MIN_PRIOR_SIGMA = 1e-9  # of a place that is exactly known [m]
MAX_MODULUS_STEP = 0.3  # of log E in one iteration
MAX_ITERATIONS = 10
STEP_TOLERANCE = 1e-6  # [m]; the search ends with a smaller change of every place
# The mesh follows the shape of a bent specimen to about this fraction of its deflection, and not closer than this
# distance [m]. The error is alike in all recordings, so that more of them do not average it out.
MODEL_FRACTION, MIN_MODEL_SIGMA = 0.01, 1e-5


def find_places(frames: list[FirstFrame], poses: list[RigidTransform | None], prior_sigma: Array) -> Markers:
    """The markers at the places that the first frames of several recordings of one specimen show.

    A marker's place is the same in all recordings, while forces and poses differ. Gauss-Newton minimises over places,
    log E, and for every recording the virtual forces that vary linearly over their nodes, and the pose where it is
    fitted too:

        sum |x - target|^2 / (sigma^2 + R model_sigma^2) + sum |moved|^2 / prior_sigma^2 + the forces' prior + E's prior

    with R recordings, and a model_sigma that follows from the deflection (`MODEL_FRACTION`). The forces and poses are
    eliminated recording by recording (Schur complement).

    Args:
        frames: observations, with the markers embedded at their places in the layout.
        poses: initial poses where the pose is fitted too, else None, one for each frame.
        prior_sigma: standard deviations of the places in the layout [m], (M).

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    layout, simulator = frames[0].markers, frames[0].simulator
    count, log_modulus, markers = len(layout.names), 0.0, layout
    moved = np.zeros((count, 3))
    fits: list[LinearFit | None] = [None] * len(frames)
    model_sigma = float(prior_sigma.max())  # until the deflection is known
    by_place = np.repeat(np.maximum(prior_sigma, MIN_PRIOR_SIGMA) ** -2.0, 3)
    precision = np.concatenate([[MODULUS_SIGMA**-2.0], by_place])
    for _ in range(MAX_ITERATIONS):
        modulus = simulator.material.youngs_modulus * np.exp(log_modulus)
        softened = replace(simulator, material=replace(simulator.material, youngs_modulus=modulus))
        current = [replace(frame, simulator=softened, markers=markers) for frame in frames]
        hessian, gradient = np.diag(precision), precision * np.concatenate([[log_modulus], moved.ravel()])
        deflection = []
        for k, (frame, pose) in enumerate(zip(current, poses, strict=True)):
            fit = fit_linear_forces(frame, pose, model_sigma, fits[k])
            fits[k] = fit
            own_hessian, own_gradient = _reduced_normal_equations(frame, fit, pose is not None)
            hessian += own_hessian
            gradient += own_gradient
            deflection.append(markers.positions(torch.from_numpy(fit.q)).numpy() - markers.rest)
        step = -np.linalg.solve(hessian, gradient)
        log_modulus += float(np.clip(step[0], -MAX_MODULUS_STEP, MAX_MODULUS_STEP))
        moved = moved + step[1:].reshape(-1, 3)
        markers = embed(simulator.mesh, layout.names, layout.rest + moved)
        size = float(np.sqrt(np.mean(np.square(deflection).sum(-1))))
        model_sigma = float(np.sqrt(len(frames))) * max(MODEL_FRACTION * size, MIN_MODEL_SIGMA)
        if np.abs(step[1:]).max() < STEP_TOLERANCE:
            break
    covariance = np.linalg.inv(hessian)
    sigma = np.sqrt(np.diag(covariance))
    return replace(markers, moved=moved, place_sigma=sigma[1:].reshape(-1, 3))


def _reduced_normal_equations(frame: FirstFrame, fit: LinearFit, with_pose: bool) -> tuple[Array, Array]:
    """Half the Hessian and half the gradient of one recording's part by (log E, places), less forces and pose."""
    local, prior, slope = linear_jacobian(frame, fit, with_pose)
    rows = np.flatnonzero(np.repeat(frame.measured, 3))
    whole = np.zeros((3 * len(frame.target), 1 + 3 * len(frame.target)))
    q = torch.from_numpy(fit.q)
    gain = frame.markers.axes(q) @ torch.linalg.inv(frame.markers.axes(torch.from_numpy(frame.simulator.mesh.vertices)))
    for m, own in enumerate(gain.numpy()):
        whole[3 * m : 3 * m + 3, 1 + 3 * m : 4 + 3 * m] = own
    # The internal forces are proportional to E, and in equilibrium equal to the weight and the virtual forces.
    by_modulus = -frame.simulator.solve_tangent(fit.q[None], (frame.simulator.weight + fit.force)[None])[0]
    corners = frame.markers.corner_jacobian(q).numpy()
    whole[:, 0] = np.einsum("micj,mcj->mi", corners, by_modulus[frame.markers.quad]).ravel()
    shared = fit.weight[:, None] * whole[rows]
    inverse = np.linalg.inv(local.T @ local + prior)
    residual = fit.weight * fit.residual
    mixed = local.T @ shared
    hessian = shared.T @ shared - mixed.T @ inverse @ mixed
    gradient = shared.T @ residual - mixed.T @ inverse @ (local.T @ residual + slope)
    return hessian, gradient
