"""Registration: the transform from the frame of a recording to the specimen frame."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.registration.averaging import average_recording, measured_directions
from rafl.capture.registration.pose_fit import Measured, RigidFit, fit_pose, fit_poses
from rafl.capture.registration.recording import Recording
from rafl.capture.registration.rigid import IDENTITY, MIN_MARKERS, RigidTransform, kabsch
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import THROUGH_MODEL

Array = NDArray[Any]

# Assumed bending of the marker farthest from the clamp, as a fraction of its distance; it grows quadratically.
BENDING_FRACTION = 0.3


@dataclass(frozen=True)
class RestPose:
    """Frames `first` to `last` (inclusive) of a recording that show the undeformed specimen; None for all frames."""

    recording: str
    first: int | None = None
    last: int | None = None


@dataclass(frozen=True)
class Registration:
    """Transform of a recording to the specimen frame.

    Attributes:
        method: description.
        pose: one transform, or one for every frame.
        residual: distance of the markers used from their layout positions [m], by name.
        outliers: names of markers that are left out.
        covariance: of the pose, as in `RigidFit`, (6, 6), or of that of every frame, (T, 6, 6); NaN if unknown.
        pose_from_model: whether the pose is still unknown and must be found from deformed shapes.
        modulus: E that was found with the pose [Pa]; NaN if it was not.
        modulus_sigma: standard deviation of its logarithm.
    """

    method: str
    pose: RigidTransform
    residual: dict[str, float]
    outliers: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    pose_from_model: bool = False
    modulus: float = np.nan
    modulus_sigma: float = np.nan


def combined_layout(specimen: Specimen) -> tuple[tuple[str, ...], Array]:
    """Names and layout positions [m] of the specimen's markers, followed by those of the clamp."""
    names = (*specimen.layout.names, *specimen.clamp_layout.names)
    return names, np.concatenate([specimen.layout.positions, specimen.clamp_layout.positions])


@dataclass(frozen=True)
class RestFit:
    """The undeformed specimen as recorded.

    Attributes:
        fit: pose of the specimen.
        clamp: measured positions of the clamp markers in the specimen frame [m], (C, 3).
    """

    fit: RigidFit
    clamp: Array


def fit_rest(recording: Recording, rest_pose: RestPose, specimen: Specimen, tolerance: float) -> RestFit:
    """Fit the pose of the undeformed specimen to markers averaged over the frames of `rest_pose`.

    Raises:
        InputError: no such frames, too few markers, or markers more than `tolerance` [m] off the layout.
    """
    count = len(recording.time)
    first, last = rest_pose.first or 0, count - 1 if rest_pose.last is None else rest_pose.last
    if not first <= last < count:
        raise InputError(
            f"--rest {rest_pose.recording}: expected frames within 0 to {count - 1}, found {first} to {last}; "
            "correct them"
        )
    position, axes, sigma = average_recording(recording, slice(first, last + 1))
    measured = Measured.of(position, sigma, axes)
    fit = _fit_within_tolerance(measured, specimen, tolerance, f"--rest {rest_pose.recording}")
    # A clamp marker is where it was measured, and where the layout has it along a line of sight.
    layout = combined_layout(specimen)[1]
    gap = (axes.swapaxes(1, 2) @ measured.gaps(fit.transform, layout)[0, ..., None])[..., 0]
    places = np.where(measured.seen[0, :, None], layout + gap @ fit.transform.rotation.T, np.nan)
    return RestFit(fit, places[len(specimen.layout.names) :])


def _fit_within_tolerance(measured: Measured, specimen: Specimen, tolerance: float, label: str) -> RigidFit:
    """Fit the pose to markers in the order of `combined_layout`; `label` begins error messages."""
    names, layout = combined_layout(specimen)
    visible = int(measured.seen.sum())
    if visible < MIN_MARKERS:
        raise InputError(
            f"{label}: expected at least {MIN_MARKERS} visible markers for registration, found {visible}; choose "
            "other frames"
        )
    fit = fit_pose(measured, layout)
    if fit.rms_residual > tolerance:
        worst = names[int(np.nanargmax(fit.residual))]
        raise InputError(
            f"{label}: expected the markers at their layout positions, found them {1e3 * fit.rms_residual:.2f} mm off "
            f"(root mean square; at most {1e3 * tolerance:g} mm; {worst} most); check at_mm, the unit and the order, "
            "or allow it with --fit-tolerance-mm"
        )
    return fit


