"""Building of datasets: registers recordings to a specimen and fits their first frames."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.dataset.naming import in_layout_order
from rafl.capture.dataset.sources import find_sources, read_recording
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.registration.initial import FirstFrame, InitialState, fit_first_frame, fit_velocity
from rafl.capture.registration.places import Places, find_places
from rafl.capture.registration.recording import Recording
from rafl.capture.registration.registration import (
    Registration,
    RestPose,
    average_frames,
    fit_pose_near_clamp,
    fit_rest,
    register,
)
from rafl.capture.registration.release import Release, find_release
from rafl.capture.registration.rigid import IDENTITY, MIN_MARKERS, pose_sigma
from rafl.capture.registration.sequence import fit_by_sequence
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import MAX_RELATIVE_TIME_ERROR, Dataset, Trajectory
from rafl.data.markers import Markers
from rafl.data.synthetic import load_force

Array = NDArray[Any]

# Frames on each side of the first one; the polynomial through all of them gives the velocity in the first frame.
VELOCITY_WINDOW_FRAMES = 2
SAME_PLACE = 1e-9  # [m]


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of `build_dataset`.

    Attributes:
        tolerance: largest distance of a marker from the surface of the mesh [m].
        fit_tolerance: largest root mean square residual of the registration and of the first frame [m].
        fps: frames per second of files without a frame rate.
        rest: frames that show the undeformed specimen, if recorded.
        moving_clamp: express the positions in the frame of the clamp markers, if there are any.
        start: first frame of the recordings whose row has none; None finds it from the motion.
        initial: `rest`: the first frame is an equilibrium; `moving`: it has a velocity; `sequence`: as `rest`, fitted
            by a sequence of forces over time.
        forces: virtual forces act on the `tip` or on the whole `surface`.
        unit: of positions in tables that do not name it: m, cm or mm.
        names: of markers in the specimen, by their names in the files, where they differ.
    """

    tolerance: float = 2e-3
    fit_tolerance: float = 3e-3
    fps: float = 100.0
    rest: RestPose | None = None
    moving_clamp: bool = True
    start: int | None = None
    initial: Literal["rest", "moving", "sequence"] = "rest"
    forces: Literal["tip", "surface"] = "tip"
    unit: str | None = None
    names: dict[str, str] = field(default_factory=dict)


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
        registered.append(_Registered.of(specimen, recording, row, registration, settings))
    markers, registered = _find_places(empty, specimen, registered, known, settings)
    empty = replace(empty, markers=markers)
    trajectories = {}
    for item in registered:
        trajectories[item.row.recording] = _trajectory(empty, specimen, item, settings)
        tick()
    dataset = Dataset(specimen.name, simulator, markers, trajectories, recipe)
    try:
        dataset.check()
    except ValueError as error:
        raise InputError(f"the dataset from {folder} would be invalid: {error}; correct the recording") from None
    return dataset


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


def _check_same_layout(markers: Markers, known: Markers) -> None:
    """Raise InputError unless markers found earlier come from the same layout."""
    described = known.rest if known.moved is None else known.rest - known.moved
    if markers.names != known.names or np.abs(described - markers.rest).max() > SAME_PLACE:
        raise InputError(
            "expected the markers of the dataset's own specimen file, found others, or at other places; build the "
            "whole dataset again, without --update"
        )


