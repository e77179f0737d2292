"""Pictures of dots whose places are known, to check a tracking set-up against."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Scene:
    """How made-up dots look.

    Attributes:
        size: width, height [px].
        skin: grey level of the surface.
        dot: grey level of the dots.
        blur: standard deviation of the lens blur [px].
        noise: standard deviation of the sensor's noise [grey levels].
        slope: share of the light lost from the brightest to the darkest corner.
        clutter: standard deviation of a blotchy background beside the skin [grey levels].
        skin_box: left, top, right, bottom of the skin [px]; None where it fills the picture.
        glare: share of the dots with a highlight over their edge.
        fine: samples across a pixel: with 8 places are true to 1e-4 px, with 2 to 1e-2 px.
    """

    size: tuple[int, int] = (1280, 720)
    skin: float = 175.0
    dot: float = 45.0
    blur: float = 1.0
    noise: float = 4.0
    slope: float = 0.0
    clutter: float = 0.0
    skin_box: tuple[float, float, float, float] | None = None
    glare: float = 0.0
    fine: int = 8


@njit(cache=True, nogil=True)
def _cover(rows, columns, ellipse, smear, instants, samples):
    """The share of the exposure that each fine sample is inside the moving ellipse."""
    x, y, a, b = ellipse[0], ellipse[1], ellipse[2], ellipse[3]
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    fine = np.zeros((rows * samples, columns * samples), np.float32)
    for instant in range(instants):
        share = (instant + 0.5) / instants - 0.5
        for row in range(rows * samples):
            dy = (row + 0.5) / samples - 0.5 - y - share * smear[1]
            for column in range(columns * samples):
                dx = (column + 0.5) / samples - 0.5 - x - share * smear[0]
                p, q = (cos * dx + sin * dy) / a, (cos * dy - sin * dx) / b
                r = np.sqrt(p * p + q * q) + 1e-9
                # Distance to the outline over its slope there, so that the edge is one sample wide.
                steep = np.sqrt((p / a) ** 2 + (q / b) ** 2) / r + 1e-9
                fine[row, column] += min(max((1.0 - r) / steep * samples + 0.5, 0.0), 1.0) / instants
    return fine


def coverage(shape: tuple[int, int], ellipse: Array, smear: Array, blur: float, samples: int = 8) -> Array:
    """The share of a blurred, smeared ellipse that each pixel of a small picture sees, (H, W).

    With eight samples across a pixel its centre is true to 1e-4 px.

    Args:
        shape: rows, columns.
        ellipse: x, y, semi-axes [px], angle of the first [rad], (5).
        smear: way moved during the exposure, about the centre [px], (2).
        blur: standard deviation of the lens blur [px].
        samples: across a pixel.
    """
    instants = 1 + int(np.ceil(min(samples, 4) * np.hypot(*smear) / 2.0))
    fine = _cover(shape[0], shape[1], np.asarray(ellipse, float), np.asarray(smear, float), instants, samples)
    if blur > 0:
        fine = cv2.GaussianBlur(fine, (0, 0), samples * blur, borderType=cv2.BORDER_REPLICATE)
    return fine.reshape(shape[0], samples, shape[1], samples).mean(axis=(1, 3))


def draw(scene: Scene, ellipses: Array, random: np.random.Generator, smears: Array | None = None) -> Array:
    """Grey levels without noise, (H, W).

    Args:
        scene: how it looks.
        ellipses: x, y, semi-axes [px], angle of the first [rad], (D, 5).
        random: for clutter and glare.
        smears: way moved during the exposure [px], (D, 2).
    """
    width, height = scene.size
    picture = np.full((height, width), scene.skin, np.float32)
    if scene.skin_box is not None:
        picture = _before_a_wall(picture, scene, random)
    for k, ellipse in enumerate(ellipses):
        smear = np.zeros(2) if smears is None else smears[k]
        reach = float(max(ellipse[2:4])) + 4.0 * scene.blur + 2.0
        left, top = (int(np.floor(c - reach - abs(s) / 2)) for c, s in zip(ellipse[:2], smear, strict=True))
        right, bottom = (int(np.ceil(c + reach + abs(s) / 2)) + 1 for c, s in zip(ellipse[:2], smear, strict=True))
        rows, columns = slice(max(top, 0), max(bottom, 0)), slice(max(left, 0), max(right, 0))
        if picture[rows, columns].size == 0:
            continue
        own = np.concatenate([ellipse[:2] - (left, top), ellipse[2:]])
        share = coverage((bottom - top, right - left), own, smear, scene.blur, scene.fine)
        share = share[max(-top, 0) :, max(-left, 0) :]
        share = share[: picture[rows, columns].shape[0], : picture[rows, columns].shape[1]]
        picture[rows, columns] += share * (scene.dot - picture[rows, columns])
    if scene.glare > 0:
        _add_glare(picture, ellipses, scene, random)
    if scene.slope > 0:
        x, y = np.linspace(0, 1, width), np.linspace(0, 1, height)[:, None]
        picture *= 1.0 - scene.slope * (0.6 * x + 0.4 * y * y)
    return picture


def expose(picture: Array, scene: Scene, random: np.random.Generator) -> NDArray[np.uint8]:
    """The same with the sensor's noise, in 8 bits."""
    noisy = picture + random.normal(0.0, scene.noise, picture.shape) if scene.noise > 0 else picture
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _before_a_wall(picture: Array, scene: Scene, random: np.random.Generator) -> Array:
    height, width = picture.shape
    wall = np.full_like(picture, 80.0)
    for size, share in ((120, 1.0), (30, 0.8), (7, 0.5)):
        coarse = random.normal(0.0, share * scene.clutter, (height // size + 2, width // size + 2)).astype(np.float32)
        wall += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    assert scene.skin_box is not None
    left, top, right, bottom = scene.skin_box
    x, y = np.arange(width), np.arange(height)[:, None]
    softness = max(scene.blur, 0.3)
    share = np.clip(np.minimum(x - left, right - x) / softness + 0.5, 0, 1)
    share = share * np.clip(np.minimum(y - top, bottom - y) / softness + 0.5, 0, 1)
    return (wall + share * (picture - wall)).astype(np.float32)


def _add_glare(picture: Array, ellipses: Array, scene: Scene, random: np.random.Generator) -> None:
    for x, y, a, b, _ in ellipses:
        if random.random() > scene.glare:
            continue
        turn, radius = random.uniform(0, 2 * np.pi), 0.35 * float(np.sqrt(a * b))
        gx, gy = x + 0.9 * a * np.cos(turn), y + 0.9 * b * np.sin(turn)
        left, top = int(gx - 4 * radius) - 3, int(gy - 4 * radius) - 3
        side = int(8 * radius) + 7
        rows, columns = slice(max(top, 0), top + side), slice(max(left, 0), left + side)
        yy, xx = np.mgrid[rows, columns]
        light = np.clip((radius - np.hypot(xx - gx, yy - gy)) / max(scene.blur, 0.5) + 0.5, 0, 1)
        picture[rows, columns] += light * (250.0 - picture[rows, columns])
