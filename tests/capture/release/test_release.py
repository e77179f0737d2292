"""Detection of the release."""

import numpy as np
import pytest

from rafl.capture.release.release import Release, find_release
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen

REST_FRAMES, MOTION_FRAMES, SUBFRAMES = 40, 60, 20  # the simulation has SUBFRAMES steps per frame


@pytest.fixture(scope="module")
def motion(small_specimen: Specimen) -> np.ndarray:
    """Some surface vertices after a release, in steps of 1/20 frame, (T, M, 3)."""
    q = tip_load_release(small_specimen, small_specimen.material, 0.08, MOTION_FRAMES * SUBFRAMES, 100.0 * SUBFRAMES).q
    return q[:, np.unique(small_specimen.mesh.surface)[::5]]


@pytest.mark.parametrize("delay", [0, 3, 7, 14, 17])
def test_the_frame_nearest_to_the_release_is_found(motion: np.ndarray, delay: int) -> None:
    release = find_release(released(motion, delay))
    assert release.start == REST_FRAMES - 1 + round(delay / SUBFRAMES)
    assert release.rest_start <= 3


@pytest.mark.parametrize("delay", [8, 9, 10, 11, 12])
def test_a_release_midway_between_two_frames_gives_either(motion: np.ndarray, delay: int) -> None:
    assert find_release(released(motion, delay)).start in (REST_FRAMES - 1, REST_FRAMES)


def released(motion: np.ndarray, delay: int) -> np.ndarray:
    """Recording released `delay` / 20 frames after frame 39, with noise of 5 micrometres and one missing marker."""
    random = np.random.default_rng(delay)
    rest = np.broadcast_to(motion[0], (REST_FRAMES, *motion.shape[1:]))
    position = np.concatenate(
        [rest, motion[(SUBFRAMES - delay) % SUBFRAMES :: SUBFRAMES] if delay else motion[SUBFRAMES::SUBFRAMES]]
    )
    position = position + random.normal(0, 5e-6, position.shape)
    position[:, 3] = np.nan
    return position


def test_a_recording_that_begins_with_the_release(motion: np.ndarray) -> None:
    assert find_release(motion[::SUBFRAMES]) == Release(0, 0)


def test_a_recording_that_begins_in_motion_starts_at_its_first_frame(motion: np.ndarray) -> None:
    assert find_release(motion[5 * SUBFRAMES :: SUBFRAMES]).start == 0


def test_sway_before_the_release_is_not_rest(motion: np.ndarray) -> None:
    """The interval of rest starts when the sway ends, although 10 % of the marker positions are missing."""
    random = np.random.default_rng(1)
    sway = 3e-3 * np.cos(np.linspace(0, 2 * np.pi, 25))[:, None, None] - 3e-3
    moved = motion[0] + np.concatenate([sway, np.zeros((15, 1, 1))])
    position = np.concatenate([moved, motion[SUBFRAMES::SUBFRAMES]]) + random.normal(0, 5e-6, (99, *motion.shape[1:]))
    position[random.random(position.shape[:2]) < 0.1] = np.nan
    release = find_release(position)
    assert release.start == REST_FRAMES - 1
    assert 22 <= release.rest_start <= 30


def test_single_wrong_frames_are_not_a_release(motion: np.ndarray) -> None:
    position = np.concatenate([np.repeat(motion[:1], REST_FRAMES, axis=0), motion[SUBFRAMES::SUBFRAMES]])
    position += np.random.default_rng(3).normal(0, 5e-6, position.shape)
    position[[6, 20]] += 0.02
    release = find_release(position)
    assert release.start == REST_FRAMES - 1
    assert 20 < release.rest_start <= 22


def test_recordings_without_motion_or_markers_start_at_frame_0() -> None:
    assert find_release(np.full((9, 4, 3), np.nan)).start == 0
    assert find_release(np.zeros((9, 4, 3))).start == 0


def test_missing_frames_are_not_rest(motion: np.ndarray) -> None:
    """All markers are lost in frames 4 to 11, after a release at frame 0."""
    position = motion[::SUBFRAMES].copy()
    position[4:12] = np.nan
    assert find_release(position) == Release(0, 0)


def test_the_rest_begins_after_missing_frames(motion: np.ndarray) -> None:
    position = released(motion, 0)
    position[20:25] = np.nan
    assert find_release(position) == Release(REST_FRAMES - 1, 25)
