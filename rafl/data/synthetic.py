"""Simulated recordings of a specimen of another material: the paper's sim-to-sim setting, every vertex observed."""

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
    """A marker at every vertex, inner ones too; each is embedded at the corner of one face of a cell."""
    quad = np.full((len(mesh.vertices), 4), -1)
    for side in CELL_SIDES.values():
        for shift in range(4):
            corners = mesh.hexes[:, np.roll(side, shift)]
            quad[corners[:, 0]] = corners
    weights = np.zeros(quad.shape)
    weights[:, 0] = 1.0
    names = tuple(f"v{number}" for number in range(len(quad)))
    return Markers(names, mesh.vertices, quad, weights, np.zeros(len(quad)))


def load_force(simulator: Simulator, nodes: NDArray[np.int64], load: float) -> Array:
    """Nodal forces [N], (N, 3), of the weight of a load [kg] that the given nodes share."""
    force = np.zeros_like(simulator.mesh.vertices)
    force[nodes] = load * np.asarray(simulator.gravity) / len(nodes)
    return force


def loaded_equilibria(target: Simulator, tip: NDArray[np.int64], loads: Array) -> Array:
    """Equilibrium positions [m], (B, N, 3), under loads (B) [kg] that the nodes `tip` share."""
    force = target.weight + np.stack([load_force(target, tip, load) for load in loads])
    return target.equilibrium(force, label="hanging loads")


def twisted_shapes(mesh: HexMesh, angles: Array) -> Array:
    """Positions [m], (B, N, 3), twisted about the central axis along x by angles (B) [rad] at the tip.

    The twist grows linearly with x from the clamp.
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    fraction = (mesh.vertices[:, 0] - low[0]) / (high[0] - low[0])
    centre = 0.5 * (low + high)[1:]
    angle = angles[:, None] * fraction
    y, z = (mesh.vertices[:, 1:] - centre).T
    result = np.repeat(mesh.vertices[None], len(angles), axis=0)
    result[..., 1] = centre[0] + np.cos(angle) * y - np.sin(angle) * z
    result[..., 2] = centre[1] + np.sin(angle) * y + np.cos(angle) * z
    return result


def simulate_release(simulator: Simulator, starts: Array, frames: int, names: tuple[str, ...]) -> Array:
    """Positions [m], (T, B, N, 3), of specimens released from rest at `starts` (B, N, 3) [m]; `names` for messages.

    Raises:
        SimulationError: a step failed.
    """
    q = torch.from_numpy(starts)
    zero = torch.zeros_like(q)
    with torch.no_grad():
        return rollout(simulator, Start(q, zero, zero, zero[..., 0], names), frames - 1)[0].numpy()


def release_dataset(
    name: str, base: Simulator, target: Simulator, starts: Array, frames: int, splits: dict[str, str], recipe: str = ""
) -> Dataset:
    """Releases of the target simulator from rest, as recordings for the base simulator.

    Args:
        name: of the specimen.
        base: simulator that a model is fitted in.
        target: simulator that makes the recordings.
        starts: initial positions [m], (B, N, 3).
        frames: of each recording, the first included.
        splits: by recording, in the order of `starts`.
        recipe: description of the recordings, for readers of the file.

    Raises:
        SimulationError: a step of the target failed.
    """
    positions = simulate_release(target, starts, frames, tuple(splits))
    shape = (frames, len(base.mesh.vertices))
    zero = np.zeros_like(base.mesh.vertices)
    trajectories = {
        recording: Trajectory(
            time=base.time_step * np.arange(frames),
            markers=positions[:, b],
            valid=np.ones(shape, dtype=bool),
            sigma=np.full((*shape, 3), 1e-9),
            q=starts[b],
            v=zero,
            virtual_force=zero,
            load=zero,
            added_mass=zero[:, 0],
            split=split,
        )
        for b, (recording, split) in enumerate(splits.items())
    }
    return Dataset(name, base, vertex_markers(base.mesh), trajectories, recipe)


def with_material(simulator: Simulator, youngs_modulus: float, poissons_ratio: float) -> Simulator:
    """The same specimen with another Young's modulus [Pa] and Poisson's ratio."""
    material = replace(simulator.material, youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio)
    return simulator.with_material(material)
