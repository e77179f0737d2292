import numpy as np
import pytest

from tracking.memory import MOST, Memory


def curled(turn: float, pairs: int = 7) -> np.ndarray:
    """Pairs of markers (2 * pairs, 2) [px]; from the second on each turns on by that much."""
    angle = turn * np.arange(pairs)
    step = 30.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal = 16.0 * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    return np.stack([np.cumsum(step, axis=0) + normal, np.cumsum(step, axis=0) - normal], axis=1).reshape(-1, 2)


OUT = np.arange(14) >= 8  # the three pairs at the tip are out of sight
EVERYONE = np.ones(14, bool)


def off(memory: Memory, turn: float) -> float:
    """The largest error of the hidden markers' places [px]."""
    now = curled(turn)
    carried = memory.carried(np.where(OUT[:, None], np.nan, now), ~OUT)
    np.testing.assert_array_equal(carried[~OUT], now[~OUT])
    return float(np.linalg.norm(carried - now, axis=1).max())


def test_who_hides_is_where_it_was_when_the_others_stood_so() -> None:
    memory = Memory(curled(0.0))
    alone = off(memory, 0.33)
    assert alone > 15.0  # a tip that curls on is not an affine image of itself at rest
    for turn in np.linspace(-0.5, 0.5, 21):
        memory.add(curled(turn), EVERYONE)
    assert off(memory, 0.33) < 0.15 * alone


def test_shapes_that_do_not_show_a_marker_say_nothing_of_it() -> None:
    """The nearest shapes hide the tip, with rubbish where it is believed; farther ones show it."""
    memory = Memory(curled(0.0))
    for turn in (0.25, 0.3, 0.35, 0.4):
        memory.add(curled(turn), EVERYONE)
    before = off(memory, 0.33)
    for turn in np.linspace(0.32, 0.34, 9):
        memory.add(np.where(OUT[:, None], 1e4, curled(turn)), ~OUT)
    assert off(memory, 0.33) == pytest.approx(before, abs=1e-9)


def test_long_recordings_are_remembered_from_first_to_last() -> None:
    """A swing that grows for 3000 frames: every one of its shapes is like one of those kept."""
    memory = Memory(curled(0.0))
    frames = 3000
    for t in range(frames):
        memory.add(curled(0.5 * t / frames * np.sin(0.37 * t)), EVERYONE)
    assert memory._shapes.shape == (MOST + 1, 14, 2)
    for turn in (-0.4, -0.2, 0.1, 0.3, 0.45):
        assert off(memory, turn) < 6.0  # from rest alone 23 to 98


def test_one_wrong_shape_is_outvoted() -> None:
    memory = Memory(curled(0.0))
    for turn in (0.3, 0.32, 0.34, 0.36):
        memory.add(curled(turn), EVERYONE)
    right = off(memory, 0.33)
    wrong = curled(0.33)
    wrong[8:12] = wrong[10:14]  # named on by a pair
    memory.add(wrong, EVERYONE)
    assert off(memory, 0.33) < right + 2.0


def test_one_more_marker_is_carried_from_rest_until_it_is_seen() -> None:
    rest = curled(0.0)
    memory = Memory(rest[:-1])
    for turn in np.linspace(0.0, 0.4, 9):
        memory.add(curled(turn)[:-1], EVERYONE[:-1])
    memory.join(rest[-1])
    known = np.arange(14) < 13
    now = curled(0.3)
    from_rest = memory.carried(now, known)[-1]
    for turn in np.linspace(0.2, 0.4, 5):
        memory.add(curled(turn), EVERYONE)
    seen = memory.carried(now, known)[-1]
    assert np.linalg.norm(seen - now[-1]) < 0.2 * np.linalg.norm(from_rest - now[-1]) < 6.0
