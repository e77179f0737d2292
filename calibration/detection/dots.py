"""Centres of the dots of a regular grid in an image, some of which may be rings, and their lattice."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rafl.calibration.detection.lattice import Index, Lattice, Node, grow_lattice
from rafl.calibration.detection.pyramid import search_levels

Array = NDArray[Any]

MIN_AXIS_PX = 5.0  # shorter axis of a dot's outline in a reduced copy; a coarser outline is too rough to judge
MIN_AXIS_RATIO = 0.3  # shorter to longer axis of a dot; 0.3 is a tilt of 73 degrees
MAX_AREA_ERROR = 0.1  # between an outline's area and that of its ellipse, relative
RING_LEVEL = 0.3  # of the centre of a dot from which it is a ring, relative to the contrast of the dot
MAX_SHIFT = 0.25  # of a dot from where its neighbours expect it, relative to their distance
MIN_GRID = 3  # columns and rows below which dots are no grid
RAYS = 64  # from the centre of a dot, along which its edge is found
RAY_SPAN = (0.6, 1.4)  # ends of the rays, relative to the outline: outside a ring's hole, within half the spacing
RAY_SAMPLES = 33


@dataclass(frozen=True)
class Dots:
    """Outlines of dots: centres (N, 2), semi-axes (N, 2) [px], angles of the first axis (N) [rad]."""

    centres: Array
    axes: Array
    angles: Array


def find_dot_lattice(image: NDArray[np.uint8]) -> tuple[Lattice, NDArray[np.bool_]] | None:
    """Find the largest square lattice of dark dots.

    Args:
        image: grey levels, (H, W).

    Returns:
        The lattice, with the centres of the ellipses fitted to the dots' edges, and which of its dots are ringed, (P);
        None if there is none.
    """
    for level in search_levels(image):
        dots = _find_dots(level.image)
        nodes = _largest_lattice(dots.centres)
        lattice = Lattice.of(nodes) if nodes else None
        if lattice is None or min(lattice.size) < MIN_GRID or not lattice.is_flat():
            continue
        own = cKDTree(dots.centres).query(lattice.pixels)[1]
        scale = float(level.factor.mean())
        centres, ringed = _fit_edges(
            image, Dots(level.to_image(dots.centres[own]), scale * dots.axes[own], dots.angles[own])
        )
        return Lattice(lattice.indices, centres), ringed
    return None


def _find_dots(image: NDArray[np.uint8]) -> Dots:
    """Dark elliptic blobs that the border of the image does not cut."""
    height, width = image.shape
    window = max(height, width) // 8 | 1
    relative = image.astype(np.float32) / (cv2.blur(image, (window, window)).astype(np.float32) + 1.0)
    grey = np.clip(100.0 * relative, 0, 255).astype(np.uint8)
    dark = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)[1]
    found = []
    for contour in cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        x, y, w, h = cv2.boundingRect(contour)
        inside = min(x, y) > 0 and x + w < width and y + h < height
        if len(contour) < 8 or not inside:
            continue
        centre, diameters, angle = cv2.fitEllipse(contour)
        # Contours run through the centres of the outermost pixels.
        axes = 0.5 * (np.array(diameters) + 1.0)
        area = cv2.contourArea(contour) + 0.5 * cv2.arcLength(contour, True)
        if not 2.0 * axes.min() >= MIN_AXIS_PX or axes.min() < MIN_AXIS_RATIO * axes.max():
            continue
        if abs(area / (np.pi * axes.prod()) - 1.0) > MAX_AREA_ERROR:
            continue
        found.append((*centre, *axes, np.radians(angle)))
    table = np.array(found, dtype=float).reshape(-1, 5)
    return Dots(table[:, :2], table[:, 2:4], table[:, 4])


def _largest_lattice(centres: Array) -> dict[Index, Node]:
    """The lattice with most of these points (N, 2), by index."""
    if len(centres) < MIN_GRID**2:
        return {}
    tree = cKDTree(centres)

    def observe(indices: list[Index], nodes: list[Node]) -> Array:
        pixels = np.array([node.pixel for node in nodes])
        spacing = np.array([np.linalg.norm(node.steps, axis=1).min() for node in nodes])
        distance, nearest = tree.query(pixels)
        return np.where((distance < MAX_SHIFT * spacing)[:, None], centres[nearest], np.nan)

    best: dict[Index, Node] = {}
    left = set(range(len(centres)))
    middle = np.median(centres, axis=0)
    for number in np.argsort(np.linalg.norm(centres - middle, axis=1)).tolist():
        if number not in left:
            continue
        steps = _steps_to_neighbours(centres, number, tree)
        nodes = {(0, 0): Node(centres[number], steps)} if steps is not None else {}
        nodes = grow_lattice(nodes, observe)
        left -= {number, *tree.query(np.array([node.pixel for node in nodes.values()]).reshape(-1, 2))[1].tolist()}
        best = max(best, nodes, key=len)
        if len(best) >= len(left):
            break
    return best


def _steps_to_neighbours(centres: Array, number: int, tree: cKDTree) -> Array | None:
    """Steps from a point to its nearest neighbour and to the nearest one in another direction, (2, 2)."""
    nearest = tree.query(centres[number], MIN_GRID**2)[1]
    first, *others = centres[nearest[1:]] - centres[number]
    for other in others:
        sine = (first[0] * other[1] - first[1] * other[0]) / (np.linalg.norm(first) * np.linalg.norm(other))
        if abs(sine) > 0.5:
            return np.array([first, other])
    return None


def _fit_edges(image: NDArray[np.uint8], dots: Dots) -> tuple[Array, NDArray[np.bool_]]:
    """Ellipses through the edges of dots, where grey levels are half way from dark to light.

    Returns:
        Their centres (N, 2), and which dots have a light centre, (N).
    """
    share = np.linspace(*RAY_SPAN, RAY_SAMPLES)
    angle = 2.0 * np.pi * np.arange(RAYS) / RAYS
    cosine, sine = np.cos(dots.angles), np.sin(dots.angles)
    first = dots.axes[:, :1] * np.stack([cosine, sine], axis=1)
    second = dots.axes[:, 1:] * np.stack([-sine, cosine], axis=1)
    rays = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]  # (N, RAYS, 2)
    places = dots.centres[:, None, None] + share[:, None] * rays[:, :, None]
    x, y = np.moveaxis(places.astype(np.float32), -1, 0)
    flat = (len(dots.centres), RAYS * RAY_SAMPLES)
    grey = cv2.remap(image, x.reshape(flat), y.reshape(flat), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    grey = grey.astype(float).reshape(x.shape)
    third = RAY_SAMPLES // 3
    inner, outer = np.median(grey[..., :third], axis=-1), np.median(grey[..., -third:], axis=-1)
    half = 0.5 * (inner + outer)[..., None]
    crossing = (grey[..., :-1] <= half) & (grey[..., 1:] > half)
    at = crossing.argmax(axis=-1)[..., None]
    low, high = np.take_along_axis(grey, at, -1), np.take_along_axis(grey, at + 1, -1)
    step = share[1] - share[0]
    edge = share[at] + step * (half - low) / np.maximum(high - low, 1e-9)
    centres = dots.centres.copy()
    for number, (own, ok) in enumerate(zip(edge * rays, crossing.any(axis=-1), strict=True)):
        if ok.sum() > RAYS // 2:
            centres[number] += cv2.fitEllipse(own[ok].astype(np.float32))[0]
    x, y = centres.astype(np.float32).T
    middle = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel().astype(float)
    dark, light = np.median(inner, axis=1), np.median(outer, axis=1)
    return centres, middle > dark + RING_LEVEL * (light - dark)
