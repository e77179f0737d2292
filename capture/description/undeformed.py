"""The places of dots on the undeformed body, found from where they are on the body as it sags under its own weight."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from rafl.capture.description.naming import dots_by_row, faces_of
from rafl.capture.description.still import Dots
from rafl.capture.registration.force_search import MODULUS_SIGMA
from rafl.capture.registration.places import (
    MAX_ITERATIONS,
    MAX_MODULUS_STEP,
    MIN_MODEL_SIGMA,
    MODEL_FRACTION,
)
from rafl.data.markers import Markers, embed
from rafl.fem.mesh import HexMesh
from rafl.simulation.simulator import GRAVITY, Simulator
from rafl.tracking.linking.layout import DEFAULT_SIGMA_MM, GRID_DIRECTIONS

Array = NDArray[Any]

PLACED_SIGMA = (
    1e-3 * DEFAULT_SIGMA_MM
)  # of a dot from the straight row that a hand meant, and of a body in its world [m]
ROW_OFFSET_SIGMA = 0.1  # of the height of a row, which nobody knows beforehand [m]
MAX_ROW_SCATTER = 3.0  # dots farther from straight rows than this multiple of PLACED_SIGMA were not placed in rows
MIN_SIGMA = 5e-5  # of a place, for what the model does not know of the clamp and of Poisson's ratio [m]
MODULUS_STEP = 0.05  # of log E, for differences
MODULUS_TOLERANCE = 1e-3  # the search ends with a smaller change of log E


@dataclass(frozen=True)
class Shape:
    """A body's mesh, and its exact surface [mm] where the elements only fill it."""

    mesh: HexMesh
    surface: trimesh.Trimesh | None = None


@dataclass(frozen=True)
class Carried:
    """Dots carried back from the deformed to the undeformed body.

    Attributes:
        rest: places on the undeformed body [m], (M, 3).
        normal: its outward normal there, (M, 3).
        gap: from the nearest points of the deformed body to the dots [m], (M, 3).
        direction: outward normal of the deformed body there, (M, 3).
        distance: of the dots from the body [m], (M).
    """

    rest: Array
    normal: Array
    gap: Array
    direction: Array
    distance: Array

    @property
    def offset(self) -> Array:
        """Distances of the dots from the deformed body along its outward normal [m], (M)."""
        return np.asarray((self.gap * self.direction).sum(axis=1))


def carry_back(shape: Shape, q: Array, dots: Dots) -> Carried:
    """Carry dots back by the deformation of the surface point that is nearest to each, in units of the dot's sigma.

    Args:
        shape: of the undeformed body.
        q: its nodes as it is deformed [m], (N, 3).
        dots: as recorded.
    """
    mesh, count = shape.mesh, len(dots.names)
    model_sigma = _model_sigma(np.linalg.norm(q - mesh.vertices, axis=1).max())
    sigma = np.exp(np.round(np.log(np.hypot(dots.sigma, model_sigma)), 1))  # dots of similar ones are embedded together
    quad, weights = np.zeros((count, 4), dtype=np.int64), np.zeros((count, 4))
    for unit in np.unique(sigma, axis=0):
        own = np.flatnonzero((sigma == unit).all(axis=1))
        found = embed(HexMesh(q / unit, mesh.hexes), ("",) * len(own), dots.position[own] / unit)
        quad[own], weights[own] = found.quad, found.weights
    markers = Markers(dots.names, dots.position, quad, weights, np.zeros(len(quad)))
    deformed, undeformed = torch.from_numpy(q), torch.from_numpy(mesh.vertices)
    axes, rest_axes = markers.axes(deformed).numpy(), markers.axes(undeformed).numpy()
    gap = dots.position - markers.positions(deformed).numpy()
    rest, normal = markers.positions(undeformed).numpy(), rest_axes[..., 2]
    distance = np.linalg.norm(gap, axis=1)
    if shape.surface is not None:
        rest = rest + np.einsum("mij,mjk,mk->mi", rest_axes, np.linalg.inv(axes), gap)
        query = trimesh.proximity.ProximityQuery(shape.surface)  # type: ignore[no-untyped-call]
        nearest, distance, triangle = query.on_surface(1e3 * rest)
        rest, distance, normal = 1e-3 * nearest, 1e-3 * distance, shape.surface.face_normals[triangle]
    return Carried(rest, normal, gap, axes[..., 2], distance)


def _model_sigma(deflection: Any) -> Any:
    """Standard deviation of a point of the mesh from that of the body [m], by its deflection [m]."""
    return np.maximum(MODEL_FRACTION * deflection, MIN_MODEL_SIGMA)


@dataclass(frozen=True)
class Undeformed:
    """Dots on the undeformed body.

    Attributes:
        carried: their places.
        sigma: standard deviations of the places [m], (M).
        q: the body as recorded [m], (N, 3).
        log_modulus: of E with which it sags so, relative to that of the assumed material.
        modulus_sigma: standard deviation of `log_modulus`.
    """

    carried: Carried
    sigma: Array
    q: Array
    log_modulus: float
    modulus_sigma: float


