"""Reduced copies of an image, for a search from coarse to fine, and the pixels found in them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Longest side of the coarsest copy [px]. The finest one that is searched is twice as large: squares and dots that
# cannot be told apart there are too small to calibrate from.
COARSEST_PX = 1000


@dataclass(frozen=True)
class Level:
    """A reduced copy of an image.

    Attributes:
        image: grey levels, (h, w).
        factor: pixels of the image per pixel of the copy, along x and y, (2).
    """

    image: NDArray[np.uint8]
    factor: Array

    def to_image(self, pixels: Array) -> Array:
        """Pixels (..., 2) of the image from those of the copy."""
        result: Array = (pixels + 0.5) * self.factor - 0.5
        return result


def search_levels(image: NDArray[np.uint8]) -> Iterator[Level]:
    """Two copies of an image, reduced by powers of two, the coarser one first; small images are their own copy."""
    height, width = image.shape
    halvings = 0
    while max(width, height) / 2**halvings > COARSEST_PX:
        halvings += 1
    for number in range(halvings, max(halvings - 2, -1), -1):
        size = (round(width / 2**number), round(height / 2**number))
        copy = image if number == 0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        yield Level(np.asarray(copy, dtype=np.uint8), np.array([width / size[0], height / size[1]]))


def refine_corners(image: NDArray[np.uint8], corners: Array, share: float) -> Array:
    """Corners (P, 2) at which four squares meet, to a fraction of a pixel.

    Args:
        image: grey levels, (H, W).
        corners: approximate pixels, (P, 2).
        share: half the side of the window looked at, relative to the smallest distance of two corners.
    """
    gaps = np.linalg.norm(corners[:, None] - corners[None], axis=2) + np.diag(np.full(len(corners), np.inf))
    half = max(int(share * gaps.min()), 2)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    start = np.array(corners, dtype=np.float32).reshape(-1, 1, 2)
    return np.asarray(cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop), dtype=float).reshape(-1, 2)