@dataclass(frozen=True)
class _Registered:
    """A recording in the specimen frame.

    Attributes:
        recording, row, registration: of which it is made.
        position, sigma: of the specimen's markers [m], (T, M, 3).
        release: where the motion starts.
        release_source: where that was found.
        last: last frame that is used.
    """

    recording: Recording
    row: RecordingRow
    registration: Registration
    position: Array
    sigma: Array
    release: Release
    release_source: str
    last: int

    @classmethod
    def of(
        cls,
        specimen: Specimen,
        recording: Recording,
        row: RecordingRow,
        registration: Registration,
        settings: CaptureSettings,
    ) -> "_Registered":
        """Transform a recording by its registration, without outliers, and find its release."""
        own = len(specimen.layout.names)
        position = registration.pose.apply(recording.position[:, :own])
        sigma = registration.pose.rotate_sigma(recording.sigma[:, :own])
        position[:, [name in registration.outliers for name in specimen.layout.names]] = np.nan
        # Positions as recorded: if a clamp marker jumps, a specimen at rest would seem to move in the clamp's frame.
        release, source = _release_and_source(recording.position[:, :own], row, settings)
        last = len(recording.time) - 1 if row.last_frame is None else row.last_frame
        if not release.start < last < len(recording.time):
            raise InputError(
                f"recording {row.recording}: expected frames within 0 to {len(recording.time) - 1}, found "
                f"{release.start} to {last}; correct recordings.csv"
            )
        return cls(recording, row, registration, position, sigma, release, source, last)

    def with_pose(self, places: Places) -> "_Registered":
        """The recording in the specimen frame, after its pose was found; sigma then contains that of the pose."""
        registration = replace(
            self.registration,
            pose=places.pose,
            covariance=places.pose_covariance,
            pose_from_model=False,
            modulus=places.modulus,
            modulus_sigma=places.modulus_sigma,
        )
        position = places.pose.apply(self.position)
        by_pose = pose_sigma(places.pose_covariance, position)
        sigma = np.hypot(places.pose.rotate_sigma(self.sigma), by_pose)
        return replace(self, registration=registration, position=position, sigma=sigma)

    def first_frame(self, dataset: Dataset, specimen: Specimen, whole_surface: bool) -> FirstFrame:
        """Mean marker positions at rest before the release, or those of the first frame."""
        rest = slice(self.release.rest_start, max(self.release.start, self.release.rest_start + 1))
        target, sigma = average_frames(self.position[rest], self.sigma[rest])
        name = self.row.recording
        if np.isfinite(target[:, 0]).sum() < MIN_MARKERS:
            raise InputError(
                f"recording {name}, frame {self.release.start}: expected at least {MIN_MARKERS} markers, found fewer; "
                "start at a later first_frame"
            )
        surface = np.setdiff1d(np.unique(specimen.mesh.surface), specimen.fixed)
        nodes = surface if whole_surface else specimen.loaded
        return FirstFrame(dataset.simulator, dataset.markers, nodes, target, sigma, name, whole_surface)


def _find_places(
    dataset: Dataset,
    specimen: Specimen,
    registered: list[_Registered],
    known: Markers | None,
    settings: CaptureSettings,
) -> tuple[Markers, list[_Registered]]:
    """The markers at the places that the first frames show, and the recordings with the poses that these show.

    Places stay as described where the elements lock: such a mesh follows a bent body less closely than a hand places a
    dot. First frames that are no equilibria show neither places nor poses.

    Args:
        dataset: with the markers as described.
        specimen: its description.
        registered: recordings; the pose of some may be unknown.
        known: markers whose places are known.
        settings: tolerances and methods.

    Raises:
        InputError: the places are farther from the described ones than the tolerance.
    """
    markers = known or dataset.markers
    fixed = known is not None or specimen.material.integration != "enhanced"
    chosen = [k for k, item in enumerate(registered) if item.registration.pose_from_model or not fixed]
    if settings.initial == "moving" or not chosen:
        return markers, registered
    described = replace(dataset, markers=markers)
    frames = [registered[k].first_frame(described, specimen, whole_surface=False) for k in chosen]
    unknown = [registered[k].registration.pose_from_model for k in chosen]
    frames = [
        replace(frame, load=1e-3 * registered[k].row.load_g) if posed else frame
        for k, frame, posed in zip(chosen, frames, unknown, strict=True)
    ]
    targets = [frame.target for frame, posed in zip(frames, unknown, strict=True) if posed]
    pose = fit_pose_near_clamp(specimen, np.nanmean(targets, axis=0)) if targets else IDENTITY
    sigma = 0.0 if fixed else specimen.layout.sigma
    places = find_places(frames, unknown, pose, np.broadcast_to(sigma, len(markers.names)))
    found = [item.with_pose(places) if item.registration.pose_from_model else item for item in registered]
    if not fixed:
        _check_places(specimen, dataset.markers, places.markers, settings)
    return markers if fixed else places.markers, found


def _check_places(specimen: Specimen, described: Markers, markers: Markers, settings: CaptureSettings) -> None:
    """Raise InputError if the markers are farther from their described places than the tolerance."""
    moved = np.linalg.norm(markers.rest - described.rest, axis=1)
    distance = float(np.sqrt((moved**2).mean()))
    if distance > settings.fit_tolerance:
        raise InputError(
            f"specimen {specimen.name}: expected the markers near their at_mm, found them {1e3 * distance:.2f} mm off "
            f"in the first frames (root mean square; at most {1e3 * settings.fit_tolerance:g} mm); check at_mm, that "
            "the calibration's world is the specimen's frame, or allow it with --fit-tolerance-mm"
        )


