"""Surface markers: each is embedded in one boundary quad of the mesh (paper, observation operator x(s))."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.mesh import HexMesh

Array = NDArray[Any]

DIGITS, SAME_DISTANCE = 9, 1e-9  # of distances that count as equal [m]


@dataclass(frozen=True)
class Markers:
    """Markers embedded in a mesh.

    Attributes:
        names: (M).
        rest: positions at rest in the specimen frame [m], (M, 3).
        quad: vertices of each marker's boundary quad, anticlockwise seen from outside, (M, 4).
        weights: bilinear weights of the quad's vertices; they add up to 1, (M, 4).
        normal_offset: signed distance along the quad's outward normal [m], (M,).
        moved: of `rest`, how far it was found from the specimen's description [m], (M, 3); None if it was not searched.
        place_sigma: standard deviations of `rest` where it was found [m], (M, 3), or None.
    """

    names: tuple[str, ...]
    rest: Array
    quad: NDArray[np.int64]
    weights: Array
    normal_offset: Array
    moved: Array | None = None
    place_sigma: Array | None = None

    def select(self, chosen: NDArray[np.int64]) -> "Markers":
        """The markers of the given rows."""
        names = tuple(self.names[k] for k in chosen)
        arrays = {key: value for key, value in vars(self).items() if isinstance(value, np.ndarray)}
        return Markers(names, **{key: value[chosen] for key, value in arrays.items()})

    def positions(self, q: Tensor) -> Tensor:
        """Marker positions [m], (..., M, 3), at mesh positions q (..., N, 3); differentiable."""
        return self._from_corners(q[..., torch.from_numpy(self.quad), :])

    def corner_jacobian(self, q: Tensor) -> Tensor:
        """Derivatives of marker positions with respect to their quads' corners, (..., M, 3, 4, 3)."""
        with torch.enable_grad():
            corners = q[..., torch.from_numpy(self.quad), :].detach().requires_grad_()
            position = self._from_corners(corners)
            rows = [torch.autograd.grad(position[..., i].sum(), corners, retain_graph=True)[0] for i in range(3)]
        return torch.stack(rows, dim=-3)

    def axes(self, q: Tensor) -> Tensor:
        """Material axes at the markers, (..., M, 3, 3): the columns are two tangents [m] and the unit normal."""
        corners = q[..., torch.from_numpy(self.quad), :]
        along, across = torch.from_numpy(self._tangent_weights)
        a, b = (corners * along[:, :, None]).sum(-2), (corners * across[:, :, None]).sum(-2)
        normal = torch.linalg.cross(a, b)
        return torch.stack([a, b, normal / torch.linalg.norm(normal, dim=-1, keepdim=True)], dim=-1)

    def place_slope(self, q: Tensor, rest: Tensor) -> Tensor:
        """Derivatives of the positions at q (..., N, 3) by the places on the body at rest (N, 3), (..., M, 3, 3).

        A marker moves along with the material axes at its place.
        """
        slope: Tensor = self.axes(q) @ torch.linalg.inv(self.axes(rest))
        return slope

    def _from_corners(self, corners: Tensor) -> Tensor:
        """Positions (..., M, 3) from the quads' corners (..., M, 4, 3)."""
        along, across = torch.from_numpy(self._tangent_weights)
        point = (corners * torch.from_numpy(self.weights)[:, :, None]).sum(-2)
        normal = torch.linalg.cross((corners * along[:, :, None]).sum(-2), (corners * across[:, :, None]).sum(-2))
        normal = normal / torch.linalg.norm(normal, dim=-1, keepdim=True)
        result: Tensor = point + torch.from_numpy(self.normal_offset)[:, None] * normal
        return result

    @property
    def _tangent_weights(self) -> Array:
        """Weights of the quads' vertices in the two tangent vectors at the markers, (2, M, 4)."""
        s = self.weights[:, 1] + self.weights[:, 2]
        t = self.weights[:, 2] + self.weights[:, 3]
        along = np.stack([t - 1.0, 1.0 - t, t, -t], axis=1)
        across = np.stack([s - 1.0, -s, s, 1.0 - s], axis=1)
        return np.stack([along, across])


def embed(mesh: HexMesh, names: tuple[str, ...], points: Array) -> Markers:
    """Embed points in their nearest boundary quads.

    A marker stores the bilinear weights of its foot point, clamped to the quad, and its signed distance from there
    along the normal. A marker beyond an edge is also offset sideways; `embedding_gap` returns that remainder.

    Args:
        mesh: the specimen at rest.
        names: of the points, (M).
        points: positions in the specimen frame [m], (M, 3).
    """
    corners = mesh.vertices[mesh.surface]  # (S, 4, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    quads, weights, offsets = [], [], []
    for point in points:
        nearest = None
        least = np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0), axis=1)
        for index in np.argsort(least):
            if nearest is not None and least[index] > nearest[0][0] + SAME_DISTANCE:
                break
            s, t = _foot_point(corners[index], point)
            w = np.array([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t])
            gap = point - w @ corners[index]
            normal = _normal(corners[index], s, t)
            offset = float(gap @ normal)
            # Several quads are equally near to a point off a corner: take the one with the least sideways offset.
            sideways = float(np.linalg.norm(gap - offset * normal))
            key = (round(float(np.linalg.norm(gap)), DIGITS), round(sideways, DIGITS), index)
            if nearest is None or key < nearest[0]:
                nearest = (key, index, w, offset)
        assert nearest is not None
        quads.append(mesh.surface[nearest[1]])
        weights.append(nearest[2])
        offsets.append(nearest[3])
    return Markers(names, points, np.array(quads), np.array(weights), np.array(offsets))


def embedding_gap(mesh: HexMesh, markers: Markers) -> Array:
    """Distances between the embedded markers and their layout positions at rest [m], (M,)."""
    embedded = markers.positions(torch.from_numpy(mesh.vertices)).numpy()
    return np.asarray(np.linalg.norm(embedded - markers.rest, axis=1))


def _normal(corners: Array, s: float, t: float) -> Array:
    a, b, c, d = corners
    along = (1 - t) * (b - a) + t * (c - d)
    across = (1 - s) * (d - a) + s * (c - b)
    normal = np.cross(along, across)
    return np.asarray(normal / np.linalg.norm(normal))


def _foot_point(corners: Array, point: Array) -> tuple[float, float]:
    """Bilinear coordinates (s, t) in [0, 1]^2 of the point of a quad nearest to `point` (Gauss-Newton)."""
    a, b, c, d = corners
    st = np.array([0.5, 0.5])
    for _ in range(50):
        s, t = st
        current = (1 - s) * (1 - t) * a + s * (1 - t) * b + s * t * c + (1 - s) * t * d
        tangents = np.stack([(1 - t) * (b - a) + t * (c - d), (1 - s) * (d - a) + s * (c - b)], axis=1)
        step = np.linalg.lstsq(tangents, point - current, rcond=None)[0]
        new = np.clip(st + step, 0.0, 1.0)
        if np.abs(new - st).max() < 1e-14:
            break
        st = new
    return float(st[0]), float(st[1])
