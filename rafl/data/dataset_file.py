"""The dataset file (see datasets/README.md): written whole, checked on the way in and out, with hashes."""

import datetime
import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.common.files import require_file, whole_file
from rafl.common.version import VERSION
from rafl.common.yaml_files import check_format
from rafl.data.dataset import UNEVEN, Dataset, Trajectory
from rafl.data.markers import Markers
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.simulator import Simulator

FORMAT = "rafl-dataset/1"
UNITS = "SI: m, s, kg, N, Pa; specimen frame: origin at a corner of the clamped face, x to the tip, z up"
SPECIMEN = ("mesh", "material", "markers")  # groups that all recordings share
HASH = "sha256"
# Unit and frame of every array, by its name.
MEANING = {
    "vertices": ("m", "specimen, at rest"),
    "hexes": ("1", "vertices of each cell"),
    "fixed": ("1", "held vertices"),
    "rest": ("m", "specimen, at rest"),
    "quad": ("1", "vertices, anticlockwise from outside"),
    "weights": ("1", "of the quad's vertices"),
    "normal_offset": ("m", "outward normal of the quad"),
    "time": ("s", "from the first frame on"),
    "markers": ("m", "specimen"),
    "valid": ("1", "whether seen"),
    "sigma": ("m", "specimen; one standard deviation"),
    "load": ("N", "specimen; constant, gravity excepted"),
    "added_mass": ("kg", "by vertex"),
    "q": ("m", "specimen; first frame"),
    "v": ("m/s", "specimen; first frame"),
    "virtual_force": ("N", "specimen; first frame"),
}


def write_dataset(path: Path, dataset: Dataset) -> None:
    """Write a dataset file, whole or not at all.

    Raises:
        ValueError: parts that do not fit together.
    """
    dataset.check()
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        _write(file, dataset, dataset.recipe)


def update_dataset(path: Path, dataset: Dataset) -> None:
    """Add a dataset's recordings to a file, in the place of those of the same name; the others stay as they are.

    Raises:
        InputError: no dataset there, or one of another specimen.
        ValueError: parts that do not fit together.
    """
    earlier = read_dataset(path)
    own, other = earlier.simulator, dataset.simulator
    if abs(other.time_step / own.time_step - 1.0) > UNEVEN:
        raise InputError(
            f"expected recordings of {1 / own.time_step:.2f} frames/s as in {path}, found {1 / other.time_step:.2f}; "
            "put them into another dataset"
        )
    for key in ("gravity", "integrator", "substeps"):
        if getattr(own, key) != getattr(other, key):
            raise InputError(
                f"expected {key} {getattr(own, key)} as in {path}, found {getattr(other, key)}; build it whole, "
                "without --update"
            )
    dataset = replace(dataset, simulator=replace(other, time_step=own.time_step))
    dataset.check()
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file, h5py.File(path, "r") as old:
        _write(file, dataset, f"{earlier.recipe}\n# then\n{dataset.recipe}")
        for part in SPECIMEN:
            if file[part].attrs[HASH] != _digest(old[part]):
                raise InputError(
                    f"expected a dataset of the same specimen in {path}, found another {part}; build it whole, "
                    "without --update"
                )
        for name in earlier.trajectories:
            if name not in dataset.trajectories:
                old.copy(f"trajectories/{name}", file["trajectories"], name)


def _write(file: h5py.File, dataset: Dataset, recipe: str) -> None:
    simulator, markers = dataset.simulator, dataset.markers
    file.attrs.update(
        {
            "format": FORMAT,
            "name": dataset.name,
            "units": UNITS,
            "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "software": f"rafl {VERSION}",
            "recipe": recipe,
            "time_step": simulator.time_step,
            "gravity": simulator.gravity,
            "integrator": simulator.integrator,
            "substeps": simulator.substeps,
        }
    )
    _put(file, "mesh/vertices", simulator.mesh.vertices)
    _put(file, "mesh/hexes", simulator.mesh.hexes)
    _put(file, "mesh/fixed", simulator.fixed)
    file.create_group("material").attrs.update(vars(simulator.material))
    for key in ("rest", "quad", "weights", "normal_offset"):
        _put(file, f"markers/{key}", getattr(markers, key))
    file["markers/names"] = np.array(markers.names, dtype=h5py.string_dtype())
    file.create_group("trajectories")
    for name, item in dataset.trajectories.items():
        for key in ("time", "markers", "valid", "sigma", "load", "added_mass"):
            _put(file, f"trajectories/{name}/{key}", getattr(item, key))
        for key in ("q", "v", "virtual_force"):
            _put(file, f"trajectories/{name}/initial/{key}", getattr(item, key))
        file[f"trajectories/{name}"].attrs.update({"split": item.split, **item.attributes})
    for group in (*(file[part] for part in SPECIMEN), *file["trajectories"].values()):
        group.attrs[HASH] = _digest(group)
    file.attrs[HASH] = _digest(file, deep=False)


