import numpy as np
import pytest

from rafl.tracking.linking.matching import MarkerPattern, match_markers


def grid(columns: int = 9, rows: int = 3) -> np.ndarray:
    x, y = np.meshgrid(40 + 30.0 * np.arange(columns), 80 + 30.0 * np.arange(rows))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def bent(rest: np.ndarray, angle: float) -> np.ndarray:
    """Bend with constant curvature to `angle` [rad] at the far end; sections stay straight."""
    length = np.ptp(rest[:, 0])
    s = (rest[:, 0] - rest[:, 0].min()) / length
    turn = angle * s
    fine = np.linspace(0, 1, 500)
    line = np.cumsum(np.stack([np.cos(angle * fine), np.sin(angle * fine)], axis=1), axis=0) * length / 500
    middle = np.stack([np.interp(s, fine, line[:, k]) for k in range(2)], axis=1)
    across = rest[:, 1] - rest[:, 1].mean()
    return middle + across[:, None] * np.stack([-np.sin(turn), np.cos(turn)], axis=1) + [60.0, 300.0]


@pytest.mark.parametrize("angle", [0.35, -0.35])
def test_displacements_larger_than_a_spacing(angle: float, random: np.random.Generator) -> None:
    """The motion is unknown, and the tip jumps by more than a spacing."""
    before, after = bent(grid(), 0.1), bent(grid(), 0.1 + angle)
    assert np.linalg.norm(after - before, axis=1).max() > 38
    mixed = random.permutation(27)
    match, _ = match_markers(
        MarkerPattern.of(before), before, before, np.zeros(27), after[mixed], 2.2, 0.3, np.zeros(27)
    )
    np.testing.assert_array_equal(mixed[match], np.arange(27))


def test_hidden_and_false_dots(random: np.random.Generator) -> None:
    before, after = bent(grid(), 0.0), bent(grid(), 0.25)
    shown = np.delete(np.arange(27), [3, 4, 12, 13, 21])
    dots = np.concatenate([after[shown], [[150.0, 200.0], [300.0, 420.0]]])
    match, _ = match_markers(MarkerPattern.of(before), before, before, np.zeros(27), dots, 2.2, 0.3, np.zeros(27))
    np.testing.assert_array_equal(np.flatnonzero(match < 0), [3, 4, 12, 13, 21])
    np.testing.assert_array_equal(shown[match[match >= 0]], np.flatnonzero(match >= 0))


@pytest.mark.parametrize("moved", [1, 2, 3])
def test_dots_that_keep_still_keep_their_markers(moved: int) -> None:
    """Only the first dots have moved, too far for any marker. No marker takes another one's dot."""
    dots = grid()
    dots[:moved] += [0.0, 700.0]
    match, _ = match_markers(MarkerPattern.of(grid()), grid(), grid(), np.zeros(27), dots, 2.2, 1.0, np.zeros(27))
    np.testing.assert_array_equal(match[moved:], np.arange(moved, 27))
    assert (match[:moved] < 0).all()


def curled(turn: float) -> np.ndarray:
    """Nine pairs of markers; from the third on, each is rotated by `turn` [rad] against the last."""
    angle = np.cumsum([0.0, 0.0, 0.0, *[turn] * 6])
    step = 30.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal = 12.0 * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    return np.stack([np.cumsum(step, axis=0) + normal, np.cumsum(step, axis=0) - normal], axis=1).reshape(-1, 2)


def test_visible_markers_keep_their_dots_when_others_reappear() -> None:
    """Three visible pairs hardly move. Three more reappear, bent so far that a shift by one pair would fit better.

    Without the steady bonus, all markers would be matched to their neighbours' dots.
    """
    predicted, dots = curled(0.5), curled(0.8)[:12]
    seen = np.arange(18) < 6
    match, _ = match_markers(
        MarkerPattern.of(curled(0.0)),
        predicted,
        predicted,
        np.where(seen, 0.0, -5.0),
        dots,
        2.2,
        1.0,
        np.where(seen, 1.0, 0.0),
    )
    np.testing.assert_array_equal(match[:6], np.arange(6))
