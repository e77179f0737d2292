"""HDF5 files: composed in memory and written whole; read only if they hold all of a bounded content themselves."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from rafl.common.errors import InputError
from rafl.common.hdf5_files import read_hdf5, write_hdf5

MESSAGE = "^expected a file in .*file.h5, which cannot be read: .*{}.*; make it again$"


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((4,), dtype=float)
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", (4,))
    file.create_virtual_dataset("x", layout)


def far_filter(file: h5py.File) -> None:
    """An array that says it was packed by a filter of others (number 32001, Blosc), without chunks."""
    stored = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    stored.set_chunk((4,))
    stored.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)
    h5py.h5d.create(file.id, b"x", h5py.h5t.NATIVE_DOUBLE, h5py.h5s.create_simple((4,)), stored)


REFUSED: dict[str, tuple[str, Callable[[h5py.File], object]]] = {
    "external link": ("link to elsewhere", lambda file: file.update({"x": h5py.ExternalLink("other.h5", "/x")})),
    "soft link": ("link to elsewhere", lambda file: file.update({"x": h5py.SoftLink("/good/array")})),
    "link in a group": ("link to elsewhere", lambda file: file["good"].update({"x": h5py.SoftLink("/")})),
    "virtual array": ("stored elsewhere", virtual),
    "external storage": (
        "stored elsewhere",
        lambda file: file.create_dataset("x", (4,), float, external=[("/etc/hostname", 0, 32)]),
    ),
    "filter of others": ("found filter 32001", far_filter),
    "petabyte": ("at most", lambda file: file.create_dataset("x", (1 << 50,), "f8", chunks=(1 << 20,))),
    "petabyte of several arrays": (
        "at most",
        lambda file: [file.create_dataset(f"x{k}", (1 << 26,), "f8", chunks=(1 << 20,)) for k in range(9)],
    ),
    "large pieces": ("at most", lambda file: file.create_dataset("x", (1,), "f8", chunks=(1 << 28,), maxshape=(None,))),
    "references": ("numbers or text", lambda file: file.create_dataset("x", data=np.array([file.ref], h5py.ref_dtype))),
    "records": ("numbers or text", lambda file: file.create_dataset("x", data=np.zeros(2, [("a", float), ("b", int)]))),
    "no values": ("found no values", lambda file: file.create_dataset("x", data=h5py.Empty("f8"))),
    "type": ("array or a group", lambda file: file.update({"x": np.dtype("f8")})),
    "references in an attribute": (
        "numbers or text",
        lambda file: file.attrs.create("x", np.array([file.ref], h5py.ref_dtype)),
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_content_that_may_be_elsewhere_or_too_large_is_refused(tmp_path: Path, name: str) -> None:
    part, change = REFUSED[name]
    path = tmp_path / "file.h5"
    with h5py.File(path, "w") as file:
        file["good/array"] = np.arange(3.0)
        change(file)
    with (
        pytest.raises(InputError, match=MESSAGE.format(part)),
        read_hdf5(path, "a file", "make it again"),
    ):
        pass


@pytest.mark.parametrize("content", [b"", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + bytes(600), b"PK\x03\x04"])
def test_no_hdf5_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file.h5"
    path.write_bytes(content)
    with pytest.raises(InputError, match=MESSAGE.format("")), read_hdf5(path, "a file", "make it again"):
        pass


def test_file_that_another_program_writes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    writer = f"import h5py; file = h5py.File({str(path)!r}, 'w'); file.flush(); print(1, flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", writer], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        with (
            pytest.raises(InputError, match=r"found that another program has it open; close it there$"),
            read_hdf5(path, "a file", "make it again"),
        ):
            pass
        process.kill()


def test_file_packed_with_gzip_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=np.zeros(1 << 20), compression="gzip", shuffle=True, fletcher32=True)
    with read_hdf5(path, "a file", "make it again") as file:
        assert file["x"].shape == (1 << 20,)


def test_several_files_are_written_at_once(tmp_path: Path) -> None:
    with write_hdf5(tmp_path / "a.h5") as one, write_hdf5(tmp_path / "b.h5") as other:
        one["x"], other["x"] = 1, 2
    for name, value in (("a.h5", 1), ("b.h5", 2)):
        with read_hdf5(tmp_path / name, "a file", "make it again") as file:
            assert file["x"][()] == value


def test_nothing_is_written_if_the_content_fails(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.h5"
    with pytest.raises(ZeroDivisionError), write_hdf5(path) as file:
        file["x"] = 1 / 0
    assert list(tmp_path.iterdir()) == []
    with write_hdf5(path) as file:
        file["x"] = np.arange(4)
    with read_hdf5(path, "a file", "make it again") as file:
        assert file["x"][()].tolist() == [0, 1, 2, 3]
