"""Random bending motions of dotted beams in the picture, for the tracking benchmark."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class Beam:
    """A dotted beam's dots in every frame.

    Attributes:
        centres: [px], (T, D, 2).
        spacing: of the dots [px].
        radius: of the dots [px].
        size: of the picture that holds all of it, width, height [px].
        fastest: move of any dot between two frames, in spacings.
    """

    centres: np.ndarray
    spacing: float
    radius: float
    size: tuple[int, int]
    fastest: float


def random_beam(random: np.random.Generator, frames: int, fastest: float) -> Beam:
    """A cantilever that vibrates in two modes, its tip moving up to `fastest` spacings a frame.

    Dots stand in equal rows; cross-sections stay straight and turn with the beam. The recording begins
    anywhere in the motion, the beam points anywhere.
    """
    rows, columns = int(random.integers(2, 5)), int(random.integers(5, 13))
    spacing = float(random.uniform(26, 48))
    radius = float(random.uniform(4.0, min(9.0, spacing / 3.3)))
    along = spacing * (np.arange(columns) + 0.5)
    across = spacing * (np.arange(rows) - 0.5 * (rows - 1)) * random.uniform(0.9, 1.3)
    length = along[-1] + 0.5 * spacing
    time = np.arange(frames) + random.uniform(0, 100)
    slow, fast = random.uniform(0.03, 0.11), random.uniform(0.15, 0.24)  # cycles a frame
    share = random.uniform(0.0, 0.12)
    wave = np.sin(2 * np.pi * slow * time) * np.exp(-random.uniform(0, 0.01) * np.arange(frames))
    second = share * np.sin(2 * np.pi * fast * time + random.uniform(0, 6))
    fine = np.linspace(0, length, 400)
    s = fine / length

    def shapes(size: float) -> np.ndarray:
        # The slope along the beam in every frame, whose integral is the centre line.
        slope = size * (wave[:, None] * (2 * s - s**2) + second[:, None] * np.sin(2.5 * np.pi * s) * s)
        step = fine[1] - fine[0]
        line = np.stack([np.cumsum(np.cos(slope), 1), np.cumsum(np.sin(slope), 1)], axis=-1) * step
        at = np.clip(np.searchsorted(fine, along), 0, len(fine) - 1)
        turn = slope[:, at]
        normal = np.stack([-np.sin(turn), np.cos(turn)], axis=-1)
        return (line[:, at, None] + across[:, None] * normal[:, :, None]).reshape(frames, -1, 2)

    def largest(size: float) -> float:
        return float(np.linalg.norm(np.diff(shapes(size), axis=0), axis=2).max() / spacing)

    low, high = 0.0, 0.9
    if largest(high) > fastest:
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if largest(middle) < fastest else (low, middle)
    else:
        low = high
    while _nearest(shapes(low)) < 2.4 * radius:  # skin does not fold so far that its dots touch
        low *= 0.9
    centres = shapes(low)
    angle = random.uniform(0, 2 * np.pi)
    centres = centres @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    margin = 1.2 * spacing + 2 * radius
    centres += margin - centres.min(axis=(0, 1))
    size = np.ceil(centres.max(axis=(0, 1)) + margin).astype(int)
    return Beam(centres, spacing, radius, (int(size[0]), int(size[1])), largest(low))


def _nearest(centres: np.ndarray) -> float:
    """The least distance of two dots in any frame [px]."""
    return min(float(cKDTree(frame).query(frame, 2)[0][:, 1].min()) for frame in centres)
