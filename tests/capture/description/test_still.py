"""The mean over the frames at rest."""

from dataclasses import replace

import numpy as np
import pytest
from stills import FRAMES, SIDES, still

from rafl.capture.description.still import dots_at_rest
from rafl.capture.registration.recording import Recording
from rafl.common.errors import InputError


def swing(frames: int) -> np.ndarray:
    """Displacement (T, 1, 3) [m] of a swing from rest."""
    time = np.arange(frames) / 100.0
    return 5e-3 * (1.0 - np.cos(2.0 * np.pi * 8.0 * time))[:, None, None] * [0.0, 0.0, 1.0]


def longer(recording: Recording, motion: np.ndarray) -> Recording:
    """The recording, then its last frame displaced by `motion` (T, 1, 3)."""
    noise = np.random.default_rng(2).normal(0.0, 1e-5, (len(motion), *recording.position.shape[1:]))
    position = np.concatenate([recording.position, recording.position[-1] + motion + noise])
    sigma = np.repeat(recording.sigma[:1], len(position), axis=0)
    return replace(recording, time=np.arange(len(position)) / 100.0, position=position, sigma=sigma)


def test_all_frames_are_averaged_if_nothing_moves() -> None:
    recording = still(SIDES)
    dots = dots_at_rest(recording, "still.h5")
    np.testing.assert_allclose(dots.position, recording.position.mean(axis=0), atol=1e-12)
    assert dots.names == recording.names


def test_the_rest_before_a_release_is_averaged() -> None:
    recording = still(SIDES)
    dots = dots_at_rest(longer(recording, swing(40)), "still.h5")
    assert np.abs(dots.position - recording.position.mean(axis=0)).max() < 2e-5
    assert np.abs(longer(recording, swing(40)).position.mean(axis=0) - recording.position.mean(axis=0)).max() > 2e-3


def test_frames_before_the_rest_are_left_out() -> None:
    """A hand lets go of the specimen in the first frames."""
    recording = still(SIDES)
    moved = recording.position.copy()
    moved[:4] += np.linspace(5e-3, 1e-3, 4)[:, None, None] * [0.0, 0.0, 1.0]
    dots = dots_at_rest(replace(recording, position=moved), "still.h5")
    np.testing.assert_allclose(dots.position, recording.position[4:].mean(axis=0), atol=1e-12)


def test_a_recording_that_never_rests_is_refused() -> None:
    recording = still(SIDES)
    moving = replace(longer(recording, swing(40)))
    moving = replace(moving, **{key: getattr(moving, key)[FRAMES + 3 :] for key in ("time", "position", "sigma")})
    with pytest.raises(InputError, match="found no rest in most of its 37 frames, nor before a release"):
        dots_at_rest(moving, "still.h5")


def test_two_dots_are_too_few() -> None:
    recording = still(SIDES)
    position = recording.position.copy()
    position[:, 2:] = np.nan
    with pytest.raises(InputError, match="at least 3 dots, found 2"):
        dots_at_rest(replace(recording, position=position), "still.h5")
    with pytest.raises(InputError, match="at least 3 dots, found 0"):
        dots_at_rest(replace(recording, position=np.full_like(position, np.nan)), "still.h5")