def find_undeformed(
    shape: Shape,
    simulator: Simulator,
    dots: Dots,
    prior_sigma: float = MODULUS_SIGMA,
    world_sigma: float = PLACED_SIGMA,
) -> Undeformed:
    """Find the places of dots together with Young's modulus, which is known roughly only.

    With a wrong E the dots of a straight row would not have been in line before the body sagged, and dots would not lie
    on its faces. E is the most probable value, by Gauss-Newton, of these observations:

    - a dot's position across its row, which is off the row's by PLACED_SIGMA;
    - a dot's distance from its face, which is off zero by its sigma;
    - both also by a height and a tilt of the body in its world, each of `world_sigma` at the tip;
    - log E, which is off that of the assumed material by `prior_sigma`.

    Dots that are far from straight rows at every E were not placed in rows, which then tell nothing.

    Args:
        shape: of the undeformed body.
        simulator: of the body with the assumed material.
        dots: as recorded, at rest under gravity. Without gravity the body is undeformed, and E stays as assumed.
        prior_sigma: standard deviation of log E of the assumed material.
        world_sigma: standard deviation of the body's place in the frame of the dots [m].

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    search = _ModulusSearch(shape, simulator, dots, prior_sigma, world_sigma)
    log_modulus, sigma, straight = search.minimise(with_rows=True)
    if not straight:
        log_modulus, sigma, _ = search.minimise(with_rows=False)
    q, carried = search.at(log_modulus)
    slope = (search.at(log_modulus + MODULUS_STEP)[1].rest - carried.rest) / MODULUS_STEP
    in_plane = [np.array(GRID_DIRECTIONS[face[0]]) for face in faces_of(carried.normal)]
    measured = np.linalg.norm(np.array(in_plane) * dots.sigma[:, None], axis=2).max(axis=1)
    model = _model_sigma(np.linalg.norm(dots.position - carried.rest, axis=1))
    place_sigma = np.sqrt(MIN_SIGMA**2 + measured**2 + model**2 + (sigma * np.linalg.norm(slope, axis=1)) ** 2)
    return Undeformed(carried, place_sigma, q, log_modulus, sigma)


@dataclass(frozen=True)
class _ModulusSearch:
    shape: Shape
    simulator: Simulator
    dots: Dots
    prior_sigma: float
    world_sigma: float

    def at(self, log_modulus: float) -> tuple[Array, Carried]:
        """The deformed body and the dots carried back from it, with log E relative to the assumed material's."""
        material = self.simulator.material
        softened = replace(material, youngs_modulus=material.youngs_modulus * float(np.exp(log_modulus)))
        simulator = replace(self.simulator, material=softened)
        q = simulator.equilibrium(simulator.weight[None], label="the specimen under its own weight")[0]
        return q, carry_back(self.shape, q, self.dots)

    def minimise(self, with_rows: bool) -> tuple[float, float, bool]:
        """Log E, its standard deviation, and whether the dots lie in straight rows."""
        log_modulus, precision, straight = 0.0, self.prior_sigma**-2.0, with_rows
        for _ in range(MAX_ITERATIONS):
            q, carried = self.at(log_modulus)
            later = self.at(log_modulus + MODULUS_STEP)[1]
            faces = faces_of(carried.normal)
            rows = dots_by_row(faces, carried.rest) if with_rows else []
            residual, covariance = self._observations(carried, carried, faces, rows, q)
            slope = (self._observations(later, carried, faces, rows, q)[0] - residual) / MODULUS_STEP
            weighted = np.linalg.solve(covariance, np.column_stack([residual, slope]))
            precision = float(slope @ weighted[:, 1]) + self.prior_sigma**-2.0
            step = -(float(slope @ weighted[:, 0]) + log_modulus * self.prior_sigma**-2.0) / precision
            across = slice(0, sum(map(len, rows)))
            own = residual[across] @ np.linalg.solve(covariance[across, across], residual[across])
            straight = with_rows and bool(own < MAX_ROW_SCATTER**2 * max(across.stop - len(rows), 1))
            log_modulus += float(np.clip(step, -MAX_MODULUS_STEP, MAX_MODULUS_STEP))
            if abs(step) < MODULUS_TOLERANCE:
                break
        return log_modulus, precision**-0.5, straight

    def _observations(
        self, carried: Carried, base: Carried, faces: list[str], rows: list[NDArray[np.int64]], q: Array
    ) -> tuple[Array, Array]:
        """Positions across rows, then distances from faces [m], and their covariance, which `base` gives."""
        up = -np.asarray(GRAVITY) / np.linalg.norm(GRAVITY)
        fixed = self.simulator.mesh.vertices[self.simulator.fixed]
        reach = np.linalg.norm(base.rest[:, None] - fixed[None], axis=2).min(axis=1)
        order = np.concatenate([*rows, np.zeros(0)]).astype(int)
        across = np.array([GRID_DIRECTIONS[faces[dot][0]][1] for dot in order]).reshape(-1, 3)
        position = (carried.rest[order] * across).sum(axis=1)
        number = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
        model = _model_sigma(np.linalg.norm(self.dots.position - base.rest, axis=1))
        off_face = np.sqrt((base.direction**2 * self.dots.sigma**2).sum(axis=1) + model**2)
        variance = np.concatenate([np.hypot(PLACED_SIGMA, self.dots.sigma[order].min(axis=1)), off_face]) ** 2
        height = np.concatenate([across @ up, base.direction @ up])
        tilt = height * np.concatenate([reach[order], reach]) / reach.max()
        covariance = np.diag(variance) + self.world_sigma**2 * (np.outer(height, height) + np.outer(tilt, tilt))
        covariance[: len(order), : len(order)] += ROW_OFFSET_SIGMA**2 * (number[:, None] == number)
        return np.concatenate([position, carried.offset]), covariance
