"""The time that a swap takes in a long recording."""

import time
from pathlib import Path

import numpy as np
from filmed import RIG
from synthetic_tracks import tracks_of_pixels

from rafl.review.tracks.edits import Action, perform
from rafl.review.tracks.recordings import Library
from rafl.tracking.reconstruction.tracks import Tracks, write_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels

ROWS, MARKERS = 10_000, 40
LIMIT_S = 0.2  # of a processor's time


def test_swaps_over_ten_thousand_rows_and_forty_markers(tmp_path: Path, random: np.random.Generator) -> None:
    """Swaps from any row on, one upon the other; the first one changes nearly all rows of two markers."""
    write_tracks(tmp_path / "long.h5", _tracks(random))
    library = Library(tmp_path, None, "Ann")
    recording = library.open("long")
    times = []
    for number in range(12):
        row = 10 if number == 0 else int(random.integers(10, 9000))
        marker, other = (f"m{k}" for k in random.choice(MARKERS, 2, replace=False))
        start = time.process_time()
        perform(recording, "one", Action(kind="swap", camera="left", marker=marker, other=other, row=row))
        times.append(time.process_time() - start)
    library.close()
    print("swaps:", [f"{1e3 * value:.0f} ms" for value in times])
    assert np.median(times) < LIMIT_S


def _tracks(random: np.random.Generator) -> Tracks:
    clock = np.arange(ROWS) / 100.0
    grid = np.stack([0.01 * (np.arange(MARKERS) % 8), np.zeros(MARKERS), 0.01 * (np.arange(MARKERS) // 8)], axis=1)
    truth = grid + 0.002 * np.sin(2.0 * np.pi * clock)[:, None, None] * np.array([0.0, 0.5, 1.0])
    pixels = {}
    for name, camera in RIG.cameras.items():
        path = camera.project(truth)
        pixels[name] = CameraPixels(path + random.normal(0.0, 0.02, path.shape), np.full_like(path, 0.02))
    return tracks_of_pixels(tuple(f"m{k}" for k in range(MARKERS)), RIG, pixels, longest_gap=5)
