"""One specimen's mesh, markers and recorded trajectories."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.data.markers import Markers
from rafl.simulation.rollout import Start
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]

SPLITS = ("train", "val", "test")
UNEVEN = 5e-3  # of the time step: how far times may be from their grid, and time steps from another


@dataclass(frozen=True)
class Trajectory:
    """One recording on the specimen's markers, in the specimen frame.

    Attributes:
        time: [s], (T).
        markers: positions [m], (T, M, 3), NaN where not valid.
        valid: (T, M).
        sigma: one standard deviation [m], (T, M, 3); infinite where an axis was not observed.
        q, v: initial mesh positions [m] and velocities [m/s], (N, 3).
        virtual_force: nodal forces that hold the first frame, gone once released [N], (N, 3).
        load: constant nodal forces during the motion, gravity excepted [N], (N, 3).
        added_mass: hung-on mass that swings along [kg], (N).
        split: `train`, `val` or `test`.
        attributes: load_g, registration, fit residual, sources: plain values for the file's reader.
    """

    time: Array
    markers: Array
    valid: NDArray[np.bool_]
    sigma: Array
    q: Array
    v: Array
    virtual_force: Array
    load: Array
    added_mass: Array
    split: str
    attributes: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Dataset:
    """One specimen and its recordings.

    Attributes:
        name: of the specimen.
        simulator: mesh, assumed material, held nodes and time step.
        markers: tied to the mesh.
        trajectories: by recording.
        recipe: text of the files it was built from.
    """

    name: str
    simulator: Simulator
    markers: Markers
    trajectories: dict[str, Trajectory]
    recipe: str = ""

    def split(self, name: str) -> list[str]:
        """Recordings of a split, in order."""
        return [key for key, item in self.trajectories.items() if item.split == name]

    def start(self, recordings: list[str]) -> Start:
        """Initial states and loads of some recordings as one batch."""
        chosen = [self.trajectories[name] for name in recordings]
        return Start(
            torch.from_numpy(np.stack([item.q for item in chosen])),
            torch.from_numpy(np.stack([item.v for item in chosen])),
            torch.from_numpy(np.stack([item.load for item in chosen])),
            torch.from_numpy(np.stack([item.added_mass for item in chosen])),
            tuple(recordings),
        )

    def check(self) -> None:
        """That all parts fit together.

        Raises:
            ValueError: one that does not; names it.
        """
        mesh, nodes = self.simulator.mesh, len(self.simulator.mesh.vertices)
        _require(bool(np.isfinite(mesh.vertices).all()), "mesh/vertices", "finite numbers")
        _require(_indices(mesh.hexes, nodes), "mesh/hexes", f"vertices from 0 to {nodes - 1}")
        _require(_indices(self.simulator.fixed, nodes), "mesh/fixed", f"vertices from 0 to {nodes - 1}")
        _require(_indices(self.markers.quad, nodes), "markers/quad", f"vertices from 0 to {nodes - 1}")
        off = np.abs(self.markers.weights.sum(axis=1) - 1.0)
        _require(bool((off < 1e-9).all()), "markers/weights", "weights that add up to 1")
        for name, item in self.trajectories.items():
            self._check_trajectory(f"trajectories/{name}", item)

    def _check_trajectory(self, where: str, item: Trajectory) -> None:
        nodes, frames, count = len(self.simulator.mesh.vertices), len(item.time), len(self.markers.names)
        shapes = {"markers": (frames, count, 3), "valid": (frames, count), "sigma": (frames, count, 3)}
        shapes |= dict.fromkeys(("q", "v", "virtual_force", "load"), (nodes, 3)) | {"added_mass": (nodes,)}
        for key, shape in shapes.items():
            value = getattr(item, key)
            _require(value.shape == shape, f"{where}/{key}", f"shape {shape}, found {value.shape}")
            if key not in ("markers", "valid", "sigma"):
                _require(bool(np.isfinite(value).all()), f"{where}/{key}", "finite numbers")
        grid = self.simulator.time_step * np.arange(frames)
        even = np.abs(item.time - grid) <= UNEVEN * self.simulator.time_step * np.maximum(np.arange(frames), 1)
        _require(frames > 1 and bool(even.all()), f"{where}/time", "two or more even times from 0 on")
        seen = item.markers[item.valid]
        _require(bool(np.isfinite(seen).all()), f"{where}/markers", "finite positions where valid")
        _require(bool((item.sigma[item.valid] > 0).all()), f"{where}/sigma", "more than 0 where valid")
        _require(item.split in SPLITS, f"{where}, split", f"{', '.join(SPLITS)}, found {item.split!r}")


def _require(holds: bool, where: str, what: str) -> None:
    if not holds:
        raise ValueError(f"{where}: expected {what}")


def _indices(values: NDArray[np.int64], count: int) -> bool:
    return bool(((values >= 0) & (values < count)).all())
