"""The dataset file (see datasets/README.md): written atomically, checked when written and read, with hashes."""

import datetime
import hashlib
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rafl.calibration.rig import Rig, parse_calibration, rig_text
from rafl.common.arrays import ArrayFormat, read_arrays
from rafl.common.errors import InputError
from rafl.common.files import find_copies
from rafl.common.hdf5_files import read_hdf5, write_hdf5
from rafl.common.names import require_names
from rafl.common.version import VERSION
from rafl.common.yaml_files import check_format
from rafl.data.dataset import (
    INITIAL_ARRAYS,
    MARKER_ARRAYS,
    MAX_RELATIVE_TIME_ERROR,
    MESH_ARRAYS,
    RECORDING_ARRAYS,
    Dataset,
    Trajectory,
)
from rafl.data.dataset_attributes import (
    FileAttributes,
    MaterialAttributes,
    RecordingAttributes,
    check_attributes,
)
from rafl.data.markers import Markers
from rafl.data.views import VIEW_ARRAYS, View
from rafl.fem.laws import LAWS
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]

FORMAT = "rafl-dataset/4"  # 2: with views; 3: also of a moving clamp; 4: with the covariance of its poses
UNITS = "SI: m, s, kg, N, Pa; specimen frame: origin at a corner of the clamped face, x to the tip, z up"
SPECIMEN_GROUPS = ("mesh", "material", "markers")  # groups that all recordings share
HASH_ATTRIBUTE = "sha256"
CALIBRATION = "calibration"  # of a recording's views: the cameras as in calib.yaml, in the frame of `View`
LABEL, ADVICE = "a dataset written by rafl-capture", "build it again"  # in messages about unreadable files
# Unit and frame of every array, by its name. The hashes cover these texts: changing one breaks updates of older files.
UNITS_AND_FRAMES = {
    "vertices": ("m", "specimen, at rest"),
    "hexes": ("1", "vertices of each cell"),
    "fixed": ("1", "held vertices"),
    "rest": ("m", "specimen, at rest"),
    "quad": ("1", "vertices, anticlockwise from outside"),
    "weights": ("1", "of the quad's vertices"),
    "normal_offset": ("m", "outward normal of the quad"),
    "moved": ("m", "specimen, at rest; from the description"),
    "place_sigma": ("m", "specimen, at rest; one standard deviation"),
    "time": ("s", "from the first frame on"),
    "markers": ("m", "specimen"),
    "valid": ("1", "whether seen"),
    "sigma": ("m", "specimen; one standard deviation"),
    "load": ("N", "specimen; constant, gravity excepted"),
    "added_mass": ("kg", "by vertex"),
    "q": ("m", "specimen; first frame"),
    "v": ("m/s", "specimen; first frame"),
    "virtual_force": ("N", "specimen; first frame"),
    "pixel": ("px", "image; (0, 0) is the centre of its first pixel"),
    "covariance": ("px2", "image"),
    "lag": ("s", "from the row's time on"),
    "rotation": ("1", "calibration to specimen, when the camera measured"),
    "translation": ("m", "specimen"),
    "pose_covariance": ("rad, m", "specimen; of a rotation and a translation applied after these"),
}


def write_dataset(path: str | Path, dataset: Dataset) -> None:
    """Write a dataset file atomically.

    Raises:
        InputError: the name of the specimen or a marker does not suit files, or the file cannot be written.
        ValueError: parts of the dataset are inconsistent.
    """
    path = Path(path)
    dataset.check()
    require_names([dataset.name], "dataset")
    require_names(dataset.markers.names, f"dataset {dataset.name}, markers")
    with write_hdf5(path, read_dataset) as file:
        _write(file, dataset, dataset.recipe)


def update_dataset(path: Path, dataset: Dataset) -> None:
    """Add a dataset's recordings to a file. They replace recordings of the same name; the others do not change.

    Raises:
        InputError: the file is no dataset, or one of another specimen, frame rate or time integration, or somebody
            else changes it at the same time.
        ValueError: parts of the dataset are inconsistent.
    """
    version = _version(path)
    earlier = read_dataset(path)
    own, other = earlier.simulator, dataset.simulator
    if abs(other.time_step / own.time_step - 1.0) > MAX_RELATIVE_TIME_ERROR:
        raise InputError(
            f"expected recordings of {1 / own.time_step:.2f} frames/s as in {path}, found {1 / other.time_step:.2f}; "
            "write them to another dataset"
        )
    for key in ("gravity", "integrator", "substeps"):
        if getattr(own, key) != getattr(other, key):
            raise InputError(
                f"expected {key} {getattr(own, key)} as in {path}, found {getattr(other, key)}; build the whole "
                "dataset again, without --update"
            )
    dataset = replace(dataset, simulator=replace(other, time_step=own.time_step))
    dataset.check()
    with write_hdf5(path, read_dataset) as file, read_hdf5(path, LABEL, ADVICE) as old:
        _write(file, dataset, f"{earlier.recipe}\n# then\n{dataset.recipe}")
        for part in SPECIMEN_GROUPS:
            if file[part].attrs[HASH_ATTRIBUTE] != _digest(old[part]):
                raise InputError(
                    f"expected a dataset of the same specimen in {path}, found another {part}; build the whole "
                    "dataset again, without --update"
                )
        for name in earlier.trajectories:
            if name not in dataset.trajectories:
                old.copy(f"trajectories/{name}", file["trajectories"], name)
        if _version(path) != version:
            raise InputError(
                f"expected {path} as this command has read it, found that another one has changed it since; run this "
                "one again"
            )


