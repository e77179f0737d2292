"""Places of the markers on the undeformed body and an unknown frame, from the first frames of all recordings."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.registration.first_frame import MODEL_FRACTION, FirstFrame
from rafl.capture.registration.initial import PULL, ResultantFit, fit_resultant, resultant_jacobian
from rafl.capture.registration.material_change import MATERIAL_SIGMA, UNCHANGED, material_loads, with_changed_material
from rafl.capture.registration.rigid import RigidTransform
from rafl.data.markers import Markers, embed
from rafl.data.views import pose_jacobian

Array = NDArray[Any]

MIN_PRIOR_SIGMA = 1e-8  # of a place that is exactly known [m]
MAX_MATERIAL_STEP = 0.6  # of the change of the material in one iteration [standard deviations of its prior]
MAX_ITERATIONS = 15
# The mesh follows no specimen closer than this distance [m], nor than MODEL_FRACTION of its deflection. The error is
# alike in all recordings, so that more of them do not average it out.
MIN_MODEL_SIGMA = 1e-5
# The search ends with a smaller step of every place [m], of the material [standard deviations of its prior], and of the
# pose [rad, m].
STEP_TOLERANCE, MATERIAL_TOLERANCE, POSE_TOLERANCE = 1e-6, 2e-3, 1e-5


@dataclass(frozen=True)
class Places:
    """What the first frames of several recordings show together.

    Attributes:
        markers: at their places.
        pose: from an unknown frame to the specimen frame; the initial one if none was unknown.
        pose_covariance: of a rotation vector and a translation applied after the pose [rad, m], (6, 6).
        modulus: Young's modulus [Pa].
        modulus_sigma: standard deviation of its logarithm.
    """

    markers: Markers
    pose: RigidTransform
    pose_covariance: Array
    modulus: float
    modulus_sigma: float


def find_places(frames: list[FirstFrame], unknown: list[bool], pose: RigidTransform, prior_sigma: Array) -> Places:
    """Places of the markers, and an unknown pose, from the first frames of several recordings of one specimen.

    A marker's place is the same in all recordings, and so is the frame of the recordings whose frame is unknown, while
    forces differ. Gauss-Newton minimises over the material (`material_change`), the pose and the places, and for
    every recording the virtual force and moment:

        sum |x - target|^2 / (sigma^2 + R model_sigma^2) + sum |moved|^2 / prior_sigma^2 + priors of forces and material

    with R recordings, and a model_sigma of each that follows from its deflection (`MODEL_FRACTION`). The forces are
    eliminated recording by recording. They may be those of a hanging weight (`ResultantFit.most_probable_prior`):
    sideways forces that nobody exerted would move the places. A pose and an unknown force can hardly be told apart, nor
    then can E; known loads decide (`FirstFrame.load`).

    Args:
        frames: observations, with the markers embedded at their places in the layout.
        unknown: which targets are in the unknown frame.
        pose: initial guess of the unknown pose.
        prior_sigma: standard deviations of the places in the layout [m], (M).

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    layout, simulator = frames[0].markers, frames[0].simulator
    count, change, markers = len(layout.names), UNCHANGED, layout
    moved = np.zeros((count, 3))
    fits: list[ResultantFit | None] = [None] * len(frames)
    priors = [PULL] * len(frames)
    longest = float(np.ptp(layout.rest, axis=0).max())
    model_sigma = [MODEL_FRACTION * longest] * len(frames)  # until the deflections are known
    by_place = np.repeat(np.maximum(prior_sigma, MIN_PRIOR_SIGMA) ** -2.0, 3)
    # A pose that no frame depends on stays as it is.
    by_pose = np.zeros(6) if any(unknown) else np.ones(6)
    precision = np.concatenate([MATERIAL_SIGMA**-2.0, by_pose, by_place])
    material_part, pose_part, place_part = slice(0, 3), slice(3, 9), slice(9, None)
    for _ in range(MAX_ITERATIONS):
        changed = with_changed_material(simulator, change)
        hessian, chosen = np.diag(precision), []
        gradient = precision * np.concatenate([change, np.zeros(6), moved.ravel()])
        for k, frame in enumerate(frames):
            current = replace(frame, simulator=changed, markers=markers)
            if unknown[k]:
                current = replace(current, target=pose.apply(frame.target))
            fit = fit_resultant(current, model_sigma[k], fits[k], priors[k])
            fits[k] = fit
            by_material = np.tensordot(fit.by_force, material_loads(simulator, change, fit.q))
            shared = _shared_slopes(current, fit, unknown[k], by_material)
            own_hessian, own_gradient = _reduced_normal_equations(current, fit, shared)
            hessian += own_hessian
            gradient += own_gradient
            by_unit = shared[:, precision > 0.0] / np.sqrt(precision[precision > 0.0])
            chosen.append(PULL if unknown[k] else fit.most_probable_prior(current, by_unit))
            deflection = markers.positions(torch.from_numpy(fit.q)).numpy() - markers.rest
            size = float(np.sqrt(np.mean((deflection**2).sum(-1))))
            model_sigma[k] = float(np.sqrt(len(frames))) * max(MODEL_FRACTION * size, MIN_MODEL_SIGMA)
        covariance = _inverse(hessian)
        step = -covariance @ gradient
        largest = float(np.abs(step[material_part] / MATERIAL_SIGMA).max())
        step *= min(1.0, MAX_MATERIAL_STEP / max(largest, MAX_MATERIAL_STEP))
        change = change + step[material_part]
        pose = pose.followed_by(step[pose_part])
        moved = moved + step[place_part].reshape(-1, 3)
        markers = embed(simulator.mesh, layout.names, layout.rest + moved)
        tolerance = np.concatenate(
            [MATERIAL_TOLERANCE * MATERIAL_SIGMA, np.full(6, POSE_TOLERANCE), np.full(3 * count, STEP_TOLERANCE)]
        )
        if (np.abs(step) < tolerance).all() and chosen == priors:
            break
        priors = chosen
    sigma = np.sqrt(np.diag(covariance))
    markers = replace(markers, moved=moved, place_sigma=sigma[place_part].reshape(-1, 3))
    modulus = simulator.material.youngs_modulus * float(np.exp(change[0]))
    return Places(markers, pose, covariance[pose_part, pose_part], modulus, float(sigma[0]))


