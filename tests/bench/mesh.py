"""Error of the specimens' meshes: sag of the tip and first frequency compared with the converged solution.

    python tests/bench/mesh.py [SHAPE ...] [--out build/bench-mesh] [--results datasets/results]

Each of the paper's eleven shapes hangs by its clamp, of neo-Hookean rubber with three Poisson's ratios. The sag is that
of the corners of the free face under the own weight; the frequency is the first about the straight unloaded state.
Two independent references stand for the exact solution:

- quadratic hexahedra with linear pressures, on scikit-fem (`mixed_hexahedra`);
- the simulator, with cells divided once and twice and extrapolated.

Resumable: values under --out are not computed again. Delete those of a scheme whose elements have changed. All
together take about an hour and 2 GB, most of both for the fine fish-tail.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from mixed_hexahedra import MixedHexahedra
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial import cKDTree
from voxels import Voxels

from rafl.capture.specimen.specimen import CLAMP_SPLIT, read_specimen
from rafl.common.files import write_text
from rafl.fem.material import INTEGRATION_SCHEMES, Material, lame
from rafl.fem.mesh import CORNERS, HexMesh
from rafl.simulation.simulator import Simulator
from rafl.solvers.block_elimination import BlockElimination
from rafl.solvers.multigrid_cg import MultigridCG

SPECIMENS = Path(__file__).parents[2] / "datasets" / "specimens"
BEAMS = ("canonical", "longer", "shorter", "thicker", "thinner")
TAILS = ("fishtail-crude", "fishtail-fine")
SCALED = tuple(f"{name}-scaled" for name in BEAMS[1:])
SHAPES = BEAMS + SCALED + TAILS
YOUNGS_MODULUS, DENSITY, GRAVITY = 130e3, 1070.0, 9.80709  # [Pa], [kg/m^3], [m/s^2]
POISSONS_RATIOS = (0.3, 0.45, 0.499)
EXTRAPOLATED_SCHEMES = ("selective", "enhanced")
# `enhanced` integration, and the cells at the clamp cut in two, as in specimens of preset physical.
CUT_SCHEME = "enhanced, cut"
# Without an observed order: between those of smooth solutions (2) and of the singularities at clamped edges (about 1).
ASSUMED_ORDER, MIN_ORDER, MAX_ORDER = 4.0 / 3.0, 1.0, 2.5
SCIKIT_FEM_CORNERS = (0, 1, 2, 4, 3, 5, 6, 7)  # ours, in scikit-fem's order


@dataclass(frozen=True)
class Response:
    """What is compared.

    Attributes:
        sag_mm: mean drop of the specimen's vertices on its free face [mm].
        frequency_hz: first natural frequency [Hz].
    """

    sag_mm: float
    frequency_hz: float


@dataclass(frozen=True)
class Shape:
    """A specimen's cells, and how its references are computed.

    Attributes:
        name: of the specimen.
        voxels: its cells.
    """

    name: str
    voxels: Voxels

    @classmethod
    def of(cls, name: str) -> "Shape":
        """The shape of a specimen file."""
        return cls(name, Voxels.of(read_specimen(SPECIMENS / f"{name}.yaml").mesh))

    @property
    def solid(self) -> str:
        """Name of the solid that it meshes: scaled beams mesh the same ones as the beams themselves."""
        return self.name.removesuffix("-scaled")

    @property
    def cells_across(self) -> int:
        """Number of cells across its thinnest section."""
        return int(min(section.sum(axis=axis).max() for section in self.voxels.filled for axis in (0, 1)))

    @cached_property
    def mirrored(self) -> bool:
        """Whether it is symmetric about its mid-plane normal to y."""
        return bool(np.array_equal(self.voxels.filled, self.voxels.filled[:, ::-1]))

    @cached_property
    def tip(self) -> NDArray[np.float64]:
        """Vertices of the free face [m], (P, 3)."""
        mesh = self.voxels.mesh
        return mesh.vertices[mesh.face_nodes("x-max")]

    @property
    def mixed_levels(self) -> tuple[tuple[int, bool], ...]:
        """Meshes of `mixed_responses`, each started from the one before: parts of a cell, and whether graded."""
        if self.solid in BEAMS:
            return (1, False), (1, True)
        return ((1, False), (2, False), (4, False)) if self.solid == "fishtail-crude" else ((1, False),)

    @property
    def simulator_levels(self) -> tuple[int, ...]:
        """Numbers of parts that the cells are divided into for the simulator's own reference."""
        return (1, 2) if self.solid == "fishtail-fine" else (1, 2, 4)


