"""When the load leaves."""

import numpy as np
import pytest
from rafl.capture.registration.release import Release, find_release
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen

BEFORE, FRAMES, FINE = 40, 60, 20  # frames of rest, of motion, and how many times finer time is simulated


@pytest.fixture(scope="module")
def motion(small_specimen: Specimen) -> np.ndarray:
    """A release in twentieths of a frame, some surface vertices, (T, M, 3)."""
    q = tip_load_release(small_specimen, small_specimen.material, 0.08, FRAMES * FINE, 100.0 * FINE).q
    return q[:, np.unique(small_specimen.mesh.surface)[::5]]


@pytest.mark.parametrize("late", [0, 3, 7, 14, 17])
def test_the_frame_nearest_to_the_release_is_found(motion: np.ndarray, late: int) -> None:
    release = find_release(released(motion, late))
    assert release.start == BEFORE - 1 + round(late / FINE)
    assert release.still <= 3


@pytest.mark.parametrize("late", [8, 9, 10, 11, 12])
def test_about_the_middle_of_two_frames_either_is_found(motion: np.ndarray, late: int) -> None:
    assert find_release(released(motion, late)).start in (BEFORE - 1, BEFORE)


def released(motion: np.ndarray, late: int) -> np.ndarray:
    """Released so many twentieths of a frame after frame 39; noise of 5 micrometres; one marker never seen."""
    random = np.random.default_rng(late)
    rest = np.broadcast_to(motion[0], (BEFORE, *motion.shape[1:]))
    position = np.concatenate([rest, motion[(FINE - late) % FINE :: FINE] if late else motion[FINE::FINE]])
    position = position + random.normal(0, 5e-6, position.shape)
    position[:, 3] = np.nan
    return position


def test_a_recording_that_begins_with_the_release(motion: np.ndarray) -> None:
    assert find_release(motion[::FINE]) == Release(0, 0)


def test_a_recording_that_begins_in_motion_begins_at_once(motion: np.ndarray) -> None:
    assert find_release(motion[5 * FINE :: FINE]).start == 0


def test_hands_that_shake_before_they_let_go(motion: np.ndarray) -> None:
    """The stretch of rest is only what stands still; markers that come and go do not matter."""
    random = np.random.default_rng(1)
    sway = 3e-3 * np.cos(np.linspace(0, 2 * np.pi, 25))[:, None, None] - 3e-3
    moved = motion[0] + np.concatenate([sway, np.zeros((15, 1, 1))])
    position = np.concatenate([moved, motion[FINE::FINE]]) + random.normal(0, 5e-6, (99, *motion.shape[1:]))
    position[random.random(position.shape[:2]) < 0.1] = np.nan
    release = find_release(position)
    assert release.start == BEFORE - 1
    assert 22 <= release.still <= 30


def test_single_wrong_frames_are_no_release(motion: np.ndarray) -> None:
    position = np.concatenate([np.repeat(motion[:1], BEFORE, axis=0), motion[FINE::FINE]])
    position += np.random.default_rng(3).normal(0, 5e-6, position.shape)
    position[[6, 20]] += 0.02
    release = find_release(position)
    assert release.start == BEFORE - 1
    assert 20 < release.still <= 22


def test_no_motion_and_no_markers() -> None:
    assert find_release(np.full((9, 4, 3), np.nan)).start == 0
    assert find_release(np.zeros((9, 4, 3))).start == 0