def _version(path: Path) -> tuple[int, int]:
    """What changes if a file is replaced or written; zeros if there is none."""
    state = path.stat() if path.exists() else None
    return (state.st_ino, state.st_mtime_ns) if state else (0, 0)


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
    _write_array(file, "mesh/vertices", simulator.mesh.vertices)
    _write_array(file, "mesh/hexes", simulator.mesh.hexes)
    _write_array(file, "mesh/fixed", simulator.fixed)
    # Files of materials without branches stay as they were before there were branches, so that they can be updated.
    file.create_group("material").attrs.update({key: x for key, x in vars(simulator.material).items() if x != ()})
    for key in MARKER_ARRAYS:
        if getattr(markers, key) is not None:
            _write_array(file, f"markers/{key}", getattr(markers, key))
    file["markers/names"] = np.array(markers.names, dtype=h5py.string_dtype())
    file.create_group("trajectories")
    for name, item in dataset.trajectories.items():
        for key in RECORDING_ARRAYS:
            _write_array(file, f"trajectories/{name}/{key}", getattr(item, key))
        for key in INITIAL_ARRAYS:
            _write_array(file, f"trajectories/{name}/initial/{key}", getattr(item, key))
        for camera, view in item.views.items():
            for key in (key for key in VIEW_ARRAYS if getattr(view, key) is not None):
                _write_array(file, f"trajectories/{name}/views/{camera}/{key}", getattr(view, key))
        if item.views:
            rig = Rig({camera: view.camera for camera, view in item.views.items()})
            file[f"trajectories/{name}/views"].attrs[CALIBRATION] = rig_text(rig)
        file[f"trajectories/{name}"].attrs.update({"split": item.split, **item.attributes})
    for group in (*(file[part] for part in SPECIMEN_GROUPS), *file["trajectories"].values()):
        group.attrs[HASH_ATTRIBUTE] = _digest(group)
    file.attrs[HASH_ATTRIBUTE] = _digest(file, deep=False)


def _write_array(file: h5py.File, key: str, value: Array) -> None:
    written = file.create_dataset(
        key, data=value, fletcher32=value.size > 0, chunks=value.shape if value.size else None
    )
    written.attrs["unit"], written.attrs["frame"] = UNITS_AND_FRAMES[key.rpartition("/")[2]]


