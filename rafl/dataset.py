"""The dataset file: one specimen's mesh, markers and recorded trajectories (see datasets/README.md)."""

import datetime
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from numpy.typing import NDArray

from groundwork import VERSION, InputError, check_format, require_file, whole_file
from rafl.markers import Markers
from rafl.material import Material
from rafl.mesh import HexMesh
from rafl.rollout import Start
from rafl.simulator import Simulator

Array = NDArray[Any]

FORMAT = "rafl-dataset/1"
SPLITS = ("train", "val", "test")
UNITS = "SI: m, s, kg, N, Pa; specimen frame: origin at a corner of the clamped face, x to the tip, z up"


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


def write_dataset(path: Path, dataset: Dataset) -> None:
    """Write a dataset file, whole or not at all, with checksums on every array."""
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(
            {
                "format": FORMAT,
                "name": dataset.name,
                "units": UNITS,
                "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                "software": f"rafl {VERSION}",
                "recipe": dataset.recipe,
                "time_step": dataset.simulator.time_step,
                "gravity": dataset.simulator.gravity,
                "integrator": dataset.simulator.integrator,
                "substeps": dataset.simulator.substeps,
            }
        )
        mesh, material, markers = dataset.simulator.mesh, dataset.simulator.material, dataset.markers
        _put(file, "mesh/vertices", mesh.vertices)
        _put(file, "mesh/hexes", mesh.hexes)
        _put(file, "mesh/fixed", dataset.simulator.fixed)
        file.create_group("material").attrs.update(vars(material))
        for key in ("rest", "quad", "weights", "normal_offset"):
            _put(file, f"markers/{key}", getattr(markers, key))
        file["markers/names"] = np.array(markers.names, dtype=h5py.string_dtype())
        for name, item in dataset.trajectories.items():
            for key in ("time", "markers", "valid", "sigma", "load", "added_mass"):
                _put(file, f"trajectories/{name}/{key}", getattr(item, key))
            for key in ("q", "v", "virtual_force"):
                _put(file, f"trajectories/{name}/initial/{key}", getattr(item, key))
            file[f"trajectories/{name}"].attrs.update({"split": item.split, **item.attributes})


def _put(file: h5py.File, key: str, value: NDArray) -> None:
    file.create_dataset(key, data=value, fletcher32=value.size > 0, chunks=value.shape if value.size else None)


def read_dataset(path: Path) -> Dataset:
    """Read and check a dataset file.

    Raises:
        InputError: no such file, not a dataset, a newer version, or a part missing or damaged.
    """
    require_file(path, "a dataset (.h5)")
    try:
        with h5py.File(path, "r") as file:
            check_format(str(file.attrs.get("format", "")), FORMAT, path)
            dataset = _read(file)
    except (OSError, KeyError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"expected a dataset written by rafl-capture in {path}, which cannot be read: {reason}; build it again"
        ) from None
    if not dataset.trajectories:
        raise InputError(f"expected at least one trajectory in {path}, found none; run rafl-capture again")
    return dataset


def _read(file: h5py.File) -> Dataset:
    mesh = HexMesh(file["mesh/vertices"][()], file["mesh/hexes"][()])
    gx, gy, gz = (float(g) for g in file.attrs["gravity"])
    simulator = Simulator(
        mesh,
        Material(**{key: _plain(value) for key, value in file["material"].attrs.items()}),
        file["mesh/fixed"][()],
        float(file.attrs["time_step"]),
        (gx, gy, gz),
        str(file.attrs.get("integrator", "implicit-euler")),
        int(file.attrs.get("substeps", 1)),
    )
    keys = ("rest", "quad", "weights", "normal_offset")
    names = tuple(name.decode() for name in file["markers/names"][()])
    markers = Markers(names, *(file[f"markers/{key}"][()] for key in keys))
    trajectories = {}
    for name, group in file.get("trajectories", {}).items():
        item = Trajectory(
            **{key: group[key][()] for key in ("time", "markers", "valid", "sigma", "load", "added_mass")},
            **{key: group["initial"][key][()] for key in ("q", "v", "virtual_force")},
            split=str(group.attrs["split"]),
            attributes={key: _plain(value) for key, value in group.attrs.items() if key != "split"},
        )
        frames = (len(item.time), len(names), 3)
        if item.markers.shape != frames or item.q.shape != mesh.vertices.shape:
            raise ValueError(f"trajectory {name} has markers {item.markers.shape}, expected {frames}")
        trajectories[name] = item
    return Dataset(str(file.attrs["name"]), simulator, markers, trajectories, str(file.attrs["recipe"]))


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
