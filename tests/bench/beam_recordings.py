"""The recordings of the real beam as trajectories that a simulation can follow.

Three things about the recordings decide how they are used:

- The loads hang on strings that are slack at the release. The tip falls alone for some 70 ms, then the string jerks and
  the beam rings for a few frames. A simulation knows neither the slack nor the jerk. So every recording, that without
  load too, is used from the first highest position of the tip on: the string is taut, the ringing is over, and the tip
  is almost at rest, so positions determine the state well. The velocity is fitted too. The frames before, since the
  release, are fitted one by one: the memory of a viscous material depends on them.
- The upper clamp marker moves by 0.9 mm along the beam when the first load is released, and stays there; another one
  jumps by 0.7 mm whenever the beam is low. Taken as motion of a rigid clamp, they would turn it by up to 3 degrees, and
  the beam would be softer in motion than at rest. So the clamp has one pose in each recording: level, with the turn
  about the vertical and the place of its two lower markers in the last second.
- The string leads around the upper edge of the tip, where the weight pulls. The weight itself only follows the vertical
  motion, so its mass is attached at mid-height, where the tip moves almost vertically.

The lateral motion, in which the weight does not take part, is neither fitted nor compared.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.dataset.sources import find_sources, read_recording
from rafl.capture.dataset.table import read_recording_rows
from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.initial import fit_first_frame, fit_velocity
from rafl.capture.registration.registration import RestPose, combined_layout, fit_rest
from rafl.capture.registration.rigid import RigidTransform
from rafl.capture.specimen.specimen import Specimen
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.synthetic import load_force
from rafl.simulation.rollout import Start
from rafl.tracking.linking.layout import MarkerLayout

Array = NDArray[Any]

STRAIGHT = RestPose("beam_gravity_V2_b", 65, 65)  # recording and frame in which the beam is held straight
LOWER_CLAMP_MARKERS = ("Base - 1", "Base - 3")
SETTLED_FRAMES = 100  # at the end of the file
TURNING_FRAMES = 4  # the tip turns where it is highest or lowest among so many frames before and after
LAYOUT_TOLERANCE, MARKER_TOLERANCE = 3e-3, 8e-3  # [m]


@dataclass(frozen=True)
class BeamRecording:
    """Markers at the tip in the specimen frame.

    Attributes:
        name: of the recording.
        load: [kg].
        time_step: [s].
        position, sigma: of the markers [m], (T, M, 3).
        release, start, last: frame before which the beam is held, and the first and the last frame to compare.
    """

    name: str
    load: float
    time_step: float
    position: Array
    sigma: Array
    release: int
    start: int
    last: int

    @property
    def settled_height(self) -> float:
        """Mean height of the markers at the end of the file [m]."""
        return float(self.position[-SETTLED_FRAMES:, :, 2].mean())

    def velocity(self, frame: int) -> Array:
        """Velocity of the markers [m/s], (M, 3), by differences of fourth order."""
        x = self.position[frame - 2 : frame + 3]
        velocity: Array = (x[0] - 8 * x[1] + 8 * x[3] - x[4]) / (12 * self.time_step)
        return velocity


def read_beam(specimen: Specimen, folder: Path, table: Path) -> tuple[Specimen, list[BeamRecording]]:
    """The specimen with its markers where they were when the beam was held straight, and its recordings."""
    rows = read_recording_rows(table)
    files = {row.recording: read_recording(find_sources(folder, row.recording)[0], 100.0) for row in rows}
    names, _ = combined_layout(specimen)
    own = len(specimen.layout.names)
    pose = fit_rest(files[STRAIGHT.recording], STRAIGHT, specimen, LAYOUT_TOLERANCE).fit.transform
    lower = [names.index(name) for name in LOWER_CLAMP_MARKERS]
    clamp = pose.apply(files[STRAIGHT.recording].position)[-SETTLED_FRAMES:, lower].mean(0)
    recordings = []
    for row in rows:
        file = files[row.recording]
        assert file.names == names
        assert row.first_frame is not None
        assert row.last_frame is not None
        position = pose.apply(file.position)
        position = turn_about_vertical(position[-SETTLED_FRAMES:, lower].mean(0), clamp).apply(position)[:, :own]
        lowest = turning_frame(-position[..., 2].mean(1), row.first_frame)
        recordings.append(
            BeamRecording(
                row.recording,
                1e-3 * row.load_g,
                float(np.median(np.diff(file.time))),
                position,
                file.sigma[:, :own],
                row.first_frame,
                turning_frame(position[..., 2].mean(1), lowest),
                row.last_frame,
            )
        )
    straight = next(item for item in recordings if item.name == STRAIGHT.recording).position[STRAIGHT.first]
    return replace(specimen, layout=MarkerLayout(specimen.layout.names, straight)), recordings


def turn_about_vertical(source: Array, target: Array) -> RigidTransform:
    """Turn about the vertical and translation from two points to two others, (2, 3)."""
    (x0, y0, _), (x1, y1, _) = source[1] - source[0], target[1] - target[0]
    angle = np.arctan2(y1, x1) - np.arctan2(y0, x0)
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform(rotation, target.mean(0) - rotation @ source.mean(0))


def turning_frame(height: Array, after: int) -> int:
    """The first frame after another in which the height (T) is the largest among those near it."""
    k = after + 1
    while height[k] < height[k - TURNING_FRAMES : k + TURNING_FRAMES + 1].max():
        k += 1
    return k


@dataclass(frozen=True)
class MovingDataset(Dataset):
    """A dataset whose recordings start in motion.

    Attributes:
        history: node positions of every recording in the frames before its first, since the release [m], (H, N, 3).
            Empty if the material has no memory.
    """

    history: dict[str, Array] | None = None

    def start(self, recordings: list[str]) -> Start:
        """Initial states, loads and histories; the oldest positions of a short history are repeated."""
        start = super().start(recordings)
        if not self.history:
            return start
        longest = max(len(path) for path in self.history.values())
        paths = [np.pad(p, ((longest - len(p), 0), (0, 0), (0, 0)), "edge") for p in map(self.history.get, recordings)]
        return replace(start, history=torch.from_numpy(np.stack(paths, axis=1)))


def moving_dataset(specimen: Specimen, recordings: list[BeamRecording], history: dict[str, Array]) -> MovingDataset:
    """The dataset of a specimen from `read_beam`, with histories from `fit_history` or none."""
    simulator = specimen.simulator(recordings[0].time_step)
    dataset = MovingDataset(specimen.name, simulator, specimen.markers(MARKER_TOLERANCE), {}, history=history)
    items = {item.name: _trajectory(dataset, specimen, item) for item in recordings}
    dataset = replace(dataset, trajectories=items)
    dataset.check()
    return dataset


def _first_frame(dataset: Dataset, specimen: Specimen, recording: BeamRecording, frame: int) -> FirstFrame:
    position, sigma = recording.position[frame], recording.sigma[frame]
    return FirstFrame(dataset.simulator, dataset.markers, specimen.loaded, position, sigma, recording.name)


def _trajectory(dataset: Dataset, specimen: Specimen, recording: BeamRecording) -> Trajectory:
    frame = _first_frame(dataset, specimen, recording, recording.start)
    initial = fit_first_frame(frame)
    velocity = fit_velocity(frame, initial.q, recording.velocity(recording.start), frame.sigma / recording.time_step)
    compared = slice(recording.start, recording.last + 1)
    markers, sigma = recording.position[compared], recording.sigma[compared].copy()
    sigma[..., 1] = np.inf
    height = specimen.mesh.vertices[specimen.loaded, 2]
    edge = specimen.loaded[np.isclose(height, height.max())]
    from_middle = np.abs(height - height.mean())
    middle = specimen.loaded[np.isclose(from_middle, from_middle.min())]
    added_mass = np.zeros(len(specimen.mesh.vertices))
    added_mass[middle] = recording.load / len(middle)
    return Trajectory(
        recording.time_step * np.arange(len(markers)),
        markers,
        np.isfinite(markers[..., 0]),
        sigma,
        initial.q,
        velocity,
        initial.force,
        load_force(dataset.simulator, edge, recording.load),
        added_mass,
        "train",
        {"load_g": 1e3 * recording.load},
    )


def fit_history(dataset: Dataset, specimen: Specimen, recordings: list[BeamRecording]) -> dict[str, Array]:
    """Node positions in the frames from each release to the frame before the first compared one [m], (H, N, 3)."""
    return {
        item.name: np.stack(
            [
                fit_first_frame(_first_frame(dataset, specimen, item, frame)).q
                for frame in range(item.release, item.start)
            ]
        )
        for item in recordings
    }
