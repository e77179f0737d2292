"""Where markers out of sight are, by shapes that no two of the model's own ways add up to."""

import numpy as np
import pytest
from rafl.tracking.linking.shape_prior import MOST, Belief, Memory
from support import curled

OUT = np.arange(14) >= 8  # the three pairs at the tip are out of sight
EVERYONE = np.ones(14, bool)


def off(memory: Memory, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the hidden markers' places, and what they are said to be [px], (6)."""
    belief = memory.carried(np.where(OUT[:, None], np.nan, now), ~OUT)
    np.testing.assert_array_equal(belief.place[~OUT], now[~OUT])
    assert (belief.sigma[~OUT] == 0.0).all()
    return np.linalg.norm(belief.place - now, axis=1)[OUT], belief.sigma[OUT]


def remembering(*turns: float) -> Memory:
    memory = Memory(curled(0.0))
    for turn in turns:
        memory.add(curled(turn), EVERYONE)
    return memory


def test_who_hides_is_where_it_was_when_the_others_stood_so() -> None:
    alone, vague = off(Memory(curled(0.0)), curled(0.33))
    assert alone.max() > 5.0
    assert (vague > 0.3 * alone).all()
    error, sigma = off(remembering(*np.linspace(-0.5, 0.5, 21)), curled(0.33))
    assert error.max() < 0.2 * alone.max()
    assert (error < 3.0 * sigma).all()
    assert sigma.max() < vague.max()


@pytest.mark.parametrize("turn", [0.05, -0.2])
def test_a_turned_and_moved_body_needs_no_memory(turn: float) -> None:
    cos, sin = np.cos(turn), np.sin(turn)
    now = curled(0.0) @ np.array([[cos, sin], [-sin, cos]]) + [300.0, -120.0]
    error, sigma = off(Memory(curled(0.0)), now)
    assert error.max() < 1.0
    assert (error < 3.0 * sigma).all()


def test_farther_from_those_in_sight_less_is_known() -> None:
    _, sigma = off(remembering(0.0, 0.1, 0.2), curled(0.15))
    assert (np.diff(sigma.reshape(3, 2).mean(axis=1)) > 0.0).all()


def test_who_was_never_seen_is_as_vague_as_ever() -> None:
    """However many shapes there are that show the others."""
    memory = Memory(curled(0.0))
    for turn in np.linspace(0.02, 0.4, 40):
        memory.add(curled(turn), ~OUT)
    before = off(Memory(curled(0.0)), curled(0.2))[1]
    assert off(memory, curled(0.2))[1].min() > 0.5 * before.min()


def test_a_guess_counts_as_much_as_it_is_sure() -> None:
    memory, now = remembering(0.0, 0.1), curled(0.33)
    told = np.where(OUT[:, None], np.nan, now)

    def miss(spread: float) -> float:
        belief = memory.carried(told, ~OUT, Belief(now, np.full(14, spread)))
        return float(np.linalg.norm(belief.place - now, axis=1).max())

    assert miss(0.3) < 1.0
    assert miss(0.3) < miss(3.0) < miss(np.inf)
    assert miss(np.inf) == off(memory, now)[0].max()


def test_long_recordings_are_remembered_from_first_to_last() -> None:
    """A swing that grows for 3000 frames: every one of its shapes is like one of those kept."""
    memory = Memory(curled(0.0))
    frames = 3000
    for t in range(frames):
        memory.add(curled(0.5 * t / frames * np.sin(0.37 * t)), EVERYONE)
    assert 0.5 * MOST <= len(memory) <= MOST
    vague = off(Memory(curled(0.0)), curled(0.3))[1].max()
    for turn in (-0.4, -0.2, 0.1, 0.3, 0.45):
        error, sigma = off(memory, curled(turn))
        assert error.max() < 1.5
        assert (error < 3.0 * sigma).all()
        assert sigma.max() < 0.2 * vague


def test_what_stands_still_is_remembered_once() -> None:
    assert len(remembering(*([0.1] * 50))) == 1


def test_one_wrong_shape_is_outvoted() -> None:
    memory = remembering(*np.linspace(-0.4, 0.4, 17))
    wrong = curled(0.33)
    wrong[8:12] = wrong[10:14]  # named on by a pair, 30 px away
    memory.add(wrong, EVERYONE)
    assert off(memory, curled(0.33))[0].max() < 10.0


def test_evidence_tells_shapes_from_muddles() -> None:
    memory, now = remembering(*np.linspace(-0.5, 0.5, 21)), curled(0.27)
    likely, surprise = memory.evidence(now, EVERYONE)
    muddled = now.copy()
    muddled[[2, 3]] = muddled[[3, 2]]
    unlikely, surprised = memory.evidence(muddled, EVERYONE)
    assert unlikely < likely - 12.0
    assert surprise < 1.0 < 4.0 < surprised


def test_one_more_marker_is_carried_with_the_others() -> None:
    rest = curled(0.0)
    memory = Memory(rest[:-1])
    for turn in np.linspace(0.0, 0.4, 9):
        memory.add(curled(turn)[:-1], EVERYONE[:-1])
    memory = memory.join(rest[-1])
    known = np.arange(14) < 13
    now = curled(0.3)
    place, sigma = memory.carried(now, known)
    assert np.linalg.norm(place[-1] - now[-1]) < 3.0 * sigma[-1] < 30.0
    for turn in np.linspace(0.2, 0.4, 8):
        memory.add(curled(turn), EVERYONE)
    place, sigma = memory.carried(now, known)
    assert np.linalg.norm(place[-1] - now[-1]) < min(3.0 * sigma[-1], 0.5)
