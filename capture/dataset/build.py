"""Building a dataset: recordings registered to a specimen, with their first frames fitted."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from rafl.capture.dataset.sources import Recorded, find_source, read_recorded
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.registration.initial import FirstFrame, InitialState, fit_first_frame, fit_velocity
from rafl.capture.registration.registration import (
    Registration,
    RestPose,
    every_place,
    fit_rest,
    guess_pose,
    mean_position,
    register,
)
from rafl.capture.registration.release import Release, find_release
from rafl.capture.registration.rigid import FEWEST_MARKERS
from rafl.capture.registration.sequence import fit_by_sequence
from rafl.capture.specimen.specimen import Specimen

from rafl.common.errors import InputError
from rafl.data.dataset import UNEVEN, Dataset, Trajectory
from rafl.data.synthetic import load_force

Array = NDArray[Any]

WINDOW = 2  # frames on each side from which the velocity in the first frame is taken, by a polynomial through all


@dataclass(frozen=True)
class CaptureSettings:
    """How a dataset is built.

    Attributes:
        tolerance: how far a marker may stand off the surface [m].
        fit_tolerance: how far registered markers may be from the layout, root mean square [m].
        fps: of files that do not say.
        rest: where the specimen is undeformed, if it was recorded so.
        moving_clamp: express markers in the frame of the clamp markers, where there are some.
        start: first frame of all recordings whose row names none; found from the motion unless given.
        initial: `rest`: the first frame is an equilibrium; `moving`: it has a velocity; `sequence`: as `rest`, found
            by a sequence of forces over time.
        forces: virtual forces act on the `tip` or on the whole `surface`.
    """

    tolerance: float
    fit_tolerance: float
    fps: float
    rest: RestPose | None = None
    moving_clamp: bool = True
    start: int | None = None
    initial: Literal["rest", "moving", "sequence"] = "rest"
    forces: Literal["tip", "surface"] = "tip"


def build_dataset(
    specimen: Specimen,
    folder: Path,
    rows: list[RecordingRow],
    settings: CaptureSettings,
    recipe: str,
    tick: Callable[[], None],
) -> Dataset:
    """Build a dataset of a specimen's recordings.

    Args:
        specimen: as described.
        folder: of tracks, C3D or npy files named after the recordings.
        rows: of recordings.csv.
        settings: how.
        recipe: text kept in the dataset.
        tick: called after every recording.

    Raises:
        InputError: a file, marker or frame that does not fit; names it.
        SimulationError: a first frame that cannot be fitted.
    """
    markers = specimen.markers(settings.tolerance)

    def read(name: str) -> Recorded:
        return _selected(read_recorded(find_source(folder, name), settings.fps), specimen, name)

    recorded = {row.recording: read(row.recording) for row in rows}
    rest = None
    if settings.rest is not None:
        name = settings.rest.recording
        rest = fit_rest(recorded.get(name) or read(name), settings.rest, specimen, settings.fit_tolerance)
    step = _common_step(recorded)
    simulator = specimen.simulator(step)
    empty = Dataset(specimen.name, simulator, markers, {}, recipe)
    trajectories = {}
    for row in rows:
        item = recorded[row.recording]
        registration = register(item, specimen, rest, settings.fit_tolerance, settings.moving_clamp, row.recording)
        trajectories[row.recording] = _trajectory(empty, specimen, item, row, registration, settings)
        tick()
    dataset = Dataset(specimen.name, simulator, markers, trajectories, recipe)
    try:
        dataset.check()
    except ValueError as error:
        raise InputError(f"a dataset of {folder} would not be sound: {error}; correct the recording") from None
    return dataset


def _common_step(recorded: dict[str, Recorded]) -> float:
    steps = {name: float(np.median(np.diff(item.time))) for name, item in recorded.items()}
    first, step = next(iter(steps.items()))
    for name, other in steps.items():
        if abs(other / step - 1.0) > UNEVEN:
            raise InputError(
                f"recording {name}: expected {1 / step:.2f} frames/s as in {first}, found {1 / other:.2f}; put "
                "recordings of different rates into different datasets"
            )
    return step


def _selected(item: Recorded, specimen: Specimen, name: str) -> Recorded:
    """The recording with its markers in the order: the skin's, then the clamp's."""
    wanted, _ = every_place(specimen)
    if item.names is None:
        if item.position.shape[1] != len(wanted):
            raise InputError(
                f"recording {name}: expected {len(wanted)} markers as in the specimen, found "
                f"{item.position.shape[1]}; the file has no names, so its order must be the specimen's"
            )
        return item
    missing = [marker for marker in wanted if marker not in item.names]
    present = [marker for marker in specimen.layout.names if marker in item.names]
    if len(present) < FEWEST_MARKERS:
        raise InputError(
            f"recording {name}: expected at least {FEWEST_MARKERS} of the specimen's markers, found "
            f"{len(present)} (the file has {', '.join(item.names[:6])}...); name the markers alike in both"
        )
    order = [item.names.index(marker) if marker in item.names else -1 for marker in wanted]
    position, sigma = item.position[:, order].copy(), item.sigma[:, order].copy()
    lost = [wanted.index(marker) for marker in missing]
    position[:, lost] = np.nan
    return Recorded(wanted, item.time, position, sigma, item.rest, item.in_specimen_frame, item.source)


def _trajectory(
    dataset: Dataset,
    specimen: Specimen,
    item: Recorded,
    row: RecordingRow,
    registration: Registration,
    settings: CaptureSettings,
) -> Trajectory:
    """One recording on an even grid of times from its release on, its first frame fitted."""
    skin, simulator = len(specimen.layout.names), dataset.simulator
    position = registration.pose.apply(item.position[:, :skin])
    sigma = registration.pose.turned_sigma(item.sigma[:, :skin])
    position[:, [name in registration.wrong for name in specimen.layout.names]] = np.nan
    # As recorded: where a clamp marker jumps, a still specimen only seems to move in the clamp's frame.
    release, given = _release(item.position[:, :skin], row, settings)
    last = len(item.time) - 1 if row.last_frame is None else row.last_frame
    if not release.start < last < len(item.time):
        raise InputError(
            f"recording {row.recording}: expected frames within 0 to {len(item.time) - 1}, found {release.start} to "
            f"{last}; correct recordings.csv"
        )
    frame = _first_frame(dataset, specimen, position, sigma, release, row.recording, settings.forces == "surface")
    initial = _fitted(frame, specimen, registration, settings)
    position, sigma = initial.pose.apply(position), initial.pose.turned_sigma(sigma)
    velocity = np.zeros_like(initial.q)
    if settings.initial == "moving":
        velocity = fit_velocity(frame, initial.q, *_marker_velocity(position, sigma, item.time, release.start))
    load = 1e-3 * row.load_g if row.load == "hanging" else 0.0
    added = np.zeros(len(specimen.mesh.vertices))
    added[specimen.loaded] = load / len(specimen.loaded)
    time, markers, sigma = _on_grid(item, position, sigma, slice(release.start, last + 1), simulator.time_step, row)
    pose = initial.pose if registration.guessed else registration.pose.at(slice(release.start, release.start + 1))
    left = dataset.markers.positions(torch.from_numpy(initial.q)).numpy() - initial.pose.apply(frame.target)
    return Trajectory(
        time,
        markers,
        np.isfinite(markers[..., 0]),
        sigma,
        initial.q,
        velocity,
        initial.force,
        load_force(simulator, specimen.loaded, load),
        added,
        row.split,
        {
            "load_g": row.load_g,
            "load": row.load,
            "registration": registration.way,
            "registration_R": pose.rotation.reshape(-1, 3, 3)[0],
            "registration_t": pose.translation.reshape(-1, 3)[0],
            "registration_covariance": registration.covariance,
            "registration_residual_mm": 1e3 * max(registration.residual.values(), default=0.0),
            "registration_markers": ", ".join(f"{k} {1e3 * v:.3f}" for k, v in registration.residual.items()),
            "set_aside": ", ".join(registration.wrong),
            "first_frame": release.start,
            "first_frame_from": given,
            "still_frames": release.start - release.still,
            "initial": settings.initial,
            "forces": settings.forces,
            "fit_residual_mm": 1e3 * initial.residual,
            "fit_markers_mm": 1e3 * np.linalg.norm(left, axis=1),
            "source": item.source,
        },
    )


def _first_frame(
    dataset: Dataset, specimen: Specimen, position: Array, sigma: Array, release: Release, name: str, everywhere: bool
) -> FirstFrame:
    """The markers where they rest before the release, or in the first frame."""
    still = slice(release.still, max(release.start, release.still + 1))
    target, target_sigma = mean_position(position[still], sigma[still])
    if np.isfinite(target[:, 0]).sum() < FEWEST_MARKERS:
        raise InputError(
            f"recording {name}, frame {release.start}: expected at least {FEWEST_MARKERS} markers, found fewer; "
            "start at a later first_frame"
        )
    skin = np.setdiff1d(np.unique(specimen.mesh.surface), specimen.fixed)
    nodes = skin if everywhere else specimen.loaded
    return FirstFrame(dataset.simulator, dataset.markers, nodes, target, target_sigma, name, everywhere)


def _fitted(
    frame: FirstFrame, specimen: Specimen, registration: Registration, settings: CaptureSettings
) -> InitialState:
    """The first frame, checked against the tolerance."""
    if settings.initial != "sequence":
        initial = fit_first_frame(frame, guess_pose(specimen, frame.target) if registration.guessed else None)
    elif registration.guessed:
        raise InputError(f"recording {frame.what}: --initial sequence needs a rest pose, found none; give --rest")
    else:
        initial = fit_by_sequence(frame)
    if initial.residual > settings.fit_tolerance:
        raise InputError(
            f"recording {frame.what}: expected a first frame the specimen can be bent into, found its markers "
            f"{1e3 * initial.residual:.2f} mm off (root mean square; at most {1e3 * settings.fit_tolerance:g} mm); "
            "check that the calibration's world is the specimen's frame, or allow it with --fit-tolerance-mm"
        )
    return initial


def _release(position: Array, row: RecordingRow, settings: CaptureSettings) -> tuple[Release, str]:
    """Where the free motion begins, and who says so."""
    given = settings.start if row.first_frame is None else row.first_frame
    if given is None and settings.initial != "moving":
        return find_release(position), "the motion"
    start = given or 0
    if start >= len(position):
        raise InputError(
            f"recording {row.recording}: expected a first frame within 0 to {len(position) - 1}, found {start}; "
            "correct it"
        )
    still = start if settings.initial == "moving" else find_release(position, start).still
    return Release(start, still), "given" if given is not None else "the beginning"


def _marker_velocity(position: Array, sigma: Array, time: Array, start: int) -> tuple[Array, Array]:
    """Velocities of the markers in a frame and their standard deviations [m/s], (M, 3), by polynomials."""
    near = slice(max(start - WINDOW, 0), min(max(start + WINDOW, 2 * WINDOW), len(time) - 1) + 1)
    powers = np.vander(time[near] - time[start], 2 * WINDOW + 1, increasing=True)
    velocity, uncertain = np.full(position.shape[1:], np.nan), np.full(position.shape[1:], np.inf)
    for marker in range(position.shape[1]):
        for axis in range(3):
            seen = np.isfinite(position[near, marker, axis])
            if seen.sum() > 2 * WINDOW:
                weight = 1.0 / sigma[near, marker, axis][seen]
                inverse = np.linalg.pinv(weight[:, None] * powers[seen])
                velocity[marker, axis] = inverse[1] @ (weight * position[near, marker, axis][seen])
                uncertain[marker, axis] = np.linalg.norm(inverse[1])
    return velocity, uncertain


def _on_grid(
    item: Recorded, position: Array, sigma: Array, chosen: slice, step: float, row: RecordingRow
) -> tuple[Array, Array, Array]:
    """Times, markers and sigma of the chosen frames on an even grid; dropped frames are gaps."""
    position, sigma = position[chosen], sigma[chosen]
    slot = np.rint((item.time[chosen] - item.time[chosen.start]) / step).astype(int)
    if (np.diff(slot) < 1).any():
        frame = chosen.start + int(np.argmax(np.diff(slot) < 1)) + 1
        raise InputError(
            f"recording {row.recording}: expected even frame times, frame {frame} comes "
            "too early; track it again with the true rate (--fps)"
        )
    grid = np.full((slot[-1] + 1, *position.shape[1:]), np.nan)
    grid_sigma = np.full_like(grid, np.inf)
    grid[slot], grid_sigma[slot] = position, np.where(np.isfinite(position) & np.isfinite(sigma), sigma, np.inf)
    return step * np.arange(len(grid)), grid, grid_sigma