def hang(shape: Shape, parts: int, scheme: str, nu: float) -> tuple[Simulator, NDArray[np.float64]]:
    """The simulator of a shape whose cells are divided into `parts` along each axis, a power of 2, and its equilibrium.

    Newton's method starts from the equilibrium of cells twice as large, if there is one.

    Returns:
        The simulator, and the displacements of its vertices under the own weight [m], (N, 3).
    """
    mesh, integration = shape.voxels.divided(parts).mesh, scheme
    if scheme == CUT_SCHEME:
        mesh, integration = mesh.split_layer(mesh.face_nodes("x-min"), CLAMP_SPLIT), "enhanced"
    material = Material(YOUNGS_MODULUS, nu, DENSITY, mass="lumped", law="neo-hookean", integration=integration)
    simulator = Simulator(mesh, material, mesh.face_nodes("x-min"), gravity=(0.0, 0.0, -GRAVITY))
    if isinstance(simulator.engine.linear_solver, MultigridCG):  # it does not converge when nearly incompressible
        simulator.engine.linear_solver = BlockElimination(mesh, simulator.fixed)
    start = None
    if parts > 1:
        coarse, displacement = hang(shape, parts // 2, scheme, nu)
        start = (mesh.vertices + interpolate(coarse.mesh, displacement, mesh.vertices))[None]
    return simulator, simulator.equilibrium(simulator.weight[None], start)[0] - mesh.vertices


def interpolate(mesh: HexMesh, u: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (P, 3) at points (P, 3) [m] of values (N, 3) at the vertices of a mesh of equal boxes."""
    low, high = mesh.vertices[mesh.hexes[:, 0]], mesh.vertices[mesh.hexes[:, 7]]
    cell = cKDTree(0.5 * (low + high)).query(points)[1]
    position = ((points - low[cell]) / (high - low)[cell])[:, None]
    weights = np.where(CORNERS > 0.5, position, 1.0 - position).prod(axis=-1)
    return np.asarray(np.einsum("pn,pni->pi", weights, u[mesh.hexes[cell]]))


def simulated_response(shape: Shape, parts: int, scheme: str, nu: float) -> Response:
    """The simulator's response with every cell divided into `parts` along each axis, a power of 2."""
    simulator, displacement = hang(shape, parts, scheme, nu)
    tip = cKDTree(simulator.mesh.vertices).query(shape.tip)[1]
    return Response(-1e3 * float(displacement[tip, 2].mean()), first_frequency(simulator))


def first_frequency(simulator: Simulator) -> float:
    """First natural frequency about the unloaded state [Hz]."""
    engine, row, unknowns = simulator.engine, np.arange(1), len(simulator.engine.free_index)
    tangents = engine.evaluate(simulator.mesh.vertices[None], simulator.constitutive_state(1), tangent=True)[2]
    factors = engine.allocate(1)
    engine.factor(factors, row, tangents, np.zeros((1, unknowns)))
    root = np.sqrt(np.repeat(simulator.node_mass, 3)[engine.free_index])

    def compliance(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return root * engine.solve(factors, row, (root * x.ravel())[None, None])[0, 0]

    operator = LinearOperator((unknowns, unknowns), compliance, dtype=float)
    largest = eigsh(operator, 1, which="LA", v0=np.ones(unknowns), return_eigenvectors=False)[0]
    return float(1.0 / (2.0 * np.pi * np.sqrt(largest)))


def mixed_responses(shape: Shape, nu: float) -> list[Response]:
    """Responses of quadratic hexahedra on the meshes of `shape.mixed_levels`; of one half of a mirrored shape."""
    whole, tip = shape.voxels, shape.tip
    if shape.mirrored:
        middle = whole.lines[1][[0, -1]].mean()
        whole, tip = whole.upper_half(1), np.stack([tip[:, 0], middle + np.abs(tip[:, 1] - middle), tip[:, 2]], axis=1)
    responses, previous = [], None
    for parts, graded in shape.mixed_levels:
        voxels = whole.divided(parts)
        if graded:
            voxels = voxels.graded(0, True, False).graded(1, not shape.mirrored, True).graded(2, True, True)
        mesh = voxels.mesh
        hexes = mesh.hexes[:, SCIKIT_FEM_CORNERS]
        body = MixedHexahedra(mesh.vertices, hexes, shape.mirrored, *lame(YOUNGS_MODULUS, nu), DENSITY)
        start = None if previous is None else previous[0].interpolate(previous[1], body.nodes)
        u = body.equilibrium(body.weight(GRAVITY), start)
        previous = body, u
        drop = -u[cKDTree(body.nodes).query(tip)[1], 2]
        responses.append(Response(1e3 * float(drop.mean()), body.first_frequency()))
    return responses


def limit(values: list[float], parts: list[int]) -> float:
    """Value on infinitely fine meshes: Richardson's extrapolation of the last two, or of three that halve each time.

    Three values give the order of convergence, unless it is implausible; then it is ASSUMED_ORDER.
    """
    order = ASSUMED_ORDER
    if len(values) > 2:
        ratio = (values[-2] - values[-3]) / (values[-1] - values[-2])
        observed = np.log2(ratio) if ratio > 0 else 0.0
        order = observed if MIN_ORDER <= observed <= MAX_ORDER else ASSUMED_ORDER
    return values[-1] + (values[-1] - values[-2]) / ((parts[-1] / parts[-2]) ** order - 1.0)


def limiting_response(responses: list[Response], parts: list[int]) -> Response:
    """`limit` of the sag and of the frequency."""
    return Response(
        limit([response.sag_mm for response in responses], parts),
        limit([response.frequency_hz for response in responses], parts),
    )


@dataclass(frozen=True)
class Study:
    """Responses of all shapes, each computed once.

    Attributes:
        folder: for the results.
    """

    folder: Path

    def _stored(self, name: str, compute: Callable[[], list[Response]]) -> list[Response]:
        path = self.folder / f"{name}.json"
        if not path.exists():
            start = time.perf_counter()
            rows = [asdict(response) for response in compute()]
            seconds = round(time.perf_counter() - start, 2)
            write_text(path, json.dumps({"responses": rows, "seconds": seconds}, indent=1) + "\n")
        return [Response(**row) for row in json.loads(path.read_text())["responses"]]

    def simulated(self, shape: Shape, parts: int, scheme: str, nu: float) -> Response:
        """`simulated_response`."""
        name = f"{shape.name}-{nu}-{scheme}-{parts}"
        return self._stored(name, lambda: [simulated_response(shape, parts, scheme, nu)])[0]

    def mixed(self, shape: Shape, nu: float) -> Response:
        """The converged response by quadratic hexahedra.

        Meshes of beams are graded so finely that no extrapolation is needed; one more division changes the canonical
        beam by 0.04 %. The fine fish-tail is computed on its own cells only, because finer ones exceed 8 GB; what
        remains is about 0.5 %, the difference to the simulator's own reference.
        """
        responses = self._stored(f"{shape.name}-{nu}-mixed", lambda: mixed_responses(shape, nu))
        levels = shape.mixed_levels
        if len(levels) == 1 or levels[-1][1]:
            return responses[-1]
        return limiting_response(responses, [parts for parts, _ in levels])

    def extrapolated(self, shape: Shape, scheme: str, nu: float) -> Response:
        """The converged response by the simulator."""
        levels = list(shape.simulator_levels)
        return limiting_response([self.simulated(shape, parts, scheme, nu) for parts in levels], levels)

    def references(self, solid: str) -> pd.DataFrame:
        """Both references of a solid, one row per Poisson's ratio."""
        shape = Shape.of(solid)
        rows = []
        for nu in POISSONS_RATIOS:
            row = {"solid": solid, "poissons_ratio": nu} | asdict(self.mixed(shape, nu))
            for scheme in EXTRAPOLATED_SCHEMES:
                if scheme in INTEGRATION_SCHEMES:
                    own = self.extrapolated(shape, scheme, nu)
                    row |= {f"{scheme}_{key}": value for key, value in asdict(own).items()}
            rows.append(row)
        return pd.DataFrame(rows)

    def errors(self, name: str, references: pd.DataFrame) -> pd.DataFrame:
        """Errors [%] of a specimen's own mesh with every scheme, one row per Poisson's ratio."""
        shape = Shape.of(name)
        rows = []
        for nu in POISSONS_RATIOS:
            row: dict[str, str | float] = {"shape": name, "cells_across": shape.cells_across, "poissons_ratio": nu}
            exact = references[(references.solid == shape.solid) & (references.poissons_ratio == nu)].iloc[0]
            for scheme in (*INTEGRATION_SCHEMES, CUT_SCHEME):
                for key, value in asdict(self.simulated(shape, 1, scheme, nu)).items():
                    row[f"{scheme}_{key.split('_')[0]}_percent"] = 100.0 * (value / exact[key] - 1.0)
            rows.append(row)
        return pd.DataFrame(rows)


def three_digits(table: pd.DataFrame) -> dict[str, Callable[[float], str]]:
    """Formats for the columns of numbers."""
    return {column: "{:.3f}".format for column in table.select_dtypes("float")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shapes", nargs="*", default=SHAPES, help=f"of {', '.join(SHAPES)} [all]")
    parser.add_argument("--out", type=Path, default=Path("build/bench-mesh"), help="folder for the responses")
    parser.add_argument("--results", type=Path, help="folder for the two tables [none]")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    study = Study(options.out)
    solids = dict.fromkeys(name.removesuffix("-scaled") for name in options.shapes)
    references = pd.concat([study.references(solid) for solid in solids])
    print(
        f"converged solution: quadratic hexahedra, and the simulator extrapolated\n{references.to_string(index=False)}"
    )
    errors = pd.concat([study.errors(name, references) for name in options.shapes])
    print("\nerror of the specimens' own meshes [%]")
    print(errors.to_string(index=False, formatters=three_digits(errors)))
    if options.results:
        references.round(4).to_csv(options.results / "mesh-references.csv", index=False)
        errors.round(3).to_csv(options.results / "mesh-errors.csv", index=False)


if __name__ == "__main__":
    main()
