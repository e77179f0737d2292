from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from groundwork import InputError
from rafl.dataset import Dataset, read_dataset, write_dataset


def test_round_trip(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    material = replace(dataset.simulator.material, viscosity=12.0, integration="selective")
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


def test_a_newer_version_is_refused_by_name(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "rafl-dataset/9"
    with pytest.raises(InputError, match="rafl-dataset/9, newer"):
        read_dataset(path)


def test_damage_is_noticed(dataset: Dataset, tmp_path: Path) -> None:
    """A flipped byte in the markers fails its checksum; a cut file does not open."""
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    content = path.read_bytes()
    needle = dataset.trajectories["b"].markers.tobytes()[:64]
    place = content.index(needle) + 8
    path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
    with pytest.raises(InputError, match="cannot be read"):
        read_dataset(path)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="cannot be read"):
        read_dataset(path)


def test_an_empty_dataset_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_dataset(path, Dataset(dataset.name, dataset.simulator, dataset.markers, {}))
    with pytest.raises(InputError, match="at least one trajectory"):
        read_dataset(path)
