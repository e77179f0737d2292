"""The first frame that is used, and the state of the specimen in it."""

import numpy as np
import pytest
from support import SHARED
from swings import bent, joined, slack_string, swing, touching_load

from rafl.capture.dataset.sources import read_recording
from rafl.capture.release.motion_start import MotionStart, find_motion_start

GAP, BEAM = SHARED / "cases" / "c3d-gap-after-release" / "in", SHARED / "real" / "clamped_beam"
HELD = np.full(31, -0.02)  # 30 frames at rest, and the first of the motion


def test_a_release_from_rest_starts_at_rest() -> None:
    found = find_motion_start(bent(joined(HELD, swing(100, -0.02))), "auto", None)
    assert found == MotionStart(30, 0, False, "the motion")


@pytest.mark.parametrize("first", [1, 3, 4])
def test_a_recording_that_moves_in_its_first_frame_starts_there(first: int) -> None:
    found = find_motion_start(bent(swing(100, -0.02)[first:]), "auto", None)
    assert found == MotionStart(0, 0, True, "the motion")


def test_the_start_moves_to_where_a_slack_string_is_taut() -> None:
    held = np.full(31, 0.012)
    found = find_motion_start(bent(joined(held, slack_string())), "auto", None)
    assert found.moving
    assert found.frame in (35, 36, 37)
    assert found.not_free == found.frame - 30
    assert found.rest_start == found.frame


def test_the_start_moves_after_a_load_that_touches_again() -> None:
    found = find_motion_start(bent(joined(HELD, touching_load())), "auto", None)
    assert found.frame in (46, 47, 48)
    assert found.not_free == found.frame - 30


def test_a_hand_that_lowers_the_load_is_no_rest() -> None:
    """The specimen moves when it is let go, after 20 frames in which a hand lowered the load."""
    lowered = np.linspace(-0.02, -0.012, 21)
    found = find_motion_start(bent(joined(HELD, lowered, swing(100, -0.012, 4e-4))), "auto", None)
    assert abs(found.frame - 50) <= 1
    assert found.rest_start == found.frame


@pytest.mark.parametrize("gap", [slice(25, 29), slice(34, 42)])
def test_missing_frames_around_the_release_change_nothing(gap: slice) -> None:
    position = bent(joined(HELD, swing(100, -0.02)))
    position[gap] = np.nan
    found = find_motion_start(position, "auto", None)
    assert (found.frame, found.moving, found.not_free) == (30, False, 0)


@pytest.mark.parametrize("gap", [slice(28, 34), slice(31, 37)])
def test_a_release_that_nothing_shows_gives_a_start_in_motion(gap: slice) -> None:
    position = bent(joined(HELD, swing(100, -0.02)))
    position[gap] = np.nan
    found = find_motion_start(position, "auto", None)
    assert gap.stop <= found.frame <= gap.stop + 1
    assert found.moving


def test_missing_frames_in_a_recording_that_begins_with_the_release() -> None:
    position = bent(swing(100, -0.02))
    position[4:12] = np.nan
    assert find_motion_start(position, "auto", None) == MotionStart(0, 0, False, "the motion")


def test_a_state_or_frame_that_is_given_is_kept() -> None:
    position = bent(joined(np.full(31, 0.012), slack_string()))
    assert find_motion_start(position, "rest", None) == MotionStart(30, 0, False, "the motion")
    assert find_motion_start(position, "moving", None) == MotionStart(0, 0, True, "the beginning")
    assert find_motion_start(position, "moving", 12) == MotionStart(12, 12, True, "given")
    assert find_motion_start(position, "auto", 45) == MotionStart(45, 45, True, "given")
    assert find_motion_start(position, "auto", 30) == MotionStart(30, 0, False, "given")


@pytest.mark.skipif(not GAP.is_dir(), reason=f"recordings with gaps absent at {GAP}")
@pytest.mark.parametrize("name", ["load060g", "load120g"])
def test_a_recorded_gap_after_the_release_does_not_move_the_start(name: str) -> None:
    found = find_motion_start(read_recording(GAP / f"{name}.c3d", 100.0).position, "auto", None)
    assert (found.frame, found.not_free) == (0, 0)


@pytest.mark.real
@pytest.mark.skipif(not BEAM.is_dir(), reason=f"real recordings absent at {BEAM}")
def test_a_real_beam_is_free_once_its_string_is_taut() -> None:
    """The beam without a load is let go at frame 65. The tip with a load falls alone for some 70 ms, seven frames."""
    found = {
        name: find_motion_start(read_recording(BEAM / f"beam_{name}.c3d", 100.0).position[:, :3], "auto", None)
        for name in ("gravity_V2_b", "load52_V2_a", "load101_V2_a")
    }
    free, *loaded = found.values()
    assert abs(free.frame - 65) <= 1
    assert not free.moving
    assert free.not_free == 0
    for start, release in zip(loaded, (43, 51), strict=True):
        assert start.moving
        assert 4 <= start.frame - release <= 10