def _trajectory(dataset: Dataset, specimen: Specimen, item: _Registered, settings: CaptureSettings) -> Trajectory:
    """One recording from its release on, at even times, with its first frame fitted."""
    simulator, recording, row, registration = dataset.simulator, item.recording, item.row, item.registration
    position, sigma, release = item.position, item.sigma, item.release
    frame = item.first_frame(dataset, specimen, settings.forces == "surface")
    initial = _fit_initial_state(frame, specimen, registration, settings)
    position, sigma = initial.pose.apply(position), initial.pose.rotate_sigma(sigma)
    velocity = np.zeros_like(initial.q)
    if settings.initial == "moving":
        velocity = fit_velocity(frame, initial.q, *_marker_velocity(position, sigma, recording.time, release.start))
    load = 1e-3 * row.load_g if row.load == "hanging" else 0.0
    added_mass = np.zeros(len(specimen.mesh.vertices))
    added_mass[specimen.loaded] = load / len(specimen.loaded)
    chosen = slice(release.start, item.last + 1)
    time, markers, sigma = _on_even_grid(recording, position, sigma, chosen, simulator.time_step, row)
    first = slice(release.start, release.start + 1)
    pose = initial.pose if registration.pose_from_model else registration.pose.select_frames(first)
    residual = dataset.markers.positions(torch.from_numpy(initial.q)).numpy() - initial.pose.apply(frame.target)
    return Trajectory(
        time,
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
            "registration_covariance": registration.covariance,
            "registration_residual_mm": 1e3 * max(registration.residual.values(), default=0.0),
            "registration_markers": ", ".join(f"{k} {1e3 * v:.3f}" for k, v in registration.residual.items()),
            "registration_modulus": registration.modulus,
            "registration_modulus_sigma": registration.modulus_sigma,
            "set_aside": ", ".join(registration.outliers),
            "first_frame": release.start,
            "first_frame_from": item.release_source,
            "still_frames": release.start - release.rest_start,
            "initial": settings.initial,
            "forces": settings.forces,
            "fit_residual_mm": 1e3 * initial.residual,
            "fit_markers_mm": 1e3 * np.linalg.norm(residual, axis=1),
            "source": recording.source,
        },
    )


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
            f"{1e3 * settings.fit_tolerance:g} mm); check that the calibration's world is the specimen's frame, or "
            "allow it with --fit-tolerance-mm"
        )
    return initial


def _release_and_source(position: Array, row: RecordingRow, settings: CaptureSettings) -> tuple[Release, str]:
    """Release frame, and where it comes from: the motion, the user or the beginning of the recording."""
    given = settings.start if row.first_frame is None else row.first_frame
    if given is None and settings.initial != "moving":
        return find_release(position), "the motion"
    start = given or 0
    if start >= len(position):
        raise InputError(
            f"recording {row.recording}: expected a first frame within 0 to {len(position) - 1}, found {start}; "
            "correct it"
        )
    rest_start = start if settings.initial == "moving" else find_release(position, start).rest_start
    return Release(start, rest_start), "given" if given is not None else "the beginning"


def _marker_velocity(position: Array, sigma: Array, time: Array, start: int) -> tuple[Array, Array]:
    """Marker velocities in a frame and their sigmas [m/s], (M, 3), by polynomials through near frames."""
    end = min(max(start + VELOCITY_WINDOW_FRAMES, 2 * VELOCITY_WINDOW_FRAMES), len(time) - 1)
    near = slice(max(start - VELOCITY_WINDOW_FRAMES, 0), end + 1)
    powers = np.vander(time[near] - time[start], 2 * VELOCITY_WINDOW_FRAMES + 1, increasing=True)
    velocity, velocity_sigma = np.full(position.shape[1:], np.nan), np.full(position.shape[1:], np.inf)
    for marker in range(position.shape[1]):
        for axis in range(3):
            measured = np.isfinite(position[near, marker, axis])
            if measured.sum() > 2 * VELOCITY_WINDOW_FRAMES:
                weight = 1.0 / sigma[near, marker, axis][measured]
                inverse = np.linalg.pinv(weight[:, None] * powers[measured])
                velocity[marker, axis] = inverse[1] @ (weight * position[near, marker, axis][measured])
                velocity_sigma[marker, axis] = np.linalg.norm(inverse[1])
    return velocity, velocity_sigma


def _on_even_grid(
    recording: Recording, position: Array, sigma: Array, chosen: slice, step: float, row: RecordingRow
) -> tuple[Array, Array, Array]:
    """Times, positions and sigma of the chosen frames at even times; dropped frames become gaps."""
    position, sigma = position[chosen], sigma[chosen]
    slot = np.rint((recording.time[chosen] - recording.time[chosen.start]) / step).astype(int)
    if (np.diff(slot) < 1).any():
        frame = chosen.start + int(np.argmax(np.diff(slot) < 1)) + 1
        raise InputError(
            f"recording {row.recording}: expected even frame times, found frame {frame} too early; track it again "
            "with the true rate (--fps)"
        )
    grid = np.full((slot[-1] + 1, *position.shape[1:]), np.nan)
    grid_sigma = np.full_like(grid, np.inf)
    grid[slot], grid_sigma[slot] = position, np.where(np.isfinite(position) & np.isfinite(sigma), sigma, np.inf)
    return step * np.arange(len(grid)), grid, grid_sigma
