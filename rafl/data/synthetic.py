"""Recordings that a simulator of another material makes: the paper's sim-to-sim setting, every vertex seen."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.data.dataset import Dataset, Trajectory
from rafl.data.markers import Markers
from rafl.fem.mesh import CELL_SIDES, HexMesh
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]


def vertex_markers(mesh: HexMesh) -> Markers:
    """A marker at every vertex, inner ones too: each rides on the corner of some cell's side."""
    quad = np.full((len(mesh.vertices), 4), -1)
    for side in CELL_SIDES.values():
        for turn in range(4):
            corners = mesh.hexes[:, np.roll(side, turn)]
            quad[corners[:, 0]] = corners
    weights = np.zeros(quad.shape)
    weights[:, 0] = 1.0
    names = tuple(f"v{number}" for number in range(len(quad)))
    return Markers(names, mesh.vertices, quad, weights, np.zeros(len(quad)))


def load_force(simulator: Simulator, nodes: NDArray[np.int64], load: float) -> Array:
    """Nodal forces [N], (N, 3), of a load [kg] that some nodes share."""
    force = np.zeros_like(simulator.mesh.vertices)
    force[nodes] = load * np.asarray(simulator.gravity) / len(nodes)
    return force


def hung(target: Simulator, tip: NDArray[np.int64], loads: Array) -> Array:
    """Equilibria [m], (B, N, 3), with loads (B) [kg] shared by the tip's nodes."""
    force = target.weight + np.stack([load_force(target, tip, load) for load in loads])
    return target.equilibrium(force, what="hanging loads")


def twisted(mesh: HexMesh, angles: Array) -> Array:
    """Shapes [m], (B, N, 3), turned about the axis through the section's middle, by angle (B) [rad] at the tip."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    share = (mesh.vertices[:, 0] - low[0]) / (high[0] - low[0])
    middle = 0.5 * (low + high)[1:]
    turn = angles[:, None] * share
    y, z = (mesh.vertices[:, 1:] - middle).T
    result = np.repeat(mesh.vertices[None], len(angles), axis=0)
    result[..., 1] = middle[0] + np.cos(turn) * y - np.sin(turn) * z
    result[..., 2] = middle[1] + np.sin(turn) * y + np.cos(turn) * z
    return result


def let_go(simulator: Simulator, starts: Array, frames: int, names: tuple[str, ...]) -> Array:
    """Positions [m], (T, B, N, 3), of bodies let go from `starts` (B, N, 3), at rest; `names` are for messages.

    Raises:
        SimulationError: a step failed.
    """
    q = torch.from_numpy(starts)
    none = torch.zeros_like(q)
    with torch.no_grad():
        return rollout(simulator, Start(q, none, none, none[..., 0], names), frames - 1)[0].numpy()


def released(
    name: str, base: Simulator, target: Simulator, starts: Array, frames: int, splits: dict[str, str], recipe: str = ""
) -> Dataset:
    """The target let go from `starts` (B, N, 3), at rest, as recordings for the base simulator.

    Args:
        name: of the specimen.
        base: what is to be fitted.
        target: what is recorded.
        starts: [m], (B, N, 3).
        frames: of each recording, the start included.
        splits: by recording, in the order of `starts`.
        recipe: what the recordings are, for whoever reads the file.

    Raises:
        SimulationError: a step of the target failed.
    """
    positions = let_go(target, starts, frames, tuple(splits))
    shape = (frames, len(base.mesh.vertices))
    empty = np.zeros_like(base.mesh.vertices)
    trajectories = {
        recording: Trajectory(
            time=base.time_step * np.arange(frames),
            markers=positions[:, b],
            valid=np.ones(shape, dtype=bool),
            sigma=np.full((*shape, 3), 1e-9),
            q=starts[b],
            v=empty,
            virtual_force=empty,
            load=empty,
            added_mass=empty[:, 0],
            split=split,
        )
        for b, (recording, split) in enumerate(splits.items())
    }
    return Dataset(name, base, vertex_markers(base.mesh), trajectories, recipe)


def with_material(simulator: Simulator, youngs_modulus: float, poissons_ratio: float) -> Simulator:
    """The same specimen of another elasticity."""
    material = replace(simulator.material, youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio)
    return replace(simulator, material=material)
