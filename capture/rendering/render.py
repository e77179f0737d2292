"""Pictures of a deformed, dotted, lit specimen as an orthographic camera sees it."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from rafl.calibration.camera import Camera
from rafl.capture.specimen.specimen import Specimen

from rafl.data.markers import Markers

Array = NDArray[Any]

LIGHT = np.array([-0.35, -0.25, 0.9]) / np.linalg.norm([-0.35, -0.25, 0.9])
SKIN, DOT = 175.0, 35.0
CLAMP_DEPTH = 0.02  # of the clamp drawn behind the held face [m]


@dataclass(frozen=True)
class Look:
    """How a recording looks.

    Attributes:
        dot_radius: of the dots [m].
        blur: standard deviation of the lens blur [px].
        exposure: share of the frame time the shutter is open, 0 to 1.
        noise: standard deviation of the sensor noise [grey levels].
        background: `plain` or `clutter`.
        samples: instants averaged over the exposure.
    """

    dot_radius: float = 1.5e-3
    blur: float = 0.8
    exposure: float = 0.2
    noise: float = 2.0
    background: str = "plain"
    samples: int = 4


@njit(cache=True, nogil=True)
def _wave(angle):
    """A sine made of parabolas, 6 % off at most, which is no matter for a skin and much quicker."""
    turn = angle / (2.0 * np.pi)
    turn -= np.floor(turn + 0.5)
    return 8.0 * turn * (1.0 - 2.0 * abs(turn))


@njit(cache=True, nogil=True)
def _texture(x, y, z):
    """A mottled skin, about -1 to 1, fixed to the body; x, y, z in mm."""
    return 0.7 * _wave(1.9 * x + 0.7 * y) * _wave(1.3 * z - 1.1 * y) + 0.4 * _wave(5.3 * x - 4.1 * z + 3.1 * y)


@njit(cache=True, nogil=True)
def _draw_quads(image, corners, rest, shade, first, dots, radius, softness, skin, dot, shift):
    """Paint quads, far to near, into `image` (H, W).

    corners (S, 4, 2) [px]; rest (S, 4, 3) and dots (K, 3) and radius [mm]; dots first[s]:first[s + 1]
    may touch quad s; softness: pixels per mm, over which a dot's edge is smeared; shift (2): where
    inside its pixel each sample is taken.
    """
    height, width = image.shape
    for q in range(corners.shape[0]):
        x = corners[q, :, 0]
        y = corners[q, :, 1]
        left, right = max(int(x.min()) - 1, 0), min(int(x.max()) + 2, width)
        top, bottom = max(int(y.min()) - 1, 0), min(int(y.max()) + 2, height)
        ax, bx, dx = x[0], x[1] - x[0], x[3] - x[0]
        cx = x[0] - x[1] + x[2] - x[3]
        ay, by, dy = y[0], y[1] - y[0], y[3] - y[0]
        cy = y[0] - y[1] + y[2] - y[3]
        for row in range(top, bottom):
            s = 0.5
            t = 0.5
            for column in range(left, right):
                u = column + shift[0] - ax
                v = row + shift[1] - ay
                for _ in range(4):  # invert the bilinear map, from the pixel before
                    gu = s * bx + t * dx + s * t * cx - u
                    gv = s * by + t * dy + s * t * cy - v
                    if abs(gu) + abs(gv) < 1e-3:
                        break
                    su, tu = bx + t * cx, dx + s * cx
                    sv, tv = by + t * cy, dy + s * cy
                    inverse = 1.0 / (su * tv - tu * sv + 1e-300)
                    s -= (tv * gu - tu * gv) * inverse
                    t -= (su * gv - sv * gu) * inverse
                if not (-1e-4 <= s <= 1.0001 and -1e-4 <= t <= 1.0001):  # what the inversion may be off by
                    continue
                w0, w1, w2, w3 = (1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t
                px = w0 * rest[q, 0, 0] + w1 * rest[q, 1, 0] + w2 * rest[q, 2, 0] + w3 * rest[q, 3, 0]
                py = w0 * rest[q, 0, 1] + w1 * rest[q, 1, 1] + w2 * rest[q, 2, 1] + w3 * rest[q, 3, 1]
                pz = w0 * rest[q, 0, 2] + w1 * rest[q, 1, 2] + w2 * rest[q, 2, 2] + w3 * rest[q, 3, 2]
                value = skin + 8.0 * _texture(px, py, pz)
                for k in range(first[q], first[q + 1]):
                    square = (px - dots[k, 0]) ** 2 + (py - dots[k, 1]) ** 2 + (pz - dots[k, 2]) ** 2
                    if square < (radius + 1.0 / softness) ** 2:
                        cover = min(max((radius - np.sqrt(square)) * softness + 0.5, 0.0), 1.0)
                        value += cover * (dot - value)
                image[row, column] = value * shade[q]


@dataclass(frozen=True)
class Painter:
    """Draws one specimen through one camera.

    Attributes:
        specimen: what is filmed.
        camera: through which.
        look: how.
        backdrop: picture of everything that does not move, (H, W) [grey levels].
        dots: where they are on the skin at rest [mm], (K, 3).
    """

    specimen: Specimen
    camera: Camera
    look: Look
    backdrop: Array
    dots: Array

    @classmethod
    def of(cls, specimen: Specimen, camera: Camera, look: Look, random: np.random.Generator) -> "Painter":
        """A painter with its own backdrop."""
        dots = 1e3 * drawn_dots(specimen).rest
        return cls(specimen, camera, look, _backdrop(specimen, camera, look, random), dots)

    def draw(self, positions: Array, random: np.random.Generator) -> NDArray[np.uint8]:
        """A picture (H, W) of the mesh at positions (samples, N, 3) [m] during the exposure."""
        surface = self.specimen.mesh.surface
        rest = 1e3 * self.specimen.mesh.vertices[surface]
        touching = self._dots_of_quads
        picture = np.zeros_like(self.backdrop)
        softness = 1e-3 * float(np.linalg.norm(self.camera.slopes(self.specimen.mesh.vertices.mean(0))[0]))
        # One place inside the pixel per instant smooths the outline; they average to its centre.
        places = np.stack([np.linspace(-0.375, 0.375, len(positions)), _zigzag(len(positions))], axis=1)
        for q, place in zip(positions, places if len(positions) > 1 else np.zeros((1, 2)), strict=True):
            corners = self.camera.project(q)[surface]
            facing = _signed_area(corners) < 0.0  # anticlockwise from outside is clockwise with y down
            depth = (q @ self.camera.viewing_direction)[surface].mean(1)
            order = np.argsort(-depth)
            order = order[facing[order]]
            first = np.concatenate([[0], np.cumsum([len(touching[s]) for s in order])])
            chosen = [self.dots[k] for s in order for k in touching[s]]
            layer = self.backdrop.copy()
            _draw_quads(
                layer,
                corners[order],
                rest[order],
                self._shade(q[surface[order]]),
                first,
                np.array(chosen).reshape(-1, 3),
                1e3 * self.look.dot_radius,
                softness,
                SKIN,
                DOT,
                place,
            )
            picture += layer / len(positions)
        return develop(picture, self.look, random)

    @cached_property
    def _dots_of_quads(self) -> list[list[int]]:
        """For each quad of the surface, which dots can reach into it on the same face."""
        rest = 1e3 * self.specimen.mesh.vertices[self.specimen.mesh.surface]
        normal = np.cross(rest[:, 1] - rest[:, 0], rest[:, 3] - rest[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        reach = 1e3 * self.look.dot_radius + 0.5
        low, high = rest.min(1) - reach, rest.max(1) + reach
        touching = []
        for s in range(len(rest)):
            height = np.abs((self.dots - rest[s, 0]) @ normal[s])
            inside = ((self.dots > low[s]) & (self.dots < high[s])).all(1) & (height < 1e-3)
            touching.append(np.flatnonzero(inside).tolist())
        return touching

    def _shade(self, corners: Array) -> Array:
        normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        # A lamp beside the camera and one above: no face is black.
        return 0.55 + 0.3 * np.abs(normal @ self.camera.viewing_direction) + 0.15 * (normal @ LIGHT)


def drawn_dots(specimen: Specimen) -> Markers:
    """The markers as they are drawn: on the skin of the elements, whatever the layout says beyond that."""
    markers = specimen.markers(np.inf)
    flat = replace(markers, normal_offset=np.zeros(len(markers.names)))
    return replace(flat, rest=flat.positions(torch.from_numpy(specimen.mesh.vertices)).numpy())


def _zigzag(count: int) -> Array:
    """`count` numbers within a pixel, adding up to zero, in another order than a rising line's."""
    rising = np.linspace(-0.375, 0.375, count)
    return rising[np.argsort([(2 * k + 1) % (count + 1 - count % 2) for k in range(count)])]