def register(
    recording: Recording, specimen: Specimen, rest: RestFit | None, tolerance: float, moving_clamp: bool, name: str
) -> Registration:
    """Register a recording by the first method that applies: clamp markers, rest pose, calibration, model.

    Args:
        recording: with markers in the order of `combined_layout`.
        specimen: its description.
        rest: the undeformed specimen, if recorded.
        tolerance: largest residual of the markers [m].
        moving_clamp: whether the clamp markers give a pose for every frame, or one pose from their mean positions.
        name: of the recording, for messages.

    Raises:
        InputError: markers too far from their layout positions.
    """
    own, names = len(specimen.layout.names), combined_layout(specimen)[0]
    clamp = specimen.clamp_layout.positions if rest is None else rest.clamp
    position, axes, sigma = measured_directions(recording, slice(own, None))
    used = np.isfinite(clamp[:, 0]) & np.isfinite(position[..., 0]).any(axis=0)
    on_clamp = Measured.of(position, sigma, axes).select(slice(None), used)
    if (on_clamp.seen.sum(axis=1) >= MIN_MARKERS).any():
        if not moving_clamp:
            position, axes, sigma = average_recording(recording, slice(None))
            on_clamp = Measured.of(position, sigma, axes).select(slice(None), own + np.flatnonzero(used))
        pose, covariance, distance = fit_poses(on_clamp, clamp[used])
        rms_by_marker = np.sqrt(np.nanmean(distance**2, axis=0))
        worst = float(rms_by_marker.max())
        if worst > tolerance:
            raise InputError(
                f"recording {name}: expected the clamp markers at their layout positions, found them "
                f"{1e3 * worst:.2f} mm off; check the clamp's at_mm, or allow it with --fit-tolerance-mm"
            )
        if not moving_clamp:
            pose, covariance = RigidTransform(pose.rotation[0], pose.translation[0]), covariance[0]
        residual = dict(zip(np.array(names[own:])[used], rms_by_marker.tolist(), strict=True))
        return Registration("clamp markers", pose, residual, covariance=covariance)
    fit = rest.fit if rest is not None else None
    method = "rest pose" if rest is not None else "the file's own rest pose"
    if fit is None and recording.rest is not None:
        measured = Measured.of(recording.rest, np.full_like(recording.rest, float(np.nanmedian(recording.sigma))))
        fit = _fit_within_tolerance(measured, specimen, tolerance, f"recording {name}, rest pose")
    if fit is not None:
        residual = {names[k]: float(fit.residual[k]) for k in np.flatnonzero(np.isfinite(fit.residual))}
        outliers = tuple(names[k] for k in np.flatnonzero(fit.outliers))
        return Registration(method, fit.transform, residual, outliers, fit.covariance)
    if recording.in_specimen_frame:
        return Registration("calibration", IDENTITY, {})
    return Registration(f"{THROUGH_MODEL}, from the markers near the clamp", IDENTITY, {}, pose_from_model=True)


def fit_pose_near_clamp(specimen: Specimen, target: Array) -> RigidTransform:
    """Approximate pose of a deformed specimen from its markers (M, 3) [m], NaN where missing.

    Markers far from the clamp get small weights, because bending may displace them.
    """
    fixed = specimen.mesh.vertices[specimen.fixed]
    layout = specimen.layout.positions
    distance = np.linalg.norm(layout[:, None] - fixed[None], axis=2).min(axis=1)
    bending = 1e-4 + BENDING_FRACTION * distance**2 / distance.max()
    return kabsch(target, layout, np.where(np.isfinite(target[:, 0]), 1.0 / bending**2, 0.0))
