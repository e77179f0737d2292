"""Dots in part behind something."""

from dataclasses import replace

import numpy as np
import pytest
from rafl.tracking.detection.appearance import find_family
from rafl.tracking.detection.detect import Dots
from rafl.tracking.detection.partial_occlusion import Outlines
from rafl.tracking.linking.tracker import Tracker
from support import picture

SIZE = (360, 240)
REST = np.stack(np.meshgrid(40.0 + 34.0 * np.arange(8), 80.0 + 34.0 * np.arange(3)), axis=-1).reshape(-1, 2)


def seen(widths: np.ndarray) -> Dots:
    """Dots (M) with these half widths along x and y (M, 2) [px], located to 0.01 px."""
    dots = Dots.none(len(widths))
    parameters = np.zeros((len(widths), 12))
    parameters[:, :2], parameters[:, [2, 4]] = REST[: len(widths)], 1.0 / widths
    return replace(
        dots, sigma=np.full((len(widths), 2), 0.01), parameters=parameters, vague=np.full(len(widths), 0.002)
    )


def looked(frames: int, random: np.random.Generator) -> Outlines:
    """At 24 dots of a radius of 8 px that change by some thousandths."""
    outlines = Outlines(seen(np.full((24, 2), 8.0)))
    for _ in range(frames):
        outlines.judge(seen(8.0 + random.normal(0.0, 0.02, (24, 2))), REST)
    return outlines


@pytest.mark.parametrize("level", [20, 110, 230])
@pytest.mark.parametrize("across", [False, True])
def test_what_a_bar_hides_in_part_is_off_by_no_more_than_it_says(level: int, across: bool) -> None:
    swing = 12.0 * np.sin(2 * np.pi * np.arange(60) / 9.3)[:, None] * ((REST[:, 0] - 20) / 260) ** 2
    truth = np.stack([np.broadcast_to(REST[:, 0], swing.shape), REST[:, 1] + swing], axis=-1)
    tracker, errors, sigmas = None, [], []
    for frame, places in enumerate(truth):
        image = picture([(x, y, 6.0, 6.0, 0.0) for x, y in places], SIZE, noise=2.0, seed=frame)
        bar = slice(max(6 * frame - 60, 0), max(6 * frame - 20, 0))
        image[(bar, slice(None)) if across else (slice(None), bar)] = level
        if tracker is None:
            found = find_family(image)
            assert found is not None
            tracker = Tracker(*found)
            order = np.linalg.norm(places[:, None] - found[1].centre, axis=2).argmin(axis=1)
            continue
        dots = tracker.advance(image)
        errors.append(np.abs(dots.centre[order] - places))
        sigmas.append(dots.sigma[order])
    error, sigma = np.array(errors), np.array(sigmas)
    measured = np.isfinite(sigma)
    assert measured.mean() > 0.75
    assert (error[measured] < np.maximum(0.25, 4.0 * sigma[measured])).all()
    assert np.nanmedian(sigma) < 0.03


def test_who_loses_a_part_alone_is_less_certain_by_as_much(random: np.random.Generator) -> None:
    outlines = looked(20, random)
    widths = np.full((24, 2), 8.0)
    widths[5, 0] -= 0.24
    sigma = outlines.judge(seen(widths), REST).sigma
    assert 0.24 <= sigma[5, 0] < 0.4
    assert np.delete(sigma, 5, axis=0) == pytest.approx(0.01)


def test_who_is_hidden_by_half_is_not_measured(random: np.random.Generator) -> None:
    outlines = looked(20, random)
    widths = np.full((24, 2), 8.0)
    widths[5, 1] = 5.0
    assert np.isnan(outlines.judge(seen(widths), REST).sigma[5]).all()


def test_a_skin_that_turns_away_hides_nothing(random: np.random.Generator) -> None:
    """All flatten along x, by up to a third within ten pictures, the far end twice as much as the near one."""
    outlines = looked(20, random)
    for turn in np.linspace(0.0, 0.8, 11):
        narrow = np.cos(turn * (0.5 + (REST[:, 0] - 40.0) / 476.0))
        dots = seen(8.0 * np.stack([narrow, np.ones(24)], axis=1))
        assert outlines.judge(dots, REST).sigma == pytest.approx(0.01)


def test_a_row_that_is_hidden_in_part_is_told_by_the_others(random: np.random.Generator) -> None:
    outlines = looked(20, random)
    widths = np.full((24, 2), 8.0)
    widths[:8, 1] = 7.2
    sigma = outlines.judge(seen(widths), REST).sigma
    assert not (sigma[:8, 1] < 0.8).any()
    assert sigma[8:] == pytest.approx(0.01)


def test_who_stays_smaller_is_measured_again(random: np.random.Generator) -> None:
    outlines = looked(20, random)
    widths = np.full((24, 2), 8.0)
    widths[5] = 7.2
    judged = [outlines.judge(seen(widths), REST).sigma[5, 0] for _ in range(150)]
    assert not judged[0] < 0.8
    assert judged[-1] == pytest.approx(0.01)
