"""The places of dots on the undeformed body, found from where they are on the body as it sags under its own weight."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from rafl.capture.description.naming import dots_by_row, faces_of
from rafl.capture.description.still import Dots
from rafl.capture.registration.first_frame import MODEL_FRACTION
from rafl.capture.registration.material_change import MODULUS_SIGMA
from rafl.capture.registration.places import MAX_ITERATIONS, MIN_MODEL_SIGMA
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
DEPTH_SHARE = 0.3  # standard deviation of an unmeasured depth, as a share of the body's size
SURFACE_STEPS, LEAST_SLOPE = 8, 0.1  # along a line of sight to a surface, of which it must not be nearly a tangent
MODULUS_STEP = 0.05  # of log E, for differences
MAX_MODULUS_STEP = 0.3  # of log E in one iteration
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
        position: of the dots [m], (M, 3), as recorded, or where the line of sight passes the body if one camera saw it.
        rest: places on the undeformed body [m], (M, 3).
        normal: its outward normal there, (M, 3).
        gap: from the points of the deformed body to the dots, in the directions that were measured [m], (M, 3).
        direction: outward normal of the deformed body there, (M, 3).
        distance: of the dots from the body [m], (M). Where one camera saw a dot, it is that of its line of sight, or
            that of its assumed position along the normal less the deflection there, if that is larger.
        deflection: of the body there [m], (M).
        sigma: standard deviation of the places on the body that follows from those of the dots [m], (M).
    """

    position: Array
    rest: Array
    normal: Array
    gap: Array
    direction: Array
    distance: Array
    deflection: Array
    sigma: Array

    @property
    def offset(self) -> Array:
        """Distances of the dots from the deformed body along its outward normal, as far as measured [m], (M)."""
        return np.asarray((self.gap * self.direction).sum(axis=1))


def carry_back(shape: Shape, q: Array, dots: Dots) -> Carried:
    """Carry dots back by the deformation of the surface point that is nearest to each, in units of the dot's sigma.

    Where one camera saw a dot, it is the point in which the line of sight meets the body first.

    Args:
        shape: of the undeformed body.
        q: its nodes as it is deformed [m], (N, 3).
        dots: as recorded.
    """
    mesh = shape.mesh
    quad, weights = _nearest_points(mesh, q, dots)
    markers = Markers(dots.names, dots.position, quad, weights, np.zeros(len(quad)))
    deformed, undeformed = torch.from_numpy(q), torch.from_numpy(mesh.vertices)
    axes, rest_axes = markers.axes(deformed).numpy(), markers.axes(undeformed).numpy()
    point = markers.positions(deformed).numpy()
    along = dots.axes @ (dots.position - point)[..., None]
    gap = (dots.axes.swapaxes(1, 2) @ np.where(dots.measured[..., None], along, 0.0))[..., 0]
    rest, normal = markers.positions(undeformed).numpy(), rest_axes[..., 2]
    deflection = np.linalg.norm(point - rest, axis=1)
    distance = np.linalg.norm(gap, axis=1)
    if shape.surface is not None:
        back = rest_axes @ np.linalg.inv(axes)
        sight = np.where(dots.measured[:, 2:], 0.0, (back @ dots.axes[:, 2, :, None])[..., 0])
        rest, distance, normal = _on_surface(shape.surface, rest + (back @ gap[..., None])[..., 0], sight)
    depth = np.abs(((dots.position - point - gap) * axes[..., 2]).sum(axis=1))
    distance = np.maximum(distance, depth - deflection)
    # Where a dot must lie on the surface, what was measured decides along the two tangents only.
    tangents, rest_tangents = axes[..., :2], rest_axes[..., :2]
    unknown = np.eye(3) / np.ptp(q, axis=0).max() ** 2  # along a face that is seen edge-on
    by_tangent = tangents.swapaxes(1, 2) @ (dots.precision() + unknown) @ tangents
    covariance = rest_tangents @ np.linalg.inv(by_tangent) @ rest_tangents.swapaxes(1, 2)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    return Carried(point + gap, rest, normal, gap, axes[..., 2], distance, deflection, sigma)


def _nearest_points(mesh: HexMesh, q: Array, dots: Dots) -> tuple[NDArray[np.int64], Array]:
    """Boundary quads (M, 4) of the deformed body, and weights of their nodes, of the points nearest to the dots."""
    size = float(np.linalg.norm(np.ptp(q, axis=0)))
    model_sigma = _model_sigma(np.linalg.norm(q - mesh.vertices, axis=1).max())
    # A dot of unknown depth starts in front of the body, so that the face towards the camera is the nearest.
    position = dots.position - size * np.where(dots.measured[:, 2:], 0.0, dots.axes[:, 2])
    sigma = np.where(dots.measured, np.exp(np.round(np.log(np.hypot(dots.sigma, model_sigma)), 1)), DEPTH_SHARE * size)
    precision = replace(dots, sigma=sigma).precision()
    quad, weights = np.zeros((len(position), 4), dtype=np.int64), np.zeros((len(position), 4))
    _, group = np.unique(np.round(precision * model_sigma**2, 9), axis=0, return_inverse=True)
    for number in range(group.max() + 1):  # dots of similar uncertainty are embedded together
        own = np.flatnonzero(group.ravel() == number)
        scaled = np.linalg.cholesky(precision[own[0]])
        found = embed(HexMesh(q @ scaled, mesh.hexes), ("",) * len(own), position[own] @ scaled)
        quad[own], weights[own] = found.quad, found.weights
    return quad, weights


def _on_surface(surface: trimesh.Trimesh, points: Array, sight: Array) -> tuple[Array, Array, Array]:
    """Points of a surface [mm] nearest to points (M, 3) [m], their distances [m], and the normals there.

    sight: of points that may move along a line to the surface, its direction, else 0, (M, 3).
    """
    query = trimesh.proximity.ProximityQuery(surface)  # type: ignore[no-untyped-call]
    for _ in range(SURFACE_STEPS if sight.any() else 1):
        nearest, distance, triangle = query.on_surface(1e3 * points)
        normal = surface.face_normals[triangle]
        slope = (normal * sight).sum(axis=1)
        towards = (normal * (1e-3 * nearest - points)).sum(axis=1)
        step = np.where(np.abs(slope) > LEAST_SLOPE, towards / np.where(slope == 0.0, 1.0, slope), 0.0)
        points = points + step[:, None] * sight
    return 1e-3 * nearest, 1e-3 * distance, normal


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
    - a dot's distance from its face as far as it was measured, which is off zero by its sigma;
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
    model = _model_sigma(carried.deflection)
    place_sigma = np.sqrt(MIN_SIGMA**2 + carried.sigma**2 + model**2 + (sigma * np.linalg.norm(slope, axis=1)) ** 2)
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
        simulator = self.simulator.with_material(softened)
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
        model = _model_sigma(base.deflection)
        along = (self.dots.axes @ base.direction[..., None])[..., 0]
        own_variance = (along**2 * np.where(self.dots.measured, self.dots.sigma, 0.0) ** 2).sum(axis=1)
        variance = np.concatenate([PLACED_SIGMA**2 + base.sigma[order] ** 2, own_variance + model**2])
        height = np.concatenate([across @ up, base.direction @ up])
        tilt = height * np.concatenate([reach[order], reach]) / reach.max()
        covariance = np.diag(variance) + self.world_sigma**2 * (np.outer(height, height) + np.outer(tilt, tilt))
        covariance[: len(order), : len(order)] += ROW_OFFSET_SIGMA**2 * (number[:, None] == number)
        return np.concatenate([position, carried.offset]), covariance
