"""Frames shown again are found amid a motion, and neither a rest nor a turning point is taken for one."""

import numpy as np
import pytest

from rafl.tracking.linking.repeated_frames import find_repeated_frames

SIGMA = 0.02  # [px]
FPS = 100.0


def swing(frames: int, hertz: float, amplitude: float, phase: float = 0.0, decay: float = 1.0) -> np.ndarray:
    """Positions (T, D, 2) of dots that swing by up to `amplitude` [px]."""
    time = np.arange(frames)[:, None, None] / FPS
    rest = np.random.default_rng(3).uniform(0.0, 400.0, (12, 2))
    reach = amplitude * np.stack([np.linspace(0.1, 0.4, 12), np.linspace(0.2, 1.0, 12)], axis=1)
    return rest + reach * np.exp(-decay * time) * np.cos(2.0 * np.pi * hertz * time + phase)


def shown(positions: np.ndarray, source: np.ndarray, noise: float = SIGMA) -> np.ndarray:
    """What the video shows if frame t shows frame source[t]."""
    exposed = positions + np.random.default_rng(5).normal(0.0, noise, positions.shape)
    return exposed[source]


def found(pixel: np.ndarray) -> list[int]:
    return np.flatnonzero(find_repeated_frames(pixel, np.full_like(pixel, SIGMA))).tolist()


@pytest.mark.parametrize("repeated", [[7], [20, 21, 22], [5, 30, 31], list(range(12, 21))])
def test_frames_shown_again_are_found(repeated: list[int]) -> None:
    source = np.arange(60)
    for frame in repeated:
        source[frame] = source[frame - 1]
    assert found(shown(swing(60, 3.1, 40.0), source)) == repeated


def test_a_video_of_twice_the_frame_rate_shows_every_frame_twice() -> None:
    """All are found but the first and those at turning points, where the error is small."""
    twice = found(shown(swing(30, 3.1, 40.0), np.arange(60) // 2))
    assert len(twice) >= 24
    assert all(frame % 2 == 1 for frame in twice)


def test_a_video_that_stands_still_to_its_end_is_found() -> None:
    source = np.minimum(np.arange(60), 44)
    assert found(shown(swing(60, 3.1, 40.0), source)) == list(range(45, 60))


@pytest.mark.parametrize("hertz", [1.0, 5.0, 12.5, 25.0])
@pytest.mark.parametrize("phase", np.linspace(0.0, np.pi, 7))
def test_a_swing_with_turning_points_is_left_alone(hertz: float, phase: float) -> None:
    """At 25 Hz and some phases, the dots are at one place in two frames, without noise too."""
    pixel = swing(200, hertz, 60.0, phase, decay=4.0)
    assert found(shown(pixel, np.arange(200))) == []
    assert found(pixel) == []


def test_rest_is_left_alone() -> None:
    """A release from rest and a swing that dies, in a video that codes no noise."""
    moving = swing(200, 4.0, 60.0, decay=8.0)
    pixel = np.concatenate([np.repeat(moving[:1], 30, axis=0), moving])
    assert found(np.round(pixel, 2)) == []


def test_missing_dots_and_frames_are_no_evidence() -> None:
    pixel = swing(60, 3.1, 40.0)
    pixel[20:24] = np.nan
    pixel[40, 2:] = np.nan
    pixel[40, :2] = pixel[39, :2]
    assert found(pixel) == []
