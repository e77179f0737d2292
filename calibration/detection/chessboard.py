"""Inner corners of a chessboard in an image, also of one that is partly outside the image or under glare."""

import itertools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rafl.calibration.detection.lattice import Index, Lattice, Node, grid_nodes, grow_lattice
from rafl.calibration.detection.pyramid import refine_corners, search_levels

Array = NDArray[Any]

SEED_CORNERS = (3, 3)  # smallest part of a board that OpenCV's detector looks for
REFINED_SHARE = 0.3  # half the side of the window of a corner, relative to the distance of two corners
STEPS = (1, 2, 3)  # squares from one detected corner to the next
MAX_SHIFT = 0.25  # of a corner from where its neighbours expect it, relative to their distance
MIN_CONTRAST = 0.3  # between the squares at a corner, relative to the median of the corners that were found first


def find_chessboard(image: NDArray[np.uint8], size: tuple[int, int]) -> Lattice | None:
    """Find the inner corners of a chessboard.

    OpenCV's detector (findChessboardCornersSB; Duda and Frese, BMVC 2018) finds the whole board, or else a part of it.
    From there the corners are followed to the edges of the board.

    Args:
        image: grey levels, (H, W).
        size: columns and rows of inner corners that are expected; what is found may have fewer or more.
    """
    for level in search_levels(image):
        for corners, flags in ((size, 0), (SEED_CORNERS, cv2.CALIB_CB_LARGER)):
            found, pixels, meta = cv2.findChessboardCornersSBWithMeta(
                level.image, corners, flags=flags | cv2.CALIB_CB_NORMALIZE_IMAGE
            )
            if not found:
                continue
            grid = grid_nodes(np.asarray(pixels, dtype=float).reshape(*meta.shape, 2))
            lattice = Lattice.of(
                max((_follow_corners(level.image, seed) for seed in _seeds(level.image, grid)), key=len)
            )
            if min(lattice.size) >= min(SEED_CORNERS) and lattice.is_flat():
                return Lattice(lattice.indices, refine_corners(image, level.to_image(lattice.pixels), REFINED_SHARE))
    return None


def _seeds(image: NDArray[np.uint8], grid: dict[Index, Node]) -> list[dict[Index, Node]]:
    """Corners to start from: the detected ones, if the squares at them alternate.

    If they do not, the detector skipped rows of the board. Then, for each number of squares that a step may span, the
    corner at which the squares differ most is a seed; with the right steps it is followed to most corners.
    """
    contrast = _contrast(image, grid)
    median = float(np.median(contrast))
    if (np.sign(median) * contrast > MIN_CONTRAST * abs(median)).all():
        return [grid]
    seeds = []
    for parts in itertools.product(STEPS, repeat=2):
        divided = {i: Node(node.pixel, node.steps / np.array(parts)[:, None]) for i, node in grid.items()}
        best = list(grid)[int(np.abs(_contrast(image, divided)).argmax())]
        seeds.append({best: divided[best]})
    return seeds


def _follow_corners(image: NDArray[np.uint8], seed: dict[Index, Node]) -> dict[Index, Node]:
    """All corners of the board that some of its corners belong to."""
    median = float(np.median(_contrast(image, seed)))

    def observe(indices: list[Index], nodes: list[Node]) -> Array:
        pixels = np.array([node.pixel for node in nodes])
        spacing = np.array([np.linalg.norm(node.steps, axis=1).min() for node in nodes])
        found = np.full(pixels.shape, np.nan)
        inside = ((pixels > spacing[:, None]) & (pixels < np.array(image.shape[::-1]) - 1 - spacing[:, None])).all(
            axis=1
        )
        if not inside.any():
            return found
        half = max(int(REFINED_SHARE * np.median(spacing[inside])), 2)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-2)
        start = pixels[inside].astype(np.float32).reshape(-1, 1, 2)
        corners = cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop).reshape(-1, 2)
        kept = [k for k, ok in enumerate(inside) if ok]
        own = {indices[k]: Node(corner, nodes[k].steps) for k, corner in zip(kept, corners, strict=True)}
        signed = np.sign(median) * _contrast(image, own)
        near = np.linalg.norm(corners - pixels[inside], axis=1) < MAX_SHIFT * spacing[inside]
        found[inside] = np.where(
            (near & (median != 0.0) & (signed > MIN_CONTRAST * abs(median)))[:, None], corners, np.nan
        )
        return found

    return grow_lattice(seed, observe)


def _contrast(image: NDArray[np.uint8], nodes: dict[Index, Node]) -> Array:
    """Contrast [grey levels] of the four squares at each corner, (P), of one sign over a whole board.

    It is the gap between the two squares on one diagonal and the two on the other, corrected for its change of sign
    from corner to corner, and 0 where the squares do not alternate or the steps are longer than a square.
    """
    pixels = np.array([node.pixel for node in nodes.values()])
    steps = np.array([node.steps for node in nodes.values()])
    size = max(int(0.3 * np.median(np.linalg.norm(steps, axis=2))), 1)
    smooth = cv2.blur(image, (size, size))

    def grey_levels(diagonal: Array) -> Array:
        """Grey levels of the two squares at the ends of the diagonals (P, 2), near the corner and in the middle."""
        places = [pixels + share * diagonal for share in (-0.5, -0.25, 0.25, 0.5)]
        x, y = np.moveaxis(np.array(places, dtype=np.float32), -1, 0)
        grey = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(grey, dtype=float)

    one, other = grey_levels(steps[:, 0] + steps[:, 1]), grey_levels(steps[:, 0] - steps[:, 1])
    light, dark = one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0)
    gap: Array = np.where(light > 0, light, np.where(dark > 0, -dark, 0.0))
    parity: Array = np.where(np.array(list(nodes)).sum(axis=1) % 2, -1.0, 1.0)
    return gap * parity
