import numpy as np
import pytest
from rafl.tracking.linking.matching import Pattern, recognise


def grid(columns: int = 9, rows: int = 3) -> np.ndarray:
    x, y = np.meshgrid(40 + 30.0 * np.arange(columns), 80 + 30.0 * np.arange(rows))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def bent(rest: np.ndarray, angle: float) -> np.ndarray:
    """Sections stay straight and turn evenly, by `angle` at the far end."""
    length = np.ptp(rest[:, 0])
    s = (rest[:, 0] - rest[:, 0].min()) / length
    turn = angle * s
    fine = np.linspace(0, 1, 500)
    line = np.cumsum(np.stack([np.cos(angle * fine), np.sin(angle * fine)], axis=1), axis=0) * length / 500
    middle = np.stack([np.interp(s, fine, line[:, k]) for k in range(2)], axis=1)
    across = rest[:, 1] - rest[:, 1].mean()
    return middle + across[:, None] * np.stack([-np.sin(turn), np.cos(turn)], axis=1) + [60.0, 300.0]


@pytest.mark.parametrize("angle", [0.35, -0.35])
def test_moves_of_more_than_a_spacing(angle: float, random: np.random.Generator) -> None:
    """Nothing is known of the motion, and the tip jumps by more than a spacing."""
    before, after = bent(grid(), 0.1), bent(grid(), 0.1 + angle)
    assert np.linalg.norm(after - before, axis=1).max() > 38
    mixed = random.permutation(27)
    match, _ = recognise(Pattern.of(before), before, before, np.zeros(27), after[mixed], 2.2, 0.3, np.zeros(27))
    np.testing.assert_array_equal(mixed[match], np.arange(27))


def test_hidden_dots_and_false_ones(random: np.random.Generator) -> None:
    before, after = bent(grid(), 0.0), bent(grid(), 0.25)
    shown = np.delete(np.arange(27), [3, 4, 12, 13, 21])
    dots = np.concatenate([after[shown], [[150.0, 200.0], [300.0, 420.0]]])
    match, _ = recognise(Pattern.of(before), before, before, np.zeros(27), dots, 2.2, 0.3, np.zeros(27))
    np.testing.assert_array_equal(np.flatnonzero(match < 0), [3, 4, 12, 13, 21])
    np.testing.assert_array_equal(shown[match[match >= 0]], np.flatnonzero(match >= 0))


@pytest.mark.parametrize("away", [1, 2, 3])
def test_all_but_a_few_keep_still(away: int) -> None:
    """Only what is beside the body's end has moved, to where none of it can be: nobody takes another's dot."""
    dots = grid()
    dots[:away] += [0.0, 700.0]
    match, _ = recognise(Pattern.of(grid()), grid(), grid(), np.zeros(27), dots, 2.2, 1.0, np.zeros(27))
    np.testing.assert_array_equal(match[away:], np.arange(away, 27))
    assert (match[:away] < 0).all()


def curled(turn: float) -> np.ndarray:
    """Nine pairs of markers; from the third on each turns on by that much."""
    angle = np.cumsum([0.0, 0.0, 0.0, *[turn] * 6])
    step = 30.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal = 12.0 * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    return np.stack([np.cumsum(step, axis=0) + normal, np.cumsum(step, axis=0) - normal], axis=1).reshape(-1, 2)


def test_who_is_in_sight_keeps_its_place_when_others_come_back() -> None:
    """Three pairs in sight hardly move; three more return, bent on so far that all moved on by a pair would fit better.

    Without a reward for steady markers, all are taken for their neighbours.
    """
    believed, dots = curled(0.5), curled(0.8)[:12]
    seen = np.arange(18) < 6
    match, _ = recognise(
        Pattern.of(curled(0.0)), believed, believed, np.where(seen, 0.0, -5.0), dots, 2.2, 1.0, np.where(seen, 1.0, 0.0)
    )
    np.testing.assert_array_equal(match[:6], np.arange(6))
