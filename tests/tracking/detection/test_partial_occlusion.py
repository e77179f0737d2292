"""Dots that are partly occluded."""

from dataclasses import replace

import numpy as np
import pytest
from support import draw_frame

from rafl.tracking.detection.appearance import find_markers
from rafl.tracking.detection.detect import Dots
from rafl.tracking.detection.partial_occlusion import PartialOcclusion
from rafl.tracking.linking.tracker import Tracker

SIZE = (360, 240)
REST = np.stack(np.meshgrid(40.0 + 34.0 * np.arange(8), 80.0 + 34.0 * np.arange(3)), axis=-1).reshape(-1, 2)


def dots_of(widths: np.ndarray) -> Dots:
    """Dots (M) with these half widths along x and y (M, 2) [px], located to 0.01 px."""
    dots = Dots.missing(len(widths))
    parameters = np.zeros((len(widths), 12))
    parameters[:, :2], parameters[:, [2, 4]] = REST[: len(widths)], 1.0 / widths
    return replace(
        dots,
        sigma=np.full((len(widths), 2), 0.01),
        parameters=parameters,
        relative_radius_sigma=np.full(len(widths), 0.002),
    )


def after_frames(count: int, random: np.random.Generator) -> PartialOcclusion:
    """The state after frames of 24 dots whose radius of 8 px scatters by 0.02 px."""
    occlusion = PartialOcclusion(dots_of(np.full((24, 2), 8.0)))
    for _ in range(count):
        occlusion.adjust_sigma(dots_of(8.0 + random.normal(0.0, 0.02, (24, 2))), REST)
    return occlusion


@pytest.mark.parametrize("level", [20, 110, 230])
@pytest.mark.parametrize("across", [False, True])
def test_sigma_covers_the_error_of_dots_behind_a_bar(level: int, across: bool) -> None:
    """A bar passes over a swinging body."""
    swing = 12.0 * np.sin(2 * np.pi * np.arange(60) / 9.3)[:, None] * ((REST[:, 0] - 20) / 260) ** 2
    truth = np.stack([np.broadcast_to(REST[:, 0], swing.shape), REST[:, 1] + swing], axis=-1)
    tracker, errors, sigmas = None, [], []
    for frame, positions in enumerate(truth):
        image = draw_frame([(x, y, 6.0, 6.0, 0.0) for x, y in positions], SIZE, noise=2.0, seed=frame)
        bar = slice(max(6 * frame - 60, 0), max(6 * frame - 20, 0))
        image[(bar, slice(None)) if across else (slice(None), bar)] = level
        if tracker is None:
            found = find_markers(image)
            assert found is not None
            tracker = Tracker(*found)
            order = np.linalg.norm(positions[:, None] - found[1].centre, axis=2).argmin(axis=1)
            continue
        dots = tracker.advance(image)
        errors.append(np.abs(dots.centre[order] - positions))
        sigmas.append(dots.sigma[order])
    error, sigma = np.array(errors), np.array(sigmas)
    measured = np.isfinite(sigma)
    assert measured.mean() > 0.75
    assert (error[measured] < np.maximum(0.25, 4.0 * sigma[measured])).all()
    assert np.nanmedian(sigma) < 0.03


def test_a_single_dot_that_gets_smaller_gets_a_larger_sigma(random: np.random.Generator) -> None:
    occlusion = after_frames(20, random)
    widths = np.full((24, 2), 8.0)
    widths[5, 0] -= 0.24
    sigma = occlusion.adjust_sigma(dots_of(widths), REST).sigma
    assert 0.24 <= sigma[5, 0] < 0.4
    assert np.delete(sigma, 5, axis=0) == pytest.approx(0.01)


def test_a_dot_that_loses_much_of_its_width_is_missing(random: np.random.Generator) -> None:
    occlusion = after_frames(20, random)
    widths = np.full((24, 2), 8.0)
    widths[5, 1] = 5.0
    assert np.isnan(occlusion.adjust_sigma(dots_of(widths), REST).sigma[5]).all()


def test_a_turning_surface_is_no_occlusion(random: np.random.Generator) -> None:
    """All dots narrow along x, by up to a third within ten frames, at the far end more than at the near one."""
    occlusion = after_frames(20, random)
    for turn in np.linspace(0.0, 0.8, 11):
        narrow = np.cos(turn * (0.5 + (REST[:, 0] - 40.0) / 476.0))
        dots = dots_of(8.0 * np.stack([narrow, np.ones(24)], axis=1))
        assert occlusion.adjust_sigma(dots, REST).sigma == pytest.approx(0.01)


def test_a_partly_occluded_row_is_detected_by_the_other_rows(random: np.random.Generator) -> None:
    occlusion = after_frames(20, random)
    widths = np.full((24, 2), 8.0)
    widths[:8, 1] = 7.2
    sigma = occlusion.adjust_sigma(dots_of(widths), REST).sigma
    assert not (sigma[:8, 1] < 0.8).any()
    assert sigma[8:] == pytest.approx(0.01)


def test_a_dot_that_stays_smaller_is_measured_again(random: np.random.Generator) -> None:
    occlusion = after_frames(20, random)
    widths = np.full((24, 2), 8.0)
    widths[5] = 7.2
    sigmas = [occlusion.adjust_sigma(dots_of(widths), REST).sigma[5, 0] for _ in range(150)]
    assert not sigmas[0] < 0.8
    assert sigmas[-1] == pytest.approx(0.01)