def _signed_area(corners: Array) -> Array:
    a, b = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def develop(picture: Array, look: Look, random: np.random.Generator) -> NDArray[np.uint8]:
    """Lens blur, uneven light, sensor noise and 8 bits."""
    height, width = picture.shape
    if look.blur > 0:
        picture = cv2.GaussianBlur(picture, (0, 0), look.blur)
    x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
    picture = picture * (1.0 - 0.12 * (x - 0.3) ** 2 - 0.08 * y**2)
    if look.noise > 0:
        picture = picture + look.noise * random.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _backdrop(specimen: Specimen, camera: Camera, look: Look, random: np.random.Generator) -> Array:
    width, height = camera.image_size
    picture = np.full((height, width), 60.0)
    if look.background == "clutter":
        for size, strength in ((120, 35.0), (30, 25.0), (6, 12.0)):
            coarse = random.normal(0.0, strength, (height // size + 2, width // size + 2))
            picture += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    held = specimen.mesh.vertices[specimen.fixed]
    inward = held.mean(0) - specimen.mesh.vertices.mean(0)
    inward /= np.linalg.norm(inward)
    block = np.concatenate([held, held + CLAMP_DEPTH * inward])
    block += 0.15 * (block - block.mean(0)) * (1.0 - np.abs(inward))
    hull = cv2.convexHull(camera.project(block).astype(np.float32))
    cv2.fillConvexPoly(picture, np.rint(hull).astype(np.int32), 110.0, cv2.LINE_AA)
    return np.clip(picture, 0, 255)
