"""Building of datasets: registers recordings to a specimen and fits their first frames."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.dataset.modulus import estimate_modulus
from rafl.capture.dataset.naming import in_layout_order
from rafl.capture.dataset.sources import find_sources, read_recording
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.registration.initial import FirstFrame, InitialState, fit_first_frame, fit_velocity
from rafl.capture.registration.motion_start import MotionStart, find_motion_start
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
from rafl.capture.registration.rigid import IDENTITY, MIN_MARKERS, pose_sigma
from rafl.capture.registration.sequence import fit_by_sequence
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import MAX_RELATIVE_TIME_ERROR, Dataset, Trajectory
from rafl.data.markers import Markers
from rafl.data.synthetic import load_force

Array = NDArray[Any]

VELOCITY_WINDOW_FRAMES = 5  # the polynomial through all of them gives the velocity in the first frame
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
        initial: `rest`: the first frame is an equilibrium; `moving`: it has a velocity; `auto`: either, as each
            recording shows; `sequence`: as `rest`, fitted by a sequence of forces over time.
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
    initial: Literal["auto", "rest", "moving", "sequence"] = "auto"
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
        trajectories[item.row.recording] = _with_modulus(_trajectory(empty, specimen, item, settings), empty, specimen)
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
        start: where the motion starts, and in which state.
        last: last frame that is used.
    """

    recording: Recording
    row: RecordingRow
    registration: Registration
    position: Array
    sigma: Array
    start: MotionStart
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
        """Transform a recording by its registration, without outliers, and find where its motion starts."""
        own = len(specimen.layout.names)
        position = registration.pose.apply(recording.position[:, :own])
        sigma = registration.pose.rotate_sigma(recording.sigma[:, :own])
        position[:, [name in registration.outliers for name in specimen.layout.names]] = np.nan
        # Positions as recorded: if a clamp marker jumps, a specimen at rest would seem to move in the clamp's frame.
        start = _motion_start(recording.position[:, :own], row, settings)
        last = len(recording.time) - 1 if row.last_frame is None else row.last_frame
        if not start.frame < last < len(recording.time):
            raise InputError(
                f"recording {row.recording}: expected frames within 0 to {len(recording.time) - 1}, found "
                f"{start.frame} to {last}; correct recordings.csv"
            )
        return cls(recording, row, registration, position, sigma, start, last)

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
        rest = slice(self.start.rest_start, max(self.start.frame, self.start.rest_start + 1))
        target, sigma = average_frames(self.position[rest], self.sigma[rest])
        name = self.row.recording
        if np.isfinite(target[:, 0]).sum() < MIN_MARKERS:
            raise InputError(
                f"recording {name}, frame {self.start.frame}: expected at least {MIN_MARKERS} markers, found fewer; "
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
    dot. A recording that starts in motion shows neither places nor a pose, for its first frame is no equilibrium.

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
    chosen = [item for item in registered if not item.start.moving and (item.registration.pose_from_model or not fixed)]
    if not chosen:
        return markers, registered
    described = replace(dataset, markers=markers)
    unknown = [item.registration.pose_from_model for item in chosen]
    frames = [item.first_frame(described, specimen, whole_surface=False) for item in chosen]
    frames = [
        replace(frame, load=1e-3 * item.row.load_g) if posed else frame
        for item, frame, posed in zip(chosen, frames, unknown, strict=True)
    ]
    targets = np.array([frame.target for frame, posed in zip(frames, unknown, strict=True) if posed])
    pose = IDENTITY
    if len(targets):
        pose = fit_pose_near_clamp(specimen, average_frames(targets, np.ones_like(targets))[0])
    sigma = 0.0 if fixed else specimen.layout.sigma
    places = find_places(frames, unknown, pose, np.broadcast_to(sigma, len(markers.names)))
    found = [
        item.with_pose(places) if any(unknown) and item.registration.pose_from_model else item for item in registered
    ]
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
    time, markers, sigma = _on_even_grid(recording, position, sigma, chosen, simulator.time_step, row)
    first = slice(start.frame, start.frame + 1)
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
            "fit_residual_mm": 1e3 * initial.residual,
            "fit_markers_mm": 1e3 * np.linalg.norm(residual, axis=1),
            "source": recording.source,
        },
    )


def _with_modulus(item: Trajectory, dataset: Dataset, specimen: Specimen) -> Trajectory:
    """The recording with the moduli that it shows by itself as attributes."""
    hung = item.attributes["load"] == "released" and item.attributes["initial"] != "moving"
    load = 1e-3 * float(str(item.attributes["load_g"])) if hung else 0.0
    found = estimate_modulus(dataset.simulator, dataset.markers, item, specimen.loaded, load)
    measured = {"bend_modulus": found.bend, "swing_modulus": found.swing, "swing_hz": found.frequency}
    return replace(item, attributes=item.attributes | measured)


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


def _motion_start(position: Array, row: RecordingRow, settings: CaptureSettings) -> MotionStart:
    """First frame and its state, by recordings.csv, the settings and the recorded motion."""
    given = settings.start if row.first_frame is None else row.first_frame
    if given is not None and given >= len(position):
        raise InputError(
            f"recording {row.recording}: expected a first frame within 0 to {len(position) - 1}, found {given}; "
            "correct it"
        )
    return find_motion_start(position, "rest" if settings.initial == "sequence" else settings.initial, given)


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