def _digest(group: h5py.Group, deep: bool = True) -> str:
    """SHA-256 of a group's attributes and, if `deep`, of everything in it."""
    digest = hashlib.sha256()

    def add(name: str, value: Any) -> None:
        array = np.asarray(value)
        content = array.tobytes() if array.dtype.kind in "biuf" else repr(array.astype(str).tolist()).encode()
        digest.update(f"{name} {array.dtype.kind}{array.dtype.itemsize} {array.shape} ".encode() + content)

    def visit(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            add(name, item.asstr()[()] if item.dtype.kind == "O" else item[()])
        for key in sorted(item.attrs):
            if key != HASH_ATTRIBUTE:
                add(f"{name}.{key}", item.attrs[key])

    visit("", group)
    if deep:
        group.visititems(visit)
    return digest.hexdigest()


def damaged_parts(path: Path) -> list[str]:
    """Names of the groups of a dataset file that cannot be read or whose content does not match their hash.

    Raises:
        InputError: no dataset file, or one without hashes.
    """
    damaged = []
    with read_hdf5(path, LABEL, ADVICE) as file:
        check_format(str(file.attrs.get("format", "")), FORMAT, path)
        for name in ("/", *SPECIMEN_GROUPS, *(f"trajectories/{name}" for name in file["trajectories"])):
            if HASH_ATTRIBUTE not in file[name].attrs:
                raise InputError(f"expected hashes in {path}, found none for {name}; build it again")
            try:
                intact = file[name].attrs[HASH_ATTRIBUTE] == _digest(file[name], deep=name != "/")
            except OSError:  # HDF5 verifies a checksum of its own
                intact = False
            if not intact:
                damaged.append(name)
    return damaged


def read_dataset(path: str | Path) -> Dataset:
    """Read and check a dataset file.

    Raises:
        InputError: no such file, not a dataset, a newer version, a missing, damaged or inconsistent part, or a material
            whose law is not registered.
    """
    path = Path(path)
    with read_hdf5(path, LABEL, ADVICE) as file:
        check_format(str(file.attrs.get("format", "")), FORMAT, path)
        dataset = _read(file)
        dataset.check()
        dataset.check_mechanics()
    if not dataset.trajectories:
        raise InputError(f"expected at least one trajectory in {path}, found none; run rafl-capture again")
    return dataset


def read_datasets(paths: list[Path]) -> list[Dataset]:
    """Read and check several dataset files. Those of one specimen are named after their files, to tell them apart.

    Raises:
        InputError: two hold the same, or have the same file name too, or as `read_dataset` says.
    """
    datasets = [read_dataset(path) for path in paths]
    if copies := find_copies(paths):
        raise InputError(
            f"expected each dataset once, found {copies[0]} in {copies[1]} again, whose recordings would count twice; "
            "name one of them"
        )
    count = Counter(dataset.name for dataset in datasets)
    datasets = [
        replace(dataset, name=path.stem) if count[dataset.name] > 1 else dataset
        for path, dataset in zip(paths, datasets, strict=True)
    ]
    name, number = Counter(dataset.name for dataset in datasets).most_common(1)[0]
    if number > 1:
        raise InputError(f"expected datasets of different names, found {name} {number} times; rename their files")
    return datasets


def _read(file: h5py.File) -> Dataset:
    _check_units(file)
    material = _attributes(file["material"])
    check_attributes(MaterialAttributes, material, "material")
    if material["law"] not in tuple(LAWS):
        raise InputError(
            f"expected one of the laws {', '.join(LAWS)} in {file.filename}, found {material['law']!r}; "
            "register it first, in Python, with rafl.register_law"
        )
    about = FileAttributes.model_validate(_attributes(file))
    lengths: dict[str, int] = {}
    mesh = read_arrays(file["mesh"], MESH_ARRAYS, lengths, "mesh/")
    simulator = Simulator(
        HexMesh(mesh["vertices"], mesh["hexes"]),
        Material(**material),
        mesh["fixed"],
        about.time_step,
        about.gravity,
        about.integrator,
        about.substeps,
    )
    arrays = {"names": ArrayFormat(("M",), "text")} | MARKER_ARRAYS
    markers = Markers(**read_arrays(file["markers"], arrays, lengths, "markers/"))
    trajectories = {
        name: _read_trajectory(group, {**lengths}, f"trajectories/{name}/")
        for name, group in file.get("trajectories", {}).items()
    }
    return Dataset(about.name, simulator, markers, trajectories, about.recipe)


def _check_units(file: h5py.File) -> None:
    """Raise ValueError if a unit is stated that is not that of the format. Those that are not stated are not missed."""
    if (found := str(file.attrs.get("units", UNITS))) != UNITS:
        raise ValueError(f"units: expected {UNITS!r}, found {found!r:.80}")

    def check(name: str, item: h5py.Dataset | h5py.Group) -> None:
        expected, _ = UNITS_AND_FRAMES.get(name.rpartition("/")[2], ("", ""))
        if expected and (found := str(item.attrs.get("unit", expected))) != expected:
            raise ValueError(f"{name}, unit: expected {expected!r}, found {found!r:.80}")

    file.visititems(check)


def _read_trajectory(group: h5py.Group, lengths: dict[str, int], label: str) -> Trajectory:
    attributes = _attributes(group)
    check_attributes(RecordingAttributes, attributes, label[:-1])
    if (found := len(attributes.get("fit_sigma_mm", ()))) not in (0, lengths["M"]):
        raise ValueError(f"{label[:-1]}, fit_sigma_mm: expected {lengths['M']} numbers, one a marker, found {found}")
    return Trajectory(
        **read_arrays(group, RECORDING_ARRAYS, lengths, label),
        **read_arrays(group["initial"], INITIAL_ARRAYS, lengths, f"{label}initial/"),
        split=attributes.pop("split"),
        attributes=attributes,
        views=_read_views(group["views"], lengths, f"{label}views") if "views" in group else {},
    )


def _read_views(group: h5py.Group, lengths: dict[str, int], label: str) -> dict[str, View]:
    """The views of a recording, by camera."""
    if not isinstance(group, h5py.Group) or CALIBRATION not in group.attrs:
        raise ValueError(f"{label}: expected a group with the attribute {CALIBRATION}, found none")
    try:
        rig = parse_calibration(str(group.attrs[CALIBRATION]), Path(group.file.filename))
    except InputError as error:
        raise InputError(f"{label}, {CALIBRATION}: {error}") from None
    if set(rig.cameras) != set(group):
        raise ValueError(f"{label}: expected the cameras {', '.join(rig.cameras)}, found {', '.join(group) or 'none'}")
    return {
        name: View(camera, **read_arrays(group[name], VIEW_ARRAYS, lengths, f"{label}/{name}/"))
        for name, camera in rig.cameras.items()
    }


def _attributes(group: h5py.Group) -> dict[str, Any]:
    """A group's attributes but its hash, as Python values."""
    found = {key: value for key, value in group.attrs.items() if key != HASH_ATTRIBUTE}
    return {key: _python_value(value) for key, value in found.items()}


def _python_value(value: Any) -> Any:
    """A number, text, or tuple of numbers."""
    if isinstance(value, np.ndarray):
        return tuple(value.tolist())
    return value.item() if isinstance(value, np.generic) else value
