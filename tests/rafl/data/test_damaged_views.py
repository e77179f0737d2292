"""Damage to the views in a dataset file is refused, and the message names file, recording and camera."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from filmed_markers import filmed, pinhole_camera, side_camera

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset, write_dataset

LEFT, CALIBRATION = "trajectories/b/views/left", "trajectories/b/views, calibration"
PIXELS_OFF = r"expected pixels within 367 px of where the calibrated camera shows"
WHOLE_PIXELS = r"pixel: expected two finite numbers, or two NaN"
POSITIVE = r"covariance: expected a positive definite matrix for every pixel"
ELSEWHERE = "expected an array in this file, found one that is stored elsewhere"


def put(name: str, value: Callable[[Any], Any]) -> Callable[[h5py.Group], None]:
    """Another array in the place of one."""

    def change(views: h5py.Group) -> None:
        changed = value(views[name][()])
        del views[name]
        views[name] = changed

    return change


def entry(name: str, index: Any, value: Any) -> Callable[[h5py.Group], None]:
    """Another value in an array."""

    def changed(array: Any) -> Any:
        array[index] = value
        return array

    return put(name, changed)


def calibration(old: str, new: str) -> Callable[[h5py.Group], None]:
    """Another text in the calibration."""

    def change(views: h5py.Group) -> None:
        text = str(views.attrs["calibration"])
        assert old in text
        views.attrs["calibration"] = text.replace(old, new, 1)

    return change


def attribute(value: Any) -> Callable[[h5py.Group], None]:
    """Another calibration."""
    return lambda views: views.attrs.__setitem__("calibration", value)


def elsewhere(name: str, make: Callable[[h5py.Group], None]) -> Callable[[h5py.Group], None]:
    """What is made in the place of an array or a group."""

    def change(views: h5py.Group) -> None:
        del views[name]
        make(views)

    return change


def remove(name: str) -> Callable[[h5py.Group], None]:
    return elsewhere(name, lambda views: None)


DAMAGE: dict[str, tuple[Callable[[h5py.Group], None], str]] = {
    "fewer frames": (put("left/pixel", lambda x: x[:-1]), rf"{LEFT}/pixel: expected shape \(25, 20, 2\)"),
    "fewer markers": (put("left/covariance", lambda x: x[:, 1:]), rf"{LEFT}/covariance: expected shape"),
    "fewer poses": (put("left/rotation", lambda x: x[:-1]), rf"{LEFT}/rotation: expected shape \(25, 3, 3\)"),
    "text": (put("left/pixel", lambda x: x.astype("S")), rf"{LEFT}/pixel: expected elements of type number"),
    "no lag": (remove("left/lag"), f"expected the array {LEFT}/lag, found none"),
    "no rotation": (remove("left/rotation"), f"{LEFT}: expected both rotation and translation"),
    "no translation": (remove("left/translation"), f"{LEFT}: expected both rotation and translation"),
    "stretched": (entry("left/rotation", 3, 2.0 * np.eye(3)), f"{LEFT}/rotation: expected rotation matrices"),
    "mirrored": (entry("left/rotation", 3, -np.eye(3)), f"{LEFT}/rotation: expected rotation matrices"),
    "fewer covariances": (
        put("left/pose_covariance", lambda x: x[:-1]),
        rf"{LEFT}/pose_covariance: expected shape \(25, 6, 6\)",
    ),
    "skewed pose": (entry("left/pose_covariance", (3, 0, 1), 1e-9), f"{LEFT}/pose_covariance: expected symmetric"),
    "indefinite pose": (entry("left/pose_covariance", 3, -np.eye(6)), f"{LEFT}/pose_covariance: expected positive"),
    "endless pose": (entry("left/pose_covariance", 3, np.inf), f"{LEFT}/pose_covariance: expected finite numbers"),
    "far": (entry("left/translation", 3, 1e11), f"{LEFT}: {PIXELS_OFF}"),
    "infinite pixel": (entry("left/pixel", (3, 2), np.inf), f"{LEFT}/{WHOLE_PIXELS}"),
    "half a pixel": (entry("left/pixel", (3, 2), [np.nan, 5.0]), f"{LEFT}/{WHOLE_PIXELS}"),
    "the other half": (entry("left/pixel", (3, 2), [5.0, np.nan]), f"{LEFT}/{WHOLE_PIXELS}"),
    "huge pixel": (entry("left/pixel", (3, 2), 1e8), rf"{LEFT}/pixel: expected numbers from -1e\+06 to 1e\+06"),
    "distant pixel": (entry("left/pixel", (3, 2), 2e3), f"{LEFT}: {PIXELS_OFF}"),
    "no covariance": (entry("left/covariance", (3, 2), np.nan), f"{LEFT}/{POSITIVE}"),
    "singular": (entry("left/covariance", (3, 2), np.ones((2, 2))), f"{LEFT}/{POSITIVE}"),
    "indefinite": (entry("left/covariance", (3, 2), [[1.0, 2.0], [2.0, 1.0]]), f"{LEFT}/{POSITIVE}"),
    "not symmetric": (entry("left/covariance", (3, 2), [[1.0, 0.5], [0.0, 1.0]]), f"{LEFT}/{POSITIVE}"),
    "tiny": (put("left/covariance", lambda x: 1e-290 * x), f"{LEFT}/{POSITIVE}"),
    "late": (entry("left/lag", 3, 0.05), f"{LEFT}/lag: expected times within 2 frames"),
    "no calibration": (lambda views: views.attrs.__delitem__("calibration"), "trajectories/b/views: expected a group"),
    "number": (attribute(5), CALIBRATION),
    "no YAML": (attribute("x: ["), f"{CALIBRATION}: .* not readable as YAML"),
    "newer": (calibration("rafl-calibration/1", "rafl-calibration/9"), f"{CALIBRATION}: .* newer"),
    "unknown model": (calibration("orthographic", "fisheye"), f"{CALIBRATION}: .*cameras.left"),
    "not a number": (calibration("skew: 0.0", "skew: .nan"), f"{CALIBRATION}: .*cameras.left"),
    "endless image": (
        calibration("image_size: [", "image_size: [1000"),
        f"{CALIBRATION}: .*image_size: expected two positive numbers of at most 100000 px, found",
    ),
    "unlisted camera": (calibration("left:", "other:"), "trajectories/b/views: expected the cameras other, pin, found"),
    "lost camera": (remove("left"), "trajectories/b/views: expected the cameras left, pin, found pin"),
    "array for a camera": (
        elsewhere("left", lambda views: put_array(views, "left")),
        f"expected the array {LEFT}/pixel",
    ),
    "huge scale": (calibration("[8.0, 8.0]", "[1e12, 1e12]"), f"{LEFT}: {PIXELS_OFF}"),
    "tiny scale": (calibration("[8.0, 8.0]", "[1e-9, 1e-9]"), f"{LEFT}: expected (pixels|a camera)"),
    "distorted": (calibration("distortion: [0.0, 0.0]", "distortion: [1e12, -1e12]"), f"{LEFT}: {PIXELS_OFF}"),
    "behind": (calibration("10.0, 500.0]", "10.0, -500.0]"), f"trajectories/b/views/pin: {PIXELS_OFF}"),
    "unknown recording": (lambda views: views.file.copy(views, "trajectories/z/views"), "trajectories/z, split"),
    "link": (elsewhere("left/pixel", lambda views: link(views, "left/pixel")), f"{LEFT}/pixel: .* a link to elsewhere"),
    "camera elsewhere": (elsewhere("left", lambda views: link(views, "left")), f"{LEFT}: .* a link to elsewhere"),
    "external": (
        elsewhere(
            "left/lag",
            lambda views: views.create_dataset("left/lag", (25,), "f8", external=[("/etc/hostname", 0, 200)]),
        ),
        f"{LEFT}/lag: {ELSEWHERE}",
    ),
    "virtual": (
        elsewhere("left/lag", lambda views: views.create_virtual_dataset("left/lag", h5py.VirtualLayout((25,), float))),
        f"{LEFT}/lag: {ELSEWHERE}",
    ),
}


def put_array(views: h5py.Group, name: str) -> None:
    views[name] = np.zeros(3)


def link(views: h5py.Group, name: str) -> None:
    views[name] = h5py.ExternalLink("other.h5", f"/trajectories/a/views/{name}")


@pytest.fixture(scope="module")
def good(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A dataset file with two cameras; the clamp moves in recording b."""
    path = tmp_path_factory.mktemp("filmed") / "filmed.h5"
    cameras = {"left": side_camera(0.0), "pin": pinhole_camera(0.5)}
    still, moving = filmed(dataset, cameras), filmed(dataset, cameras, moving=True)
    write_dataset(path, replace(still, trajectories={**still.trajectories, "b": moving.trajectories["b"]}))
    return path.read_bytes()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_views_are_refused(good: bytes, tmp_path: Path, damage: str) -> None:
    path, (change, message) = tmp_path / "filmed.h5", DAMAGE[damage]
    path.write_bytes(good)
    read_dataset(path)
    with h5py.File(path, "r+") as file:
        change(file["trajectories/b/views"])
    with pytest.raises(InputError, match=message) as caught:
        read_dataset(path)
    assert str(path) in str(caught.value)
