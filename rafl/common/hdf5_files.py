"""HDF5 files: written from memory, and read without trust in who made them."""

import math
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pydantic

from rafl.common.errors import InputError
from rafl.common.files import ReadBack, require_file, write_bytes
from rafl.common.yaml_files import describe_validation

# What a file may hold beyond its own size [bytes], as compressed or unwritten arrays.
MAX_EXPANSION_BYTES = 500_000_000
BUILT_IN_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}

# What h5py and the readers of its content raise for damaged files; SystemError for a name that is no UTF-8.
DAMAGE = (OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError, ArithmeticError, SystemError)


@contextmanager
def write_hdf5(path: Path, read_back: ReadBack | None = None) -> Iterator[h5py.File]:
    """Yield a file in memory, and write it to `path` as a whole. (HDF5 ends the process where it meets a full disk.)

    Args:
        path: of the file.
        read_back: the reader of such files; the new file takes its place only if this can read it.

    Raises:
        InputError: `path` cannot be written, or what was written cannot be read back.
    """
    # HDF5 opens no name twice, and several threads may write at once.
    with h5py.File(f"in memory {uuid.uuid4()}", "w", driver="core", backing_store=False) as file:
        yield file
        file.flush()
        content = file.id.get_file_image()
    write_bytes(path, content, read_back)


@contextmanager
def read_hdf5(path: Path, label: str, advice: str) -> Iterator[h5py.File]:
    """Open a file that holds all its content itself: nothing that it names elsewhere is opened.

    Errors while the file is open are taken as errors of its content.

    Args:
        path: of the file.
        label: what it should be, for error messages.
        advice: end of the error messages.

    Raises:
        InputError: no such file, no HDF5, a link, an array stored elsewhere or by a filter that HDF5 does not have
            built in, more content than its size allows, a file that another program writes, or an error while it is
            open.
    """
    require_file(path, label)
    try:
        with h5py.File(path, "r") as file:
            _check_self_contained(file, MAX_EXPANSION_BYTES + path.stat().st_size)
            yield file
    except BlockingIOError:  # HDF5 locks a file while it is written
        raise InputError(
            f"expected {label} in {path}, found that another program has it open; close it there"
        ) from None
    except DAMAGE as error:
        reason = (
            describe_validation(error) if isinstance(error, pydantic.ValidationError) else " ".join(str(error).split())
        )
        raise InputError(f"expected {label} in {path}, which cannot be read: {reason}; {advice}") from None


def _check_self_contained(file: h5py.File, limit: int) -> None:
    """Raise ValueError for links, arrays stored elsewhere, unknown filters, and content of more than `limit` bytes."""
    links: list[tuple[str, Any]] = []
    file.visititems_links(lambda name, link: links.append((name, link)))
    for name, link in links:
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{name}: expected an array or a group, found a link to elsewhere")
    items: list[tuple[str, Any]] = [("/", file)]
    file.visititems(lambda name, item: items.append((name, item)))
    total = 0
    for name, item in items:
        if not isinstance(item, (h5py.Dataset, h5py.Group)):
            raise ValueError(f"{name}: expected an array or a group, found a {type(item).__name__}")
        total += _attribute_bytes(name, item) + (_array_bytes(name, item) if isinstance(item, h5py.Dataset) else 0)
    if total > limit:
        raise ValueError(
            f"expected arrays of at most {limit / 1e6:.0f} MB in a file of its size, found {total:.3g} bytes"
        )


def _array_bytes(name: str, item: h5py.Dataset) -> int:
    """Size of an array in memory [bytes]."""
    stored = item.id.get_create_plist()
    if stored.get_layout() == h5py.h5d.VIRTUAL or stored.get_external_count():
        raise ValueError(f"{name}: expected an array in this file, found one that is stored elsewhere")
    filters = {stored.get_filter(number)[0] for number in range(stored.get_nfilters())}
    if filters - BUILT_IN_FILTERS:
        raise ValueError(f"{name}: expected an array as it is or with gzip, found filter {max(filters)}")
    shapes = [item.shape, item.chunks or ()]
    if None in shapes:
        raise ValueError(f"{name}: expected an array, found no values")
    _check_elements(name, item.dtype)
    elements: int = max(math.prod(shape) for shape in shapes)
    return elements * item.dtype.itemsize  # type: ignore[no-any-return]


def _attribute_bytes(name: str, item: Any) -> int:
    """Size of the attributes of an array or a group in memory [bytes]."""
    total = 0
    for key in item.attrs:
        found = item.attrs.get_id(key)
        _check_elements(f"{name}, attribute {key}", found.dtype)
        total += math.prod(found.shape or ()) * found.dtype.itemsize
    return total


def _check_elements(name: str, dtype: np.dtype[Any]) -> None:
    if dtype.kind not in "biufSO" or (dtype.kind == "O" and h5py.check_string_dtype(dtype) is None):
        raise ValueError(f"{name}: expected numbers or text, found {dtype}")
