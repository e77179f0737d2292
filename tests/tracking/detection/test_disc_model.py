"""The disc fit, compared with a plain implementation and with the noise limit, and its uncertainty."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from support import ROOT, draw_frame, draw_outlines, irregular_outline
from synthetic import Scene, draw, expose

from rafl.tracking.detection.detect import Dots, fit_dots, initial_parameters
from rafl.tracking.detection.disc_model import CHUNK, PARAMETER_COUNT, SCRATCH_SIZE, J, X, Y, linearise, pad_to_lanes

SIDE = 64


def draw_dot(
    ellipse: tuple[float, ...], scene: Scene, seed: int = 0, motion: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    random = np.random.default_rng(seed)
    return expose(draw(scene, np.array([ellipse]), random, np.array([motion])), scene, random)


def fit_at(image: np.ndarray, x: float, y: float, radius: float) -> Dots:
    shape = np.array([1 / radius, 0.0, 1 / radius])
    return fit_dots(image, initial_parameters(x, y, shape, -120.0, 170.0)[None])


def plain_level(p: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The model without optimisations: a bell-shaped edge across |A (x - c)| = 1 in linearly varying light."""
    A = np.array([[p[2], p[3]], [p[3], p[4]]])
    W = np.array([[p[5], p[6]], [p[6], p[7]]])
    offset = np.stack([x - p[0], y - p[1]], axis=-1)
    image = offset @ A
    r = np.linalg.norm(image, axis=-1) + 1e-12
    gradient = image / r[..., None] @ A
    z = np.clip((1 - r) / np.sqrt(np.einsum("...i,ij,...j->...", gradient, W, gradient)), -4, 4)
    fine = np.linspace(-4, 4, 4001)
    bell = (1 - fine**2 / 16) ** 8
    step = np.interp(z, fine, np.cumsum(bell) / bell.sum())
    return (p[9] + p[8] * step) * (1 + p[10] * offset[..., 0] + p[11] * offset[..., 1])


def test_the_fit_agrees_with_a_plain_one() -> None:
    """The same model fitted by scipy to the same pixels: the centres agree far below the noise."""
    scene = Scene(size=(SIDE, SIDE), noise=2.0, light_falloff=0.2)
    image = draw_dot((31.3, 32.8, 8.0, 6.5, 0.5), scene)
    dots = fit_at(image, 31.0, 33.0, 7.0)
    y, x = np.mgrid[14:52, 14:50].astype(float)
    start = dots.parameters[0] * np.array([1, 1, 1.05, 1, 0.95, 1.2, 1, 0.9, 1.02, 1, 1, 1]) + 1e-4
    plain = least_squares(lambda p: (plain_level(p, x, y) - image[14:52, 14:50]).ravel(), start, x_scale="jac")
    np.testing.assert_allclose(plain.x[:2], dots.centre[0], atol=6e-3)
    np.testing.assert_allclose(plain.x[2:5], dots.parameters[0, 2:5], atol=6e-4)
    assert plain.x[8] == pytest.approx(dots.contrast[0], rel=0.01)


def test_derivatives_agree_with_finite_differences() -> None:
    """By every parameter, of a small, blurred, slightly flattened dot, whose edge is as wide as the dot."""
    p = np.array([0.2, -0.3, 0.42, 0.03, 0.38, 2.6, 0.2, 2.3, -110.0, 170.0, 1e-3, -2e-3])
    y, x = np.mgrid[-7:8, -7:8].reshape(2, -1).astype(float)
    w = np.zeros(SCRATCH_SIZE, np.float32)
    w[X : X + len(x)], w[Y : Y + len(y)] = x, y
    linearise(p, 1, 0, 0, 0, pad_to_lanes(len(x)), w)
    for k in range(PARAMETER_COUNT):
        h = 1e-3 * max(abs(p[k]), 0.1)
        up, down = (plain_level(p + side * h * np.eye(PARAMETER_COUNT)[k], x, y) for side in (1, -1))
        row, plain = w[J + k * CHUNK : J + k * CHUNK + len(x)], (up - down) / (2 * h)
        assert np.linalg.norm(row - plain) < 0.12 * np.linalg.norm(plain), k


@pytest.mark.parametrize(("noise", "min_fraction"), [(0.0, 0.98), (2.0, 0.98), (8.0, 0.85)])
def test_small_blurred_dots_are_fitted(noise: float, min_fraction: float) -> None:
    """Radius 3, axis ratio down to 1/2, out of focus, moving, and half a pixel from the start of the fit."""
    random = np.random.default_rng(8)
    scene = Scene(size=(SIDE, SIDE), noise=noise, blur=1.5, light_falloff=0.15, supersampling=4)
    errors = []
    for _ in range(60):
        x, y = 32 + random.uniform(-0.5, 0.5, 2)
        ellipse = (x, y, 3.0, random.uniform(1.5, 3.0), random.uniform(0, np.pi))
        image = draw_dot(ellipse, scene, int(random.integers(1000)), tuple(random.uniform(-1.2, 1.2, 2)))
        dots = fit_at(image, x + random.uniform(-0.5, 0.5), y + random.uniform(-0.5, 0.5), 3.0)
        errors.append(np.abs(dots.centre[0] - (x, y)).max() if np.isfinite(dots.sigma[0, 0]) else np.nan)
    assert np.isfinite(errors).mean() >= min_fraction
    assert np.nanmedian(errors) < 0.01 + 0.02 * noise


