"""Draw frames of dots whose true positions are known, to check a tracking setup."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Scene:
    """Appearance of synthetic dots and their surroundings.

    Attributes:
        size: width, height [px].
        skin: grey level of the surface.
        dot: grey level of the dots.
        blur: sigma of the lens blur [px].
        noise: sigma of the sensor's noise [grey levels].
        light_falloff: fraction of the light lost from the brightest to the darkest corner.
        clutter: sigma of a mottled background beside the skin [grey levels].
        skin_box: left, top, right, bottom of the skin [px]; None where it fills the frame.
        highlight_fraction: fraction of the dots with a specular highlight over their edge.
        supersampling: samples across a pixel: with 8, positions are exact to 1e-4 px, with 2, to 1e-2 px.
    """

    size: tuple[int, int] = (1280, 720)
    skin: float = 175.0
    dot: float = 45.0
    blur: float = 1.0
    noise: float = 4.0
    light_falloff: float = 0.0
    clutter: float = 0.0
    skin_box: tuple[float, float, float, float] | None = None
    highlight_fraction: float = 0.0
    supersampling: int = 8


@njit(cache=True, nogil=True)
def _sample_coverage(rows: int, columns: int, ellipse: Array, motion: Array, instants: int, samples: int) -> Array:
    """Fraction of the exposure for which each sample is inside the moving ellipse, (rows, columns) times samples."""
    x, y, a, b = ellipse[0], ellipse[1], ellipse[2], ellipse[3]
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    fine = np.zeros((rows * samples, columns * samples), np.float32)
    for instant in range(instants):
        time = (instant + 0.5) / instants - 0.5
        for row in range(rows * samples):
            dy = (row + 0.5) / samples - 0.5 - y - time * motion[1]
            for column in range(columns * samples):
                dx = (column + 0.5) / samples - 0.5 - x - time * motion[0]
                p, q = (cos * dx + sin * dy) / a, (cos * dy - sin * dx) / b
                r = np.sqrt(p * p + q * q) + 1e-9
                # (1 - r) over its gradient is the distance to the outline, so that the edge is one sample wide.
                gradient = np.sqrt((p / a) ** 2 + (q / b) ** 2) / r + 1e-9
                fine[row, column] += min(max((1.0 - r) / gradient * samples + 0.5, 0.0), 1.0) / instants
    return fine


def coverage(shape: tuple[int, int], ellipse: Array, motion: Array, blur: float, samples: int = 8) -> Array:
    """Fraction of each pixel that an ellipse covers, with lens blur and motion blur, (H, W).

    With eight samples across a pixel, the ellipse's centre is exact to 1e-4 px.

    Args:
        shape: rows, columns.
        ellipse: x, y, semi-axes [px], angle of the first [rad], (5).
        motion: displacement during the exposure, centred at x, y [px], (2).
        blur: sigma of the lens blur [px].
        samples: across a pixel.
    """
    instants = 1 + int(np.ceil(min(samples, 4) * np.hypot(*motion) / 2.0))
    fine: Array = _sample_coverage(
        shape[0], shape[1], np.asarray(ellipse, float), np.asarray(motion, float), instants, samples
    )
    if blur > 0:
        fine = cv2.GaussianBlur(fine, (0, 0), samples * blur, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(fine.reshape(shape[0], samples, shape[1], samples).mean(axis=(1, 3)))


def draw(scene: Scene, ellipses: Array, random: np.random.Generator, motions: Array | None = None) -> Array:
    """Draw a frame without noise; returns grey levels, (H, W).

    Args:
        scene: appearance of the dots and their surroundings.
        ellipses: x, y, semi-axes [px], angle of the first [rad], (D, 5).
        random: for clutter and highlights.
        motions: displacements during the exposure [px], (D, 2).
    """
    width, height = scene.size
    image = np.full((height, width), scene.skin, np.float32)
    if scene.skin_box is not None:
        image = _add_background(image, scene, random)
    for k, ellipse in enumerate(ellipses):
        motion = np.zeros(2) if motions is None else motions[k]
        reach = float(max(ellipse[2:4])) + 4.0 * scene.blur + 2.0
        left, top = (int(np.floor(c - reach - abs(s) / 2)) for c, s in zip(ellipse[:2], motion, strict=True))
        right, bottom = (int(np.ceil(c + reach + abs(s) / 2)) + 1 for c, s in zip(ellipse[:2], motion, strict=True))
        rows, columns = slice(max(top, 0), max(bottom, 0)), slice(max(left, 0), max(right, 0))
        if image[rows, columns].size == 0:
            continue
        local = np.concatenate([ellipse[:2] - (left, top), ellipse[2:]])
        covered = coverage((bottom - top, right - left), local, motion, scene.blur, scene.supersampling)
        covered = covered[max(-top, 0) :, max(-left, 0) :]
        covered = covered[: image[rows, columns].shape[0], : image[rows, columns].shape[1]]
        image[rows, columns] += covered * (scene.dot - image[rows, columns])
    if scene.highlight_fraction > 0:
        _add_highlights(image, ellipses, scene, random)
    if scene.light_falloff > 0:
        x, y = np.linspace(0, 1, width), np.linspace(0, 1, height)[:, None]
        image *= 1.0 - scene.light_falloff * (0.6 * x + 0.4 * y * y)
    return image


def expose(image: Array, scene: Scene, random: np.random.Generator) -> NDArray[np.uint8]:
    """Add the sensor's noise and round to 8 bits."""
    noisy = image + random.normal(0.0, scene.noise, image.shape) if scene.noise > 0 else image
    rounded: NDArray[np.uint8] = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return rounded


def _add_background(image: Array, scene: Scene, random: np.random.Generator) -> Array:
    """Replace what lies outside the skin box by a mottled background."""
    height, width = image.shape
    background = np.full_like(image, 80.0)
    for size, share in ((120, 1.0), (30, 0.8), (7, 0.5)):
        coarse = random.normal(0.0, share * scene.clutter, (height // size + 2, width // size + 2)).astype(np.float32)
        background += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    assert scene.skin_box is not None
    left, top, right, bottom = scene.skin_box
    x, y = np.arange(width), np.arange(height)[:, None]
    softness = max(scene.blur, 0.3)
    skin = np.clip(np.minimum(x - left, right - x) / softness + 0.5, 0, 1)
    skin = skin * np.clip(np.minimum(y - top, bottom - y) / softness + 0.5, 0, 1)
    return np.asarray((background + skin * (image - background)).astype(np.float32))


def _add_highlights(image: Array, ellipses: Array, scene: Scene, random: np.random.Generator) -> None:
    """Draw a specular highlight over the edge of some of the dots."""
    for x, y, a, b, _ in ellipses:
        if random.random() > scene.highlight_fraction:
            continue
        angle, radius = random.uniform(0, 2 * np.pi), 0.35 * float(np.sqrt(a * b))
        highlight_x, highlight_y = x + 0.9 * a * np.cos(angle), y + 0.9 * b * np.sin(angle)
        left, top = int(highlight_x - 4 * radius) - 3, int(highlight_y - 4 * radius) - 3
        side = int(8 * radius) + 7
        rows, columns = slice(max(top, 0), top + side), slice(max(left, 0), left + side)
        yy, xx = np.mgrid[rows, columns]
        distance = np.hypot(xx - highlight_x, yy - highlight_y)
        light = np.clip((radius - distance) / max(scene.blur, 0.5) + 0.5, 0, 1)
        image[rows, columns] += light * (250.0 - image[rows, columns])
