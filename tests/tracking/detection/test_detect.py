import numpy as np
import pytest
from rafl.tracking.detection.appearance import find_family
from rafl.tracking.detection.detect import Dots, candidates, dots_at, find_spots, fit_dots, start_of
from rafl.tracking.synthetic import Scene, draw, expose
from support import hand_drawn, outlined, picture


def all_dots(image: np.ndarray, dark: bool) -> Dots:
    return dots_at(image, candidates(image, dark), dark)


def nearest(dots: Dots, truth: tuple[float, float]) -> int:
    return int(np.argmin(np.linalg.norm(dots.centre - truth, axis=1)))


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("radius", [4.0, 8.0, 14.0])
def test_centres_of_clean_dots(radius: float, dark: bool) -> None:
    """Without noise 8-bit rounding and the light's slope are left: hundredths of a pixel."""
    truth = [(50.3, 60.7, radius, radius, 0.0), (120.15, 90.85, radius, 0.75 * radius, 0.6)]
    dots = all_dots(picture(truth, dark=dark), dark)
    assert len(dots) == 2
    for x, y, a, b, _ in truth:
        k = nearest(dots, (x, y))
        assert dots.centre[k] == pytest.approx((x, y), abs=0.03)
        assert dots.radius[k] == pytest.approx(np.sqrt(a * b), rel=0.05)
        assert dots.flattening[k] == pytest.approx(b / a, abs=0.04)
        assert (dots.contrast[k] < 0) == dark


def test_noise_errors_reach_the_bound_and_sigma_says_so() -> None:
    """Radius 8, noise 4, blur 1: within 1.3 of sigma >= (noise/contrast) sqrt(2 s / (R sqrt pi)).

    The bound's s is the edge's blur with the pixel's own; reported sigmas fit the errors to 30 %.
    """
    errors, sigmas = [], []
    for seed in range(12):
        random = np.random.default_rng(seed)
        truth = [
            (x + random.uniform(-2, 2), y + random.uniform(-2, 2), 8.0, 8.0, 0.0)
            for x in (30, 80, 130, 170)
            for y in (30, 80, 130)
        ]
        dots = all_dots(picture(truth, noise=4.0, seed=seed), True)
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
def test_sigma_knows_of_highlights(skin: float, dot: float) -> None:
    """Each dot with a highlight over its edge, up to two and a half times as far from its surroundings as the dot.

    What of it is not left out pulls the centre, and sigma tells.
    """
    scores = []
    for seed in range(3):
        random = np.random.default_rng(seed)
        x, y = np.meshgrid(np.arange(60.0, 740.0, 48.0), np.arange(60.0, 540.0, 48.0))
        centre = np.stack([x.ravel(), y.ravel()], axis=1) + random.uniform(-3, 3, (x.size, 2))
        ellipses = np.column_stack([centre, np.tile([8.0, 8.0, 0.0], (len(centre), 1))])
        scene = Scene((800, 600), skin, dot, noise=3.0, slope=0.25, glare=1.0, fine=4)
        found = find_family(expose(draw(scene, ellipses, random), scene, random))
        assert found is not None
        dots = found[1]
        assert len(dots) == len(centre)
        for place in centre:
            k = nearest(dots, (place[0], place[1]))
            scores.append((dots.centre[k] - place) / dots.sigma[k])
    assert np.sqrt((np.array(scores) ** 2).mean()) == pytest.approx(1.0, abs=0.15)


def test_dots_drawn_by_hand_keep_their_places() -> None:
    """Outlines that wave by a tenth of the radius, or are smooth: how far they scatter while they move."""
    random = np.random.default_rng(4)
    scatter = []
    for waves in (0.0, 0.12):
        for _ in range(8):
            outline = hand_drawn(random, 8.0, waves)
            places = 30.0 + np.linspace(0.0, 3.0, 25)[:, None] * (1.0, 0.3)
            shape = np.array([1 / 8.0, 0.0, 1 / 8.0])
            starts = [start_of(*place, shape, -120.0, 170.0)[None] for place in places]
            pictures = [outlined([outline + place], (60, 60), random) for place in places]
            found = [fit_dots(*each).centre[0] for each in zip(pictures, starts, strict=True)]
            scatter.append((found - places).std(axis=0))
    smooth, waved = (np.sqrt((np.array(half) ** 2).mean()) for half in (scatter[:8], scatter[8:]))
    assert waved < 2.7 * smooth


def test_neighbours_do_not_pull() -> None:
    """Two dots a diameter and a half apart are found where they are."""
    truth = [(80.0, 80.0, 8.0, 8.0, 0.0), (104.0, 80.5, 8.0, 8.0, 0.0)]
    dots = all_dots(picture(truth), True)
    for x, y, *_ in truth:
        assert dots.centre[nearest(dots, (x, y))] == pytest.approx((x, y), abs=0.03)


@pytest.mark.parametrize("hurried", [False, True])
@pytest.mark.parametrize("radius", [4.0, 8.0, 15.0, 24.0])
def test_a_dot_is_one_spot(radius: float, hurried: bool) -> None:
    """Wherever it lies between the pixels of the shrunken picture, in which two of them may be equally dark."""
    for shift in np.arange(0.0, 8.0, 0.5):
        truth = [(80.0 + shift, 80.0, radius, radius, 0.0), (80.0 + shift + 2.2 * radius, 80.0, radius, radius, 0.0)]
        spots = find_spots(picture(truth), radius, -39.0, (0, 0, 200, 160), hurried)
        assert len(spots) == 2
        for x, y, *_ in truth:
            assert np.linalg.norm(spots - (x, y), axis=1).min() < 0.7 * radius


def test_nothing_in_an_empty_picture() -> None:
    assert len(all_dots(np.full((120, 160), 90, np.uint8), True)) == 0
    noise = np.random.default_rng(0).normal(90, 6, (240, 320)).astype(np.uint8)
    assert len(all_dots(noise, True)) == 0
