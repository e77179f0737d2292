"""C3D files that are cut short or damaged, and files of many points."""

import struct
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from rafl.capture.dataset.c3d import read_c3d
from rafl.common.errors import InputError

FRAMES = 6


def write(path: Path, count: int) -> np.ndarray:
    """A file of `count` points in mm; returns the points (T, M, 3)."""
    points = np.random.default_rng(1).normal(0.0, 50.0, (FRAMES, count, 3)).astype(np.float32)
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = [f"P{k}" for k in range(count)]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    data = np.ones((4, count, FRAMES))
    data[:3] = points.transpose(2, 1, 0)
    file["data"]["points"] = data
    file.write(str(path))
    return points


@pytest.mark.parametrize("count", [5, 300])
def test_all_points_are_read(count: int, tmp_path: Path) -> None:
    """A list of labels holds 255; the others are in a second list."""
    points = write(tmp_path / "a.c3d", count)
    found = read_c3d(tmp_path / "a.c3d")
    assert found.names == tuple(f"P{k}" for k in range(count))
    assert (found.unit, found.rate, found.exported) == ("mm", 100.0, False)
    np.testing.assert_allclose(found.points, points, rtol=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9])
def test_a_file_cut_short_is_refused(share: float, tmp_path: Path) -> None:
    write(tmp_path / "a.c3d", 300)
    content = (tmp_path / "a.c3d").read_bytes()
    (tmp_path / "a.c3d").write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"cut short|no header"):
        read_c3d(tmp_path / "a.c3d")


@pytest.mark.parametrize("name", [b"USED", b"LABELS"])
def test_a_damaged_parameter_is_refused(name: bytes, tmp_path: Path) -> None:
    """Without the first the library ends the process with a segmentation fault."""
    write(tmp_path / "a.c3d", 5)
    content = (tmp_path / "a.c3d").read_bytes()
    (tmp_path / "a.c3d").write_bytes(content.replace(name, name[:-1] + b"\xd0", 1))
    with pytest.raises(InputError, match=r"a\.c3d"):
        read_c3d(tmp_path / "a.c3d")


def test_a_wrong_number_of_frames_in_the_header_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.c3d", 5)
    content = bytearray((tmp_path / "a.c3d").read_bytes())
    struct.pack_into("<H", content, 8, 5000)
    (tmp_path / "a.c3d").write_bytes(content)
    with pytest.raises(InputError, match="expected 5000 frames of 5 points"):
        read_c3d(tmp_path / "a.c3d")
