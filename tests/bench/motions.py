"""Random bending motions of dotted beams in the image, for the tracking benchmark."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class Beam:
    """Motion of the dots on a beam.

    Attributes:
        centres: of the dots in every frame [px], (T, D, 2).
        spacing: of the dots [px].
        radius: of the dots [px].
        size: width and height of an image that contains the whole motion [px].
        max_displacement: largest displacement of a dot between two frames, in spacings.
    """

    centres: np.ndarray
    spacing: float
    radius: float
    size: tuple[int, int]
    max_displacement: float


def random_beam(random: np.random.Generator, frames: int, max_displacement: float) -> Beam:
    """A cantilever that vibrates in two modes.

    Dots form equal rows. Cross-sections stay straight and rotate with the beam. The phase at the first frame and the
    direction of the beam are random.

    Args:
        random: for everything that is drawn.
        frames: of the recording.
        max_displacement: upper limit of a dot's displacement between two frames, in spacings.
    """
    rows, columns = int(random.integers(2, 5)), int(random.integers(5, 13))
    spacing = float(random.uniform(26, 48))
    radius = float(random.uniform(4.0, min(9.0, spacing / 3.3)))
    along = spacing * (np.arange(columns) + 0.5)
    across = spacing * (np.arange(rows) - 0.5 * (rows - 1)) * random.uniform(0.9, 1.3)
    length = along[-1] + 0.5 * spacing
    time = np.arange(frames) + random.uniform(0, 100)
    first_frequency, second_frequency = random.uniform(0.03, 0.11), random.uniform(0.15, 0.24)  # cycles a frame
    ratio = random.uniform(0.0, 0.12)
    decay = np.exp(-random.uniform(0, 0.01) * np.arange(frames))
    first = np.sin(2 * np.pi * first_frequency * time) * decay
    second = ratio * np.sin(2 * np.pi * second_frequency * time + random.uniform(0, 6))
    arc_length = np.linspace(0, length, 400)
    s = arc_length / length

    def dot_centres(amplitude: float) -> np.ndarray:
        # The angle along the beam in every frame; its integral is the centre line.
        angle = amplitude * (first[:, None] * (2 * s - s**2) + second[:, None] * np.sin(2.5 * np.pi * s) * s)
        step = arc_length[1] - arc_length[0]
        line = np.stack([np.cumsum(np.cos(angle), 1), np.cumsum(np.sin(angle), 1)], axis=-1) * step
        at = np.clip(np.searchsorted(arc_length, along), 0, len(arc_length) - 1)
        rotation = angle[:, at]
        normal = np.stack([-np.sin(rotation), np.cos(rotation)], axis=-1)
        return (line[:, at, None] + across[:, None] * normal[:, :, None]).reshape(frames, -1, 2)

    def displacement(amplitude: float) -> float:
        return float(np.linalg.norm(np.diff(dot_centres(amplitude), axis=0), axis=2).max() / spacing)

    low, high = 0.0, 0.9
    if displacement(high) > max_displacement:
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if displacement(middle) < max_displacement else (low, middle)
    else:
        low = high
    while _min_distance(dot_centres(low)) < 2.4 * radius:  # dots on skin do not come into contact
        low *= 0.9
    centres = dot_centres(low)
    direction = random.uniform(0, 2 * np.pi)
    cos, sin = np.cos(direction), np.sin(direction)
    centres = centres @ np.array([[cos, sin], [-sin, cos]])
    margin = 1.2 * spacing + 2 * radius
    centres += margin - centres.min(axis=(0, 1))
    size = np.ceil(centres.max(axis=(0, 1)) + margin).astype(int)
    return Beam(centres, spacing, radius, (int(size[0]), int(size[1])), displacement(low))


def _min_distance(centres: np.ndarray) -> float:
    """Smallest distance between two dots in any frame [px]."""
    return min(float(cKDTree(frame).query(frame, 2)[0][:, 1].min()) for frame in centres)
