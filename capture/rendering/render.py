"""Images of a deformed, dotted, lit specimen through an orthographic camera."""

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

LAMP_DIRECTION = np.array([-0.35, -0.25, 0.9]) / np.linalg.norm([-0.35, -0.25, 0.9])
SKIN_GREY_LEVEL, DOT_GREY_LEVEL = 175.0, 35.0  # 0 to 255, before shading
CLAMP_DEPTH = 0.02  # of the clamp drawn behind the fixed face [m]


@dataclass(frozen=True)
class Appearance:
    """Appearance of a recording.

    Attributes:
        dot_radius: [m].
        blur: sigma of the lens blur [px].
        exposure: exposure time as a fraction of the frame time, 0 to 1.
        noise: sigma of the sensor noise [grey levels].
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
def _approximate_sine(angle: float) -> float:
    """Sine from parabolas: at most 6 % off, which is enough for a texture, and much faster."""
    turn = angle / (2.0 * np.pi)
    turn -= np.floor(turn + 0.5)
    sine: float = 8.0 * turn * (1.0 - 2.0 * abs(turn))
    return sine


@njit(cache=True, nogil=True)
def _skin_texture(x: float, y: float, z: float) -> float:
    """Mottled texture, about -1 to 1, fixed to the material; x, y, z at rest [mm]."""
    coarse = 0.7 * _approximate_sine(1.9 * x + 0.7 * y) * _approximate_sine(1.3 * z - 1.1 * y)
    return coarse + 0.4 * _approximate_sine(5.3 * x - 4.1 * z + 3.1 * y)


@njit(cache=True, nogil=True)
def _draw_quads(
    image: Array,
    corners: Array,
    rest: Array,
    shade: Array,
    first: Array,
    dots: Array,
    radius: float,
    scale: float,
    skin: float,
    dot: float,
    shift: Array,
) -> None:
    """Draw quads into `image` (H, W) in the given order, which should be far to near.

    Args:
        image: [grey levels], (H, W).
        corners: [px], (S, 4, 2).
        rest: corners at rest [mm], (S, 4, 3).
        shade: brightness factor of each quad, (S).
        first: quad s may touch the dots first[s]:first[s + 1], (S + 1).
        dots: centres at rest [mm], (K, 3).
        radius: of the dots [mm].
        scale: [px/mm]; the edge of a dot is one pixel wide.
        skin, dot: grey levels.
        shift: where inside its pixel each sample is taken [px], (2).
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
                for _ in range(4):  # invert the bilinear map, starting from the solution of the previous pixel
                    gu = s * bx + t * dx + s * t * cx - u
                    gv = s * by + t * dy + s * t * cy - v
                    if abs(gu) + abs(gv) < 1e-3:
                        break
                    su, tu = bx + t * cx, dx + s * cx
                    sv, tv = by + t * cy, dy + s * cy
                    inverse = 1.0 / (su * tv - tu * sv + 1e-300)
                    s -= (tv * gu - tu * gv) * inverse
                    t -= (su * gv - sv * gu) * inverse
                if not (-1e-4 <= s <= 1.0001 and -1e-4 <= t <= 1.0001):  # allows for the error of the inversion
                    continue
                w0, w1, w2, w3 = (1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t
                px = w0 * rest[q, 0, 0] + w1 * rest[q, 1, 0] + w2 * rest[q, 2, 0] + w3 * rest[q, 3, 0]
                py = w0 * rest[q, 0, 1] + w1 * rest[q, 1, 1] + w2 * rest[q, 2, 1] + w3 * rest[q, 3, 1]
                pz = w0 * rest[q, 0, 2] + w1 * rest[q, 1, 2] + w2 * rest[q, 2, 2] + w3 * rest[q, 3, 2]
                value = skin + 8.0 * _skin_texture(px, py, pz)
                for k in range(first[q], first[q + 1]):
                    square = (px - dots[k, 0]) ** 2 + (py - dots[k, 1]) ** 2 + (pz - dots[k, 2]) ** 2
                    if square < (radius + 1.0 / scale) ** 2:
                        cover = min(max((radius - np.sqrt(square)) * scale + 0.5, 0.0), 1.0)
                        value += cover * (dot - value)
                image[row, column] = value * shade[q]


@dataclass(frozen=True)
class Renderer:
    """Renders one specimen through one camera.

    Attributes:
        specimen: to render.
        camera: to render through.
        appearance: of the recording.
        background: image of everything that does not move [grey levels], (H, W).
        dots: centres on the surface at rest [mm], (K, 3).
    """

    specimen: Specimen
    camera: Camera
    appearance: Appearance
    background: Array
    dots: Array

    @classmethod
    def of(cls, specimen: Specimen, camera: Camera, appearance: Appearance, random: np.random.Generator) -> "Renderer":
        """A renderer with its own random background."""
        dots = 1e3 * rendered_markers(specimen).rest
        return cls(specimen, camera, appearance, _background_image(specimen, camera, appearance, random), dots)

    def draw(self, positions: Array, random: np.random.Generator) -> NDArray[np.uint8]:
        """Image (H, W) of the mesh at `positions` (samples, N, 3) [m] during the exposure."""
        surface = self.specimen.mesh.surface
        rest = 1e3 * self.specimen.mesh.vertices[surface]
        touching = self._dots_by_quad
        image = np.zeros_like(self.background)
        scale = 1e-3 * float(np.linalg.norm(self.camera.projection_jacobian(self.specimen.mesh.vertices.mean(0))[0]))
        # Each instant samples the pixels at another point, which smooths the outline; the mean point is the centre.
        shifts = np.stack([np.linspace(-0.375, 0.375, len(positions)), _shuffled_offsets(len(positions))], axis=1)
        for q, shift in zip(positions, shifts if len(positions) > 1 else np.zeros((1, 2)), strict=True):
            corners = self.camera.project(q)[surface]
            facing = _signed_area(corners) < 0.0  # anticlockwise from outside is clockwise with y down
            depth = (q @ self.camera.viewing_direction)[surface].mean(1)
            order = np.argsort(-depth)
            order = order[facing[order]]
            first = np.concatenate([[0], np.cumsum([len(touching[s]) for s in order])])
            chosen = [self.dots[k] for s in order for k in touching[s]]
            layer = self.background.copy()
            _draw_quads(
                layer,
                corners[order],
                rest[order],
                self._shade(q[surface[order]]),
                first,
                np.array(chosen).reshape(-1, 3),
                1e3 * self.appearance.dot_radius,
                scale,
                SKIN_GREY_LEVEL,
                DOT_GREY_LEVEL,
                shift,
            )
            image += layer / len(positions)
        return apply_camera_effects(image, self.appearance, random)

    @cached_property
    def _dots_by_quad(self) -> list[list[int]]:
        """Indices of the dots that may overlap each quad of the surface and lie in its plane."""
        rest = 1e3 * self.specimen.mesh.vertices[self.specimen.mesh.surface]
        normal = np.cross(rest[:, 1] - rest[:, 0], rest[:, 3] - rest[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        reach = 1e3 * self.appearance.dot_radius + 0.5
        low, high = rest.min(1) - reach, rest.max(1) + reach
        touching = []
        for s in range(len(rest)):
            height = np.abs((self.dots - rest[s, 0]) @ normal[s])
            inside = ((self.dots > low[s]) & (self.dots < high[s])).all(1) & (height < 1e-3)
            touching.append(np.flatnonzero(inside).tolist())
        return touching

    def _shade(self, corners: Array) -> Array:
        """Brightness factors (S) of quads (S, 4, 3)."""
        normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        # One lamp beside the camera and one above leave no face black.
        shade: Array = 0.55 + 0.3 * np.abs(normal @ self.camera.viewing_direction) + 0.15 * (normal @ LAMP_DIRECTION)
        return shade


def rendered_markers(specimen: Specimen) -> Markers:
    """Markers as rendered: on the surface of the mesh, without their offset along the normal."""
    markers = specimen.markers(np.inf)
    flat = replace(markers, normal_offset=np.zeros(len(markers.names)))
    return replace(flat, rest=flat.positions(torch.from_numpy(specimen.mesh.vertices)).numpy())


def _shuffled_offsets(count: int) -> Array:
    """`count` evenly spaced offsets within a pixel with mean zero, in shuffled order [px]."""
    rising = np.linspace(-0.375, 0.375, count)
    return rising[np.argsort([(2 * k + 1) % (count + 1 - count % 2) for k in range(count)])]


def _signed_area(corners: Array) -> Array:
    """Twice the signed area of quads (S, 4, 2)."""
    a, b = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    area: Array = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return area


def apply_camera_effects(image: Array, appearance: Appearance, random: np.random.Generator) -> NDArray[np.uint8]:
    """Add lens blur, uneven illumination and sensor noise, and quantise to 8 bits."""
    height, width = image.shape
    if appearance.blur > 0:
        image = cv2.GaussianBlur(image, (0, 0), appearance.blur)
    x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
    image = image * (1.0 - 0.12 * (x - 0.3) ** 2 - 0.08 * y**2)
    if appearance.noise > 0:
        image = image + appearance.noise * random.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _background_image(specimen: Specimen, camera: Camera, appearance: Appearance, random: np.random.Generator) -> Array:
    """Background with the clamp [grey levels], (H, W)."""
    width, height = camera.image_size
    image = np.full((height, width), 60.0)
    if appearance.background == "clutter":
        for size, strength in ((120, 35.0), (30, 25.0), (6, 12.0)):
            coarse = random.normal(0.0, strength, (height // size + 2, width // size + 2))
            image += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    fixed = specimen.mesh.vertices[specimen.fixed]
    inward = fixed.mean(0) - specimen.mesh.vertices.mean(0)
    inward /= np.linalg.norm(inward)
    block = np.concatenate([fixed, fixed + CLAMP_DEPTH * inward])
    block += 0.15 * (block - block.mean(0)) * (1.0 - np.abs(inward))
    hull = cv2.convexHull(camera.project(block).astype(np.float32))
    cv2.fillConvexPoly(image, np.rint(hull).astype(np.int32), 110.0, cv2.LINE_AA)
    clipped: Array = np.clip(image, 0, 255)
    return clipped