def _inverse(hessian: Array) -> Array:
    """Inverse of a positive definite matrix whose rows differ in their units."""
    scale = 1.0 / np.sqrt(np.diag(hessian))
    return np.asarray(scale[:, None] * np.linalg.inv(scale[:, None] * hessian * scale) * scale)


def _shared_slopes(frame: FirstFrame, fit: ResultantFit, posed: bool, by_material: Array) -> Array:
    """Derivatives of a recording's whitened residuals by (material, pose, places), (K, 9 + 3 M).

    by_material: derivatives of the measured markers, along their axes, by the material [m], (3 M', 3).
    """
    rows = np.flatnonzero(np.repeat(frame.measured, 3))
    whole = np.zeros((3 * len(frame.target), 9 + 3 * len(frame.target)))
    q = torch.from_numpy(fit.q)
    by_place = frame.markers.place_slope(q, torch.from_numpy(frame.simulator.mesh.vertices))
    for m, own in enumerate(by_place.numpy()):
        whole[3 * m : 3 * m + 3, 9 + 3 * m : 12 + 3 * m] = own
    if posed:
        whole[:, 3:9] = -pose_jacobian(frame.target).reshape(-1, 6)
    by_axis = frame.along_axes(whole[rows].reshape(-1, 3, whole.shape[1])).reshape(len(rows), -1)
    by_axis[:, :3] = by_material
    return np.asarray(fit.whitening @ by_axis)


def _reduced_normal_equations(frame: FirstFrame, fit: ResultantFit, slopes: Array) -> tuple[Array, Array]:
    """Half the Hessian and half the gradient of one recording's part by (material, pose, places), less its forces.

    slopes: `_shared_slopes` of the recording.
    """
    local, residual = resultant_jacobian(frame, fit)
    shared = np.zeros((len(residual), slopes.shape[1]))
    shared[: len(slopes)] = slopes
    # What the forces can explain is taken out.
    basis = np.linalg.qr(local)[0]
    shared -= basis @ (basis.T @ shared)
    residual = residual - basis @ (basis.T @ residual)
    return shared.T @ shared, shared.T @ residual
