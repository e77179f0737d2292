from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from energies import gent

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import damaged_parts, read_dataset, write_dataset
from rafl.fem.laws import LAWS, register_law


def test_written_dataset_is_read_back_unchanged(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    material = replace(
        dataset.simulator.material,
        viscosity=12.0,
        integration="selective",
        branch_shares=(0.1, 0.2),
        branch_times=(0.01, 0.5),
    )
    simulator = replace(dataset.simulator, material=material, integrator="generalised-alpha", substeps=3)
    dataset = replace(dataset, simulator=simulator)
    write_dataset(path, dataset)
    back = read_dataset(path)
    assert (back.simulator.integrator, back.simulator.substeps) == ("generalised-alpha", 3)
    assert back.name == dataset.name
    assert back.simulator.material == dataset.simulator.material
    assert back.simulator.gravity == dataset.simulator.gravity
    assert back.markers.names == dataset.markers.names
    np.testing.assert_array_equal(back.simulator.mesh.hexes, dataset.simulator.mesh.hexes)
    np.testing.assert_array_equal(back.markers.weights, dataset.markers.weights)
    for name, item in dataset.trajectories.items():
        other = back.trajectories[name]
        for key in ("time", "markers", "valid", "sigma", "q", "v", "virtual_force", "load", "added_mass"):
            np.testing.assert_array_equal(getattr(other, key), getattr(item, key))
        assert other.split == item.split
        assert other.attributes == item.attributes
    assert back.split("train") == ["a", "b"]


def test_newer_format_version_is_refused_by_name(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "rafl-dataset/9"
    with pytest.raises(InputError, match="rafl-dataset/9, newer"):
        read_dataset(path)


def test_damaged_file_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    """A flipped bit in the markers fails the checksum; a truncated file does not open."""
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    content = path.read_bytes()
    pattern = dataset.trajectories["b"].markers.tobytes()[:64]
    offset = content.index(pattern) + 8
    path.write_bytes(content[:offset] + bytes([content[offset] ^ 1]) + content[offset + 1 :])
    with pytest.raises(InputError, match="cannot be read"):
        read_dataset(path)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="cannot be read"):
        read_dataset(path)


def test_law_of_ones_own(dataset: Dataset, tmp_path: Path) -> None:
    """The file stores the name of the law, which must be registered when it is read."""
    register_law("gent", gent)
    simulator = replace(dataset.simulator, material=replace(dataset.simulator.material, law="gent"))
    path = tmp_path / "dataset.h5"
    write_dataset(path, replace(dataset, simulator=simulator))
    assert read_dataset(path).simulator.material == simulator.material
    del LAWS["gent"]
    with pytest.raises(InputError, match=r"laws projective, .* in .*dataset.h5, found 'gent'; register it first"):
        read_dataset(path)
    assert damaged_parts(path) == []


def test_empty_dataset_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with pytest.raises(InputError, match=r"not written, .* at least one trajectory"):
        write_dataset(path, Dataset(dataset.name, dataset.simulator, dataset.markers, {}))
    write_dataset(path, dataset)
    with h5py.File(path, "r+") as file:
        del file["trajectories/a"], file["trajectories"]
    with pytest.raises(InputError, match="at least one trajectory"):
        read_dataset(path)


def test_file_that_could_not_be_read_keeps_the_earlier_one(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    before = path.read_bytes()
    for name in ("day1/load060g", "..", "", "a\nb", "x" * 200):
        with pytest.raises(ValueError, match="recordings: expected a name"):
            write_dataset(path, replace(dataset, trajectories={name: dataset.trajectories["a"]}))
    with pytest.raises(InputError, match=r"not written, .* at least one trajectory"):
        write_dataset(path, replace(dataset, trajectories={}))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


DAMAGE: dict[str, tuple[str, Callable[[h5py.File], object]]] = {
    "hexes as numbers with fractions": (
        "mesh/hexes: expected elements of type integer, found float64",
        lambda file: replace_array(file, "mesh/hexes", file["mesh/hexes"][()].astype(float)),
    ),
    "inverted cell": (
        "cell [0-9]+ is inverted",
        lambda file: file["mesh/hexes"].write_direct(file["mesh/hexes"][()][:, ::-1].copy()),
    ),
    "text for numbers": (
        "markers/normal_offset: expected elements of type number",
        lambda file: replace_array(file, "markers/normal_offset", np.array(["left"] * 20, dtype="S4")),
    ),
    "missing values": (
        "markers/weights: expected finite numbers, found nan",
        lambda file: replace_array(file, "markers/weights", np.full((20, 4), np.nan)),
    ),
    "nothing seen": (
        "valid: expected a marker that is seen",
        lambda file: replace_array(file, "trajectories/a/valid", np.zeros((25, 20), dtype=bool)),
    ),
    "short array": (
        r"load: expected shape \(63, 3\), found \(62, 3\)",
        lambda file: replace_array(file, "trajectories/a/load", np.zeros((62, 3))),
    ),
    "missing array": ("expected the array mesh/fixed, found none", lambda file: file.pop("mesh/fixed")),
    "group for an array": ("expected an array, found a group", lambda file: make_group(file, "mesh/fixed")),
    "array for a group": ("cannot be read", lambda file: replace_array(file, "material", np.zeros(3))),
    "hostile name": (
        "recordings: expected a name",
        lambda file: file.move("trajectories/a", "trajectories/a\n"),
    ),
    "text for a number in an attribute": ("time_step: Input", lambda file: file.attrs.update({"time_step": "fast"})),
    "infinite stiffness": ("finite", lambda file: file["material"].attrs.modify("youngs_modulus", np.inf)),
    "damping that is no number": ("finite", lambda file: file["material"].attrs.modify("viscosity", np.nan)),
    "unknown property": (
        "material, colour: Extra inputs are not permitted, found 'red'",
        lambda file: file["material"].attrs.modify("colour", "red"),
    ),
    "text for a stiffness": (
        "material, youngs_modulus: Input should be a valid number, found 'soft'",
        lambda file: file["material"].attrs.create("youngs_modulus", "soft"),
    ),
    "several stiffnesses": (
        r"material, youngs_modulus: Input should be a valid number, found \(1.0, 1.0\)",
        lambda file: file["material"].attrs.create("youngs_modulus", np.ones(2)),
    ),
    "all vertices fixed": (
        "mesh/fixed: expected some vertices that move",
        lambda file: replace_array(file, "mesh/fixed", np.arange(63)),
    ),
    "no vertices fixed": (
        "mesh/fixed: expected 3 vertices or more, not on one line",
        lambda file: replace_array(file, "mesh/fixed", np.zeros(0, dtype=int)),
    ),
    "a line of vertices fixed": (
        "mesh/fixed: expected 3 vertices or more, not on one line",
        lambda file: replace_array(file, "mesh/fixed", np.arange(3)),
    ),
    "vertices fixed twice": (
        "mesh/fixed: expected every vertex once",
        lambda file: replace_array(file, "mesh/fixed", np.zeros(9, dtype=int)),
    ),
    "cells twice": (
        "mesh/hexes: expected every cell once",
        lambda file: replace_array(file, "mesh/hexes", np.concatenate([file["mesh/hexes"][()]] * 2)),
    ),
    "first state of no extent": (
        "trajectories/a/initial/q: expected cells of more than 0.01 of their volume at rest, found 0 of cell 0",
        lambda file: file["trajectories/a/initial/q"].write_direct(np.zeros((63, 3))),
    ),
    "inverted first state": (
        "trajectories/a/initial/q: expected cells .* found -1 of cell",
        lambda file: file["trajectories/a/initial/q"].write_direct(file["mesh/vertices"][()] * [1.0, 1.0, -1.0]),
    ),
    "first state in mm": (
        "trajectories/a/initial/q: expected edges that change by less than 30 times",
        lambda file: file["trajectories/a/initial/q"].write_direct(1e3 * file["trajectories/a/initial/q"][()]),
    ),
    "another unit": (
        "mesh/vertices, unit: expected 'm', found 'mm'",
        lambda file: file["mesh/vertices"].attrs.modify("unit", "mm"),
    ),
    "other units": ("units: expected 'SI: m, .*, found 'mm'", lambda file: file.attrs.modify("units", "mm")),
    "text for sigmas": (
        "trajectories/a, fit_sigma_mm: Input should be a valid tuple, found '<b>'",
        lambda file: file["trajectories/a"].attrs.modify("fit_sigma_mm", "<b>"),
    ),
    "one sigma": (
        "trajectories/a, fit_sigma_mm: Input should be a valid tuple, found 3.0",
        lambda file: file["trajectories/a"].attrs.modify("fit_sigma_mm", 3.0),
    ),
    "too few sigmas": (
        "trajectories/a, fit_sigma_mm: expected 20 numbers",
        lambda file: file["trajectories/a"].attrs.modify("fit_sigma_mm", np.full(3, np.nan)),
    ),
    "newer version": ("newer", lambda file: file.attrs.modify("format", "rafl-dataset/7")),
}


def replace_array(file: h5py.File, key: str, value: np.ndarray) -> None:
    del file[key]
    file[key] = value


def make_group(file: h5py.File, key: str) -> None:
    del file[key]
    file.create_group(key)


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_part_is_named(dataset: Dataset, tmp_path: Path, name: str) -> None:
    message, damage = DAMAGE[name]
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(InputError, match=message) as error:
        read_dataset(path)
    assert "\n" not in str(error.value)


def test_changed_arrays_and_attributes_are_found(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    assert damaged_parts(path) == []
    with h5py.File(path, "r+") as file:
        file["trajectories/b/initial/q"][3, 1] += 1e-9
        file["trajectories/c"].attrs["load_g"] = 71.0
        file["material"].attrs["poissons_ratio"] = 0.44
        file.attrs["time_step"] = 0.02
    assert damaged_parts(path) == ["/", "material", "trajectories/b", "trajectories/c"]
    with h5py.File(path, "r+") as file:
        del file["mesh"].attrs["sha256"]
    with pytest.raises(InputError, match="found none for mesh"):
        damaged_parts(path)


def test_every_array_has_a_unit_and_a_frame(dataset: Dataset, tmp_path: Path) -> None:
    write_dataset(tmp_path / "a.h5", dataset)
    missing = []

    def check(name: str, item: h5py.Group | h5py.Dataset) -> None:
        numeric = isinstance(item, h5py.Dataset) and name != "markers/names"
        if numeric and not (item.attrs["unit"] and item.attrs["frame"]):
            missing.append(name)

    with h5py.File(tmp_path / "a.h5") as file:
        file.visititems(check)
        assert file["trajectories/a/initial/v"].attrs["unit"] == "m/s"
    assert missing == []


def test_units_that_older_files_do_not_state_are_not_missed(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    with h5py.File(path, "r+") as file:
        del file.attrs["units"], file["mesh/vertices"].attrs["unit"]
    np.testing.assert_array_equal(read_dataset(path).simulator.mesh.vertices, dataset.simulator.mesh.vertices)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("time", np.arange(25) ** 1.1 * 0.01, "time: expected two or more even times"),
        ("sigma", np.zeros((25, 20, 3)), "sigma: expected more than 0"),
        ("markers", np.full((25, 20, 3), np.nan), "markers: expected finite positions"),
        ("q", np.zeros((3, 3)), r"q: expected shape \(63, 3\)"),
        ("v", np.full((63, 3), np.inf), "v: expected finite"),
        ("split", "training", "split: expected train, val, test"),
    ],
)
def test_inconsistent_parts_are_neither_written_nor_read(
    dataset: Dataset, tmp_path: Path, key: str, value: object, message: str
) -> None:
    path = tmp_path / "a.h5"
    bad = replace(dataset, trajectories={"a": replace(dataset.trajectories["a"], **{key: value})})
    with pytest.raises(ValueError, match=message):
        write_dataset(path, bad)
    assert not path.exists()
    write_dataset(path, dataset)
    with h5py.File(path, "r+") as file:
        group = "trajectories/a/initial" if key in ("q", "v") else "trajectories/a"
        if key == "split":
            file[group].attrs[key] = value
        else:
            del file[group][key]
            file[group][key] = value
    with pytest.raises(InputError, match=message):
        read_dataset(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [("load_g", True), ("load_g", -1.0), ("first_frame", 1.5), ("bend_modulus", 0.0), ("swing_modulus", np.inf)],
)
def test_attributes_that_are_no_such_numbers_are_refused(
    dataset: Dataset, tmp_path: Path, key: str, value: object
) -> None:
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    with h5py.File(path, "r+") as file:
        file["trajectories/a"].attrs["bend_modulus"] = np.nan
    read_dataset(path)
    with h5py.File(path, "r+") as file:
        file["trajectories/a"].attrs[key] = value
    with pytest.raises(InputError, match=f"which cannot be read: trajectories/a, {key}: "):
        read_dataset(path)
