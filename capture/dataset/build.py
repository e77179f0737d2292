"""Building of datasets: registers recordings to a specimen and fits their first frames."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.calibration.summary import OTHER_SET_UP
from rafl.capture.dataset.camera_summary import change_attributes
from rafl.capture.dataset.modulus import estimate_modulus
from rafl.capture.dataset.naming import in_layout_order
from rafl.capture.dataset.refine_cameras import refine_cameras, require_following_elements
from rafl.capture.dataset.registered import Registered, check_near_clamp, find_dataset_places
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.sources import find_sources, read_recording
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.initial import InitialState, fit_first_frame, fit_velocity
from rafl.capture.registration.recording import Recording
from rafl.capture.registration.registration import (
    Registration,
    fit_pose_near_clamp,
    fit_rest,
    register,
)
from rafl.capture.registration.sequence import fit_by_sequence
from rafl.capture.release.motion_start import MotionStart
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import MAX_RELATIVE_TIME_ERROR, Dataset, Trajectory
from rafl.data.markers import Markers
from rafl.data.synthetic import load_force
from rafl.data.views import View

Array = NDArray[Any]

VELOCITY_WINDOW_FRAMES = 5  # the polynomial through all of them gives the velocity in the first frame
SAME_PLACE = 1e-9  # [m]
SAME_INSTANT = 1e-3  # difference of times that is their rounding in files [frames]


def build_dataset(
    specimen: Specimen,
    folder: Path,
    rows: list[RecordingRow],
    settings: CaptureSettings,
    recipe: str,
    tick: Callable[[], None],
    known: Markers | None = None,
) -> Dataset:
    """Build the dataset of a specimen from its recordings.

    Args:
        specimen: its description.
        folder: with tracks, C3D or npy files named after the recordings.
        rows: of recordings.csv.
        settings: tolerances and methods.
        recipe: text stored in the dataset.
        tick: called after every recording.
        known: markers whose places were found earlier, for recordings that are added to a dataset.

    Raises:
        InputError: a file, marker or frame does not fit; the message names it.
        SimulationError: a first frame cannot be fitted.
    """
    if settings.refine_cameras:
        require_following_elements(specimen)
    markers = specimen.markers(settings.tolerance)
    if known is not None:
        _check_same_layout(markers, known)

    def read(name: str) -> Recording:
        path, *others = find_sources(folder, name)
        recording = read_recording(path, settings.fps, settings.unit)
        if others:
            beside = ", ".join(other.name for other in others)
            recording = replace(recording, source=f"{recording.source}; beside it, not read: {beside}")
        return in_layout_order(recording, specimen, name, settings.names)

    recordings = {row.recording: read(row.recording) for row in rows}
    _check_different(recordings)
    rest = None
    if settings.rest is not None:
        name = settings.rest.recording
        rest = fit_rest(recordings.get(name) or read(name), settings.rest, specimen, settings.fit_tolerance)
    simulator = specimen.simulator(_common_time_step(recordings))
    empty = Dataset(specimen.name, simulator, markers, {}, recipe)
    registered = []
    for row in rows:
        recording = recordings[row.recording]
        registration = register(recording, specimen, rest, settings.fit_tolerance, settings.moving_clamp, row.recording)
        registered.append(Registered.of(specimen, recording, row, registration, settings))
        check_near_clamp(empty, specimen, registered[-1], settings.fit_tolerance)
    dataset = _with_recordings(empty, specimen, registered, known, settings, tick)
    found = None
    if settings.refine_cameras:
        found = refine_cameras(dataset, specimen, registered, settings.forces == "surface")
        changed = [item.with_changes(found.changes) for item in registered]
        dataset = _with_recordings(empty, specimen, changed, known, settings, lambda: None)
    trajectories = {
        item.row.recording: _with_attributes(
            dataset.trajectories[item.row.recording], change_attributes(found, item, dataset.markers.rest)
        )
        for item in registered
    }
    dataset = replace(dataset, trajectories=trajectories)
    try:
        dataset.check()
    except ValueError as error:
        raise InputError(f"the dataset from {folder} would be invalid: {error}; correct the recording") from None
    return dataset


def _with_recordings(
    empty: Dataset,
    specimen: Specimen,
    registered: list[Registered],
    known: Markers | None,
    settings: CaptureSettings,
    tick: Callable[[], None],
) -> Dataset:
    """The dataset with markers at their places and with recordings whose first frames are fitted."""
    markers, registered = find_dataset_places(empty, specimen, registered, known, settings)
    empty, trajectories = replace(empty, markers=markers), {}
    for item in registered:
        trajectories[item.row.recording] = _with_modulus(_trajectory(empty, specimen, item, settings), empty, specimen)
        tick()
    return replace(empty, trajectories=trajectories)


def _common_time_step(recordings: dict[str, Recording]) -> float:
    steps = {name: float(np.median(np.diff(recording.time))) for name, recording in recordings.items()}
    first, step = next(iter(steps.items()))
    for name, other in steps.items():
        if abs(other / step - 1.0) > MAX_RELATIVE_TIME_ERROR:
            raise InputError(
                f"recording {name}: expected {1 / step:.2f} frames/s as in {first}, found {1 / other:.2f}; put "
                "recordings with different frame rates into different datasets"
            )
    return step


def _check_different(recordings: dict[str, Recording]) -> None:
    """Raise InputError if two recordings are one: it would count twice, or test a model on what it was fitted to."""
    for (one, first), (other, second) in combinations(recordings.items(), 2):
        if np.isfinite(first.position).any() and np.array_equal(first.position, second.position, equal_nan=True):
            raise InputError(
                f"recordings {one} and {other}: expected different recordings, found the same positions in every frame "
                f"({first.source}; {second.source}); leave one of them out of the table"
            )


def _check_same_layout(markers: Markers, known: Markers) -> None:
    """Raise InputError unless markers found earlier come from the same layout."""
    described = known.rest if known.moved is None else known.rest - known.moved
    if markers.names != known.names or np.abs(described - markers.rest).max() > SAME_PLACE:
        raise InputError(
            "expected the markers of the dataset's own specimen file, found others, or at other places; build the "
            "whole dataset again, without --update"
        )


def _trajectory(dataset: Dataset, specimen: Specimen, item: Registered, settings: CaptureSettings) -> Trajectory:
    """One recording from its release on, at even times, with its first frame fitted."""
    simulator, recording, row, registration = dataset.simulator, item.recording, item.row, item.registration
    position, sigma, start = item.position, item.sigma, item.start
    frame = item.first_frame(dataset, specimen, settings.forces == "surface")
    initial = _fit_initial_state(frame, specimen, registration, settings)
    position, sigma = initial.pose.apply(position), initial.pose.rotate_sigma(sigma)
    velocity = np.zeros_like(initial.q)
    if start.moving:
        velocity = fit_velocity(frame, initial.q, *_marker_velocity(position, sigma, recording.time, start))
    load = 1e-3 * row.load_g if row.load == "hanging" else 0.0
    added_mass = np.zeros(len(specimen.mesh.vertices))
    added_mass[specimen.loaded] = load / len(specimen.loaded)
    chosen = slice(start.frame, item.last + 1)
    grid = _EvenGrid.of(recording.time[chosen], simulator.time_step, start.frame, row)
    markers = grid.fill(position[chosen], np.nan)
    sigma = grid.fill(np.where(np.isfinite(position) & np.isfinite(sigma), sigma, np.inf)[chosen], np.inf)
    views = {camera: grid.resample(view.select_frames(chosen)) for camera, view in item.views.items()}
    first = slice(start.frame, start.frame + 1)
    pose = initial.pose if registration.pose_from_model else registration.pose.select_frames(first)
    covariance = registration.covariance if registration.covariance.ndim < 3 else registration.covariance[start.frame]
    residual = dataset.markers.positions(torch.from_numpy(initial.q)).numpy() - initial.pose.apply(frame.target)
    own = frame.along_axes(residual[frame.measured])
    residual[frame.measured] = np.where(frame.observed_axes, own, 0.0)
    return Trajectory(
        grid.time,
        markers,
        np.isfinite(markers[..., 0]),
        sigma,
        initial.q,
        velocity,
        initial.force,
        load_force(simulator, specimen.loaded, load),
        added_mass,
        row.split,
        {
            "load_g": row.load_g,
            "load": row.load,
            "registration": registration.method,
            "registration_R": pose.rotation.reshape(-1, 3, 3)[0],
            "registration_t": pose.translation.reshape(-1, 3)[0],
            "registration_covariance": covariance,
            "registration_residual_mm": 1e3 * max(registration.residual.values(), default=np.nan),
            "registration_markers": ", ".join(f"{k} {1e3 * v:.3f}" for k, v in registration.residual.items()),
            "registration_modulus": registration.modulus,
            "registration_modulus_sigma": registration.modulus_sigma,
            "set_aside": ", ".join(registration.outliers),
            "first_frame": start.frame,
            "first_frame_from": start.source,
            "still_frames": start.frame - start.rest_start,
            "not_free_frames": start.not_free,
            "initial": settings.initial if settings.initial == "sequence" else "moving" if start.moving else "rest",
            "forces": settings.forces,
            "loading": initial.loading,
            "fit_residual_mm": 1e3 * initial.residual,
            "fit_markers_mm": 1e3 * np.linalg.norm(residual, axis=1),
            "fit_sigma_mm": 1e3 * (np.full(len(frame.target), np.nan) if start.moving else initial.marker_sigma),
            "source": recording.source,
            "corrections": recording.corrections,
            "unfit_corrections": recording.unfit_corrections,
        },
        views,
    )


def _with_modulus(item: Trajectory, dataset: Dataset, specimen: Specimen) -> Trajectory:
    """The recording with the moduli that it shows by itself as attributes."""
    hung = item.attributes["load"] == "released" and item.attributes["initial"] != "moving"
    load = 1e-3 * float(str(item.attributes["load_g"])) if hung else 0.0
    found = estimate_modulus(dataset.simulator, dataset.markers, item, specimen.loaded, load)
    measured = {"bend_modulus": found.bend, "swing_modulus": found.swing, "swing_hz": found.frequency}
    return _with_attributes(item, measured)


def _with_attributes(item: Trajectory, more: Mapping[str, object]) -> Trajectory:
    return replace(item, attributes={**item.attributes, **more})


def _fit_initial_state(
    frame: FirstFrame, specimen: Specimen, registration: Registration, settings: CaptureSettings
) -> InitialState:
    """Fit the first frame and check its residual."""
    if settings.initial != "sequence":
        pose = fit_pose_near_clamp(specimen, frame.target) if registration.pose_from_model else None
        initial = fit_first_frame(frame, pose)
    elif registration.pose_from_model:
        raise InputError(f"recording {frame.recording}: --initial sequence needs a rest pose, found none; give --rest")
    else:
        initial = fit_by_sequence(frame)
    if initial.residual > settings.fit_tolerance:
        raise InputError(
            f"recording {frame.recording}: expected a first frame that a deformation of the specimen explains, found "
            f"its markers {1e3 * initial.residual:.2f} mm off (root mean square; at most "
            f"{1e3 * settings.fit_tolerance:g} mm). Either the calibration's world is not the specimen's frame, or "
            f"{OTHER_SET_UP}; --fit-tolerance-mm allows more"
        )
    return initial


def _marker_velocity(position: Array, sigma: Array, time: Array, start: MotionStart) -> tuple[Array, Array]:
    """Marker velocities in the first frame and their sigmas [m/s], (M, 3), by polynomials through near frames.

    Frames before it count only if it is given: the specimen need not be free in them.
    """
    before = VELOCITY_WINDOW_FRAMES // 2 if start.source == "given" else 0
    first = max(start.frame - before, 0)
    near = slice(first, min(first + VELOCITY_WINDOW_FRAMES, len(time)))
    powers = np.vander(time[near] - time[start.frame], VELOCITY_WINDOW_FRAMES, increasing=True)
    velocity, velocity_sigma = np.full(position.shape[1:], np.nan), np.full(position.shape[1:], np.inf)
    for marker in range(position.shape[1]):
        for axis in range(3):
            measured = np.isfinite(position[near, marker, axis])
            if measured.sum() >= VELOCITY_WINDOW_FRAMES:
                weight = 1.0 / sigma[near, marker, axis][measured]
                inverse = np.linalg.pinv(weight[:, None] * powers[measured])
                velocity[marker, axis] = inverse[1] @ (weight * position[near, marker, axis][measured])
                velocity_sigma[marker, axis] = np.linalg.norm(inverse[1])
    return velocity, velocity_sigma


@dataclass(frozen=True)
class _EvenGrid:
    """The even times of a recording.

    Attributes:
        time: [s], (T).
        slot: index along T of every recorded frame, (F).
        late: time of every recorded frame minus that of its row [s], (F).
    """

    time: Array
    slot: NDArray[np.int64]
    late: Array

    @classmethod
    def of(cls, time: Array, step: float, first: int, row: RecordingRow) -> "_EvenGrid":
        """From the times (F) of frames `first` and on, and the time step [s]."""
        slot = np.rint((time - time[0]) / step).astype(np.int64)
        if (np.diff(slot) < 1).any():
            frame = first + int(np.argmax(np.diff(slot) < 1)) + 1
            raise InputError(
                f"recording {row.recording}: expected even frame times, found frame {frame} too early; track it again "
                "with the true rate (--fps)"
            )
        late = time - time[0] - step * slot
        late = np.where(np.abs(late) < SAME_INSTANT * step, 0.0, late)
        return cls(step * np.arange(slot[-1] + 1), slot, late)

    def fill(self, values: Array, missing: float) -> Array:
        """Values (F, ..) at the even times, (T, ..); dropped frames become gaps."""
        result = np.full((len(self.time), *values.shape[1:]), missing)
        result[self.slot] = values
        return result

    def resample(self, view: View) -> View:
        """A view of the recorded frames in the rows of the even times."""
        recorded = np.searchsorted(self.slot, np.arange(len(self.time)), side="right") - 1  # or the last one before
        return View(
            view.camera,
            self.fill(view.pixel, np.nan),
            self.fill(view.covariance, np.nan),
            self.fill(view.lag + self.late, 0.0),
            None if view.rotation is None else view.rotation[recorded],
            None if view.translation is None else view.translation[recorded],
            None if view.pose_covariance is None else view.pose_covariance[recorded],
        )