@pytest.mark.parametrize(
    ("radius", "noise", "motion", "limit"),
    [
        (3.0, 4.0, (0.0, 0.0), 1.15),
        (8.0, 8.0, (0.0, 0.0), 1.15),
        (20.0, 4.0, (0.0, 0.0), 1.15),
        (8.0, 4.0, (3.0, 2.0), 1.15),
        (8.0, 4.0, (0.0, 16.0), 1.4),
        (20.0, 4.0, (20.0, 14.0), 2.2),
    ],
)
def test_centres_reach_the_noise_limit(radius: float, noise: float, motion: tuple[float, float], limit: float) -> None:
    """Against the Cramer-Rao bound of the centre with all else known; 68 % of the errors are within one sigma."""
    scene = Scene(size=(int(4 * radius) + 40, int(4 * radius) + 40), noise=noise)
    x, y = 2 * radius + 20.3, 2 * radius + 19.6
    ellipse = np.array([[x, y, radius, radius, 0.0]])
    random = np.random.default_rng(5)
    information = []
    for axis in range(2):
        moved = [ellipse.copy(), ellipse.copy()]
        moved[0][0, axis] += 0.05
        moved[1][0, axis] -= 0.05
        up, down = (draw(scene, item, random, np.array([motion])) for item in moved)
        information.append((((up - down) / 0.1) ** 2).sum())
    bound = np.sqrt(noise**2 + 1 / 12) / np.sqrt(np.array(information))
    clean = draw(scene, ellipse, random, np.array([motion]))
    errors, sigmas = [], []
    for _ in range(200):
        offset = random.uniform(-1, 1, 2)
        dots = fit_at(expose(clean, scene, random), x + offset[0], y + offset[1], 0.95 * radius)
        errors.append(dots.centre[0] - (x, y))
        sigmas.append(dots.sigma[0])
    rms = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert np.sqrt((rms**2).mean()) < limit * np.sqrt((bound**2).mean())
    assert (np.abs(errors) < sigmas).mean() == pytest.approx(0.68, abs=0.07)


def test_a_highlight_does_not_shift_the_centre() -> None:
    """A bright spot over the outline, and a stripe beside the dot."""
    scene = Scene(size=(SIDE, SIDE), noise=2.0)
    for seed in range(5):
        image = draw_dot((31.3, 32.8, 8.0, 8.0, 0.0), scene, seed)
        y, x = np.mgrid[:SIDE, :SIDE]
        image[np.hypot(x - 38.5, y - 30.0) < 2.6] = 250
        image[14:19, 20:50] = 240
        dots = fit_at(image, 31.0, 33.0, 8.0)
        assert np.abs(dots.centre[0] - (31.3, 32.8)).max() < 0.05
        assert dots.mean_weight[0] > 0.8


@pytest.mark.parametrize("dark", [True, False])
def test_hand_drawn_dots_are_fitted_in_uneven_light(dark: bool) -> None:
    """Outlines irregular by 2 to 10 %, light that changes by 1 % a pixel: no disc explains all of the residual."""
    random = np.random.default_rng(9)
    light = 1.0 + 0.01 * (np.arange(80) - 40)
    errors = []
    for waves in np.repeat([0.02, 0.05, 0.1], 20):
        centre = 40.0 + random.uniform(-0.5, 0.5, 2)
        image = draw_outlines([irregular_outline(random, 10.0, waves) + centre], (80, 80), random) * light
        image = np.clip(np.rint(image if dark else 255.0 - image), 0, 255).astype(np.uint8)
        shape = np.array([0.1, 0.0, 0.1])
        start = initial_parameters(*(centre + random.uniform(-0.8, 0.8, 2)), shape, -120.0, 170.0)
        start[8:10] = start[8:10] if dark else (120.0, 85.0)
        dots = fit_dots(image, start[None])
        again = fit_dots(image, dots.parameters)
        errors.append(np.abs(again.centre[0] - centre).max() if np.isfinite(again.sigma[0, 0]) else np.inf)
    assert np.isfinite(errors).mean() > 0.98
    assert np.median(errors) < 0.3


def test_a_greater_bit_depth_reduces_the_error() -> None:
    """The same dot without noise in 8 bits and as floating-point levels."""
    scene = Scene(size=(SIDE, SIDE), noise=0.0)
    clean = draw(scene, np.array([[31.3, 32.8, 8.0, 8.0, 0.0]]), np.random.default_rng(0))
    coarse = fit_at(np.rint(clean).astype(np.uint8), 31.0, 33.0, 8.0)
    fine = fit_at(clean.astype(np.float32), 31.0, 33.0, 8.0)
    assert np.abs(fine.centre[0] - (31.3, 32.8)).max() < 1e-3
    assert fine.sigma[0, 0] <= coarse.sigma[0, 0]


@pytest.mark.slow
def test_compiled_and_cached_kernels_give_the_same_bits(tmp_path: Path) -> None:
    """Dots of low contrast on mottled skin: the fits depend on the last bit."""
    skin = draw_frame([(60.0 + 30 * k, 50.0, 6.0, 6.0, 0.0) for k in range(6)], (260, 100), noise=2.0, contrast=60.0)
    blobs = cv2.resize(np.random.default_rng(1).normal(0.0, 8.0, (12, 32)), (260, 100), interpolation=cv2.INTER_CUBIC)
    np.save(tmp_path / "mottled.npy", np.clip(np.rint(skin + blobs), 0, 255).astype(np.uint8))
    program = (
        "import numpy as np; from rafl.tracking.detection.detect import find_candidates, fit_dots;"
        "image = np.load('mottled.npy'); dots = fit_dots(image, find_candidates(image, True));"
        "print(dots.parameters.tobytes().hex())"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    first, second = (
        subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, check=True)
        for _ in range(2)
    )
    assert first.stdout == second.stdout
