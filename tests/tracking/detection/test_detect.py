import numpy as np
import pytest
from support import draw_frame, draw_outlines, irregular_outline
from synthetic import Scene, draw, expose

from rafl.tracking.detection.appearance import find_markers
from rafl.tracking.detection.detect import (
    Dots,
    find_blobs,
    find_candidates,
    fit_candidates,
    fit_dots,
    initial_parameters,
)


def all_dots(image: np.ndarray, dark: bool) -> Dots:
    return fit_candidates(image, find_candidates(image, dark), dark)


def nearest(dots: Dots, truth: tuple[float, float]) -> int:
    return int(np.argmin(np.linalg.norm(dots.centre - truth, axis=1)))


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("radius", [4.0, 8.0, 14.0])
def test_centres_without_noise(radius: float, dark: bool) -> None:
    """Only 8-bit rounding and the uneven light remain: the errors are hundredths of a pixel."""
    truth = [(50.3, 60.7, radius, radius, 0.0), (120.15, 90.85, radius, 0.75 * radius, 0.6)]
    dots = all_dots(draw_frame(truth, dark=dark), dark)
    assert len(dots) == 2
    for x, y, a, b, _ in truth:
        k = nearest(dots, (x, y))
        assert dots.centre[k] == pytest.approx((x, y), abs=0.03)
        assert dots.radius[k] == pytest.approx(np.sqrt(a * b), rel=0.05)
        assert dots.axis_ratio[k] == pytest.approx(b / a, abs=0.04)
        assert (dots.contrast[k] < 0) == dark


def test_noise_errors_reach_the_bound_and_match_sigma() -> None:
    """Radius 8, noise 4, blur 1: errors within 1.3 times the bound (noise/contrast) sqrt(2 s / (R sqrt pi)).

    s is the standard deviation of the edge, from lens blur and pixel width. Sigma matches the errors to 30 %.
    """
    errors, sigmas = [], []
    for seed in range(12):
        random = np.random.default_rng(seed)
        truth = [
            (x + random.uniform(-2, 2), y + random.uniform(-2, 2), 8.0, 8.0, 0.0)
            for x in (30, 80, 130, 170)
            for y in (30, 80, 130)
        ]
        dots = all_dots(draw_frame(truth, noise=4.0, seed=seed), True)
        assert len(dots) == len(truth)
        for x, y, *_ in truth:
            k = nearest(dots, (x, y))
            errors.append(dots.centre[k] - (x, y))
            sigmas.append(dots.sigma[k].mean())
    rms = np.sqrt((np.array(errors) ** 2).mean())
    edge = np.sqrt(1.0 + 1.0 / 12.0)
    bound = 4.0 / 130.0 * np.sqrt(2 * edge / (8.0 * np.sqrt(np.pi)))
    assert rms < 1.3 * bound
    assert np.median(sigmas) == pytest.approx(rms, rel=0.3)


@pytest.mark.parametrize(("skin", "dot"), [(175.0, 45.0), (100.0, 40.0), (40.0, 130.0)])
def test_sigma_covers_the_error_by_highlights(skin: float, dot: float) -> None:
    """Each dot has a highlight over its edge that differs from the surroundings by up to 2.5 times the contrast.

    The pixels of the highlight that keep some weight shift the centre.
    """
    scores = []
    for seed in range(3):
        random = np.random.default_rng(seed)
        x, y = np.meshgrid(np.arange(60.0, 740.0, 48.0), np.arange(60.0, 540.0, 48.0))
        truth = np.stack([x.ravel(), y.ravel()], axis=1) + random.uniform(-3, 3, (x.size, 2))
        ellipses = np.column_stack([truth, np.tile([8.0, 8.0, 0.0], (len(truth), 1))])
        scene = Scene((800, 600), skin, dot, noise=3.0, light_falloff=0.25, highlight_fraction=1.0, supersampling=4)
        found = find_markers(expose(draw(scene, ellipses, random), scene, random))
        assert found is not None
        dots = found[1]
        assert len(dots) == len(truth)
        for position in truth:
            k = nearest(dots, (position[0], position[1]))
            scores.append((dots.centre[k] - position) / dots.sigma[k])
    assert np.sqrt((np.array(scores) ** 2).mean()) == pytest.approx(1.0, abs=0.15)


def test_the_error_of_a_hand_drawn_dot_is_constant_while_it_moves() -> None:
    """An outline irregular by 12 % of the radius scatters at most 2.7 times as much as a smooth one."""
    random = np.random.default_rng(4)
    scatter = []
    for waves in (0.0, 0.12):
        for _ in range(8):
            outline = irregular_outline(random, 8.0, waves)
            truth = 30.0 + np.linspace(0.0, 3.0, 25)[:, None] * (1.0, 0.3)
            shape = np.array([1 / 8.0, 0.0, 1 / 8.0])
            starts = [initial_parameters(*position, shape, -120.0, 170.0)[None] for position in truth]
            images = [draw_outlines([outline + position], (60, 60), random) for position in truth]
            found = [fit_dots(*pair).centre[0] for pair in zip(images, starts, strict=True)]
            scatter.append((found - truth).std(axis=0))
    smooth, irregular = (np.sqrt((np.array(half) ** 2).mean()) for half in (scatter[:8], scatter[8:]))
    assert irregular < 2.7 * smooth


def test_a_neighbour_does_not_shift_a_dot() -> None:
    """Two dots one and a half diameters apart."""
    truth = [(80.0, 80.0, 8.0, 8.0, 0.0), (104.0, 80.5, 8.0, 8.0, 0.0)]
    dots = all_dots(draw_frame(truth), True)
    for x, y, *_ in truth:
        assert dots.centre[nearest(dots, (x, y))] == pytest.approx((x, y), abs=0.03)


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("radius", [4.0, 8.0, 15.0, 24.0])
def test_a_dot_gives_one_blob(radius: float, fast: bool) -> None:
    """At any offset from the pixels of the downsampled frame, two of which may be equally dark."""
    for shift in np.arange(0.0, 8.0, 0.5):
        truth = [(80.0 + shift, 80.0, radius, radius, 0.0), (80.0 + shift + 2.2 * radius, 80.0, radius, radius, 0.0)]
        blobs = find_blobs(draw_frame(truth), radius, -39.0, (0, 0, 200, 160), fast)
        assert len(blobs) == 2
        for x, y, *_ in truth:
            assert np.linalg.norm(blobs - (x, y), axis=1).min() < 0.7 * radius


def test_an_empty_frame_has_no_dots() -> None:
    assert len(all_dots(np.full((120, 160), 90, np.uint8), True)) == 0
    noise = np.random.default_rng(0).normal(90, 6, (240, 320)).astype(np.uint8)
    assert len(all_dots(noise, True)) == 0