def _put(file: h5py.File, key: str, value: NDArray) -> None:
    made = file.create_dataset(key, data=value, fletcher32=value.size > 0, chunks=value.shape if value.size else None)
    made.attrs["unit"], made.attrs["frame"] = MEANING[key.rpartition("/")[2]]


def _digest(group: h5py.Group, deep: bool = True) -> str:
    """SHA-256 of a group's attributes and, where `deep`, of all arrays in it."""
    digest = hashlib.sha256()

    def add(name: str, value: Any) -> None:
        array = np.asarray(value)
        content = array.tobytes() if array.dtype.kind in "biuf" else repr(array.astype(str).tolist()).encode()
        digest.update(f"{name} {array.dtype.kind}{array.dtype.itemsize} {array.shape} ".encode() + content)

    def visit(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            add(name, item.asstr()[()] if item.dtype.kind == "O" else item[()])
        for key in sorted(item.attrs):
            if key != HASH:
                add(f"{name}.{key}", item.attrs[key])

    visit("", group)
    if deep:
        group.visititems(visit)
    return digest.hexdigest()


def damaged_parts(path: Path) -> list[str]:
    """Parts of a dataset file whose content is not what its hash says, or cannot be read.

    Raises:
        InputError: no dataset file, or one without hashes.
    """
    require_file(path, "a dataset (.h5)")
    found = []
    try:
        with h5py.File(path, "r") as file:
            check_format(str(file.attrs.get("format", "")), FORMAT, path)
            for name in ("/", *SPECIMEN, *(f"trajectories/{name}" for name in file["trajectories"])):
                if HASH not in file[name].attrs:
                    raise InputError(f"expected hashes in {path}, found none for {name}; build it again")
                try:
                    whole = file[name].attrs[HASH] == _digest(file[name], deep=name != "/")
                except OSError:  # a checksum of HDF5 itself
                    whole = False
                if not whole:
                    found.append(name)
    except (OSError, KeyError, RuntimeError) as error:
        raise _unreadable(path, error) from None
    return found


def _unreadable(path: Path, error: Exception) -> InputError:
    reason = " ".join(str(error).split())
    return InputError(
        f"expected a dataset written by rafl-capture in {path}, which cannot be read: {reason}; build it again"
    )


def read_dataset(path: Path) -> Dataset:
    """Read and check a dataset file.

    Raises:
        InputError: no such file, not a dataset, a newer version, or a part missing, damaged or unfit.
    """
    require_file(path, "a dataset (.h5)")
    try:
        with h5py.File(path, "r") as file:
            check_format(str(file.attrs.get("format", "")), FORMAT, path)
            dataset = _read(file)
        dataset.check()
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise _unreadable(path, error) from None
    if not dataset.trajectories:
        raise InputError(f"expected at least one trajectory in {path}, found none; run rafl-capture again")
    return dataset


def _read(file: h5py.File) -> Dataset:
    gx, gy, gz = (float(g) for g in file.attrs["gravity"])
    material = {key: _plain(value) for key, value in file["material"].attrs.items() if key != HASH}
    simulator = Simulator(
        HexMesh(file["mesh/vertices"][()], file["mesh/hexes"][()]),
        Material(**material),
        file["mesh/fixed"][()],
        float(file.attrs["time_step"]),
        (gx, gy, gz),
        str(file.attrs.get("integrator", "implicit-euler")),
        int(file.attrs.get("substeps", 1)),
    )
    keys = ("rest", "quad", "weights", "normal_offset")
    names = tuple(name.decode() for name in file["markers/names"][()])
    markers = Markers(names, *(file[f"markers/{key}"][()] for key in keys))
    trajectories = {
        name: Trajectory(
            **{key: group[key][()] for key in ("time", "markers", "valid", "sigma", "load", "added_mass")},
            **{key: group["initial"][key][()] for key in ("q", "v", "virtual_force")},
            split=str(group.attrs["split"]),
            attributes={key: _plain(value) for key, value in group.attrs.items() if key not in ("split", HASH)},
        )
        for name, group in file.get("trajectories", {}).items()
    }
    return Dataset(str(file.attrs["name"]), simulator, markers, trajectories, str(file.attrs["recipe"]))


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
