"""Descriptions of arrays in files, and the check of an array against its description."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rafl.common.yaml_files import LARGEST

# Types of elements in files, by `numpy.dtype.kind`, and their words.
KINDS = {"number": "fiu", "integer": "iu", "truth": "b", "text": "SOU"}
KIND_WORDS = dict.fromkeys("SOU", "text")  # for types whose own names say little


@dataclass(frozen=True)
class ArrayFormat:
    """What an array has to be.

    Attributes:
        shape: of each axis its length, or a letter; the same letter stands for the same length throughout a file.
        kind: of its elements, a key of `KINDS`.
        finite: whether all numbers must be finite; missing ones are NaN or infinite where not.
        low, high: bounds of the numbers, included; NaN is within them.
        optional: whether a file may lack the array.
    """

    shape: tuple[int | str, ...]
    kind: str = "number"
    finite: bool = True
    low: float = -LARGEST
    high: float = LARGEST
    optional: bool = False


def check_shape(label: str, array: Any, expected: ArrayFormat, lengths: dict[str, int]) -> None:
    """Check the type and shape of an array, or of an HDF5 dataset before it is read.

    Args:
        label: name of the array for the error message.
        array: what has a `shape` and a `dtype`.
        expected: description of the array.
        lengths: by letter; letters that are not in it yet are added.

    Raises:
        ValueError: the array differs; the message names it.
    """
    if array.dtype.kind not in KINDS[expected.kind]:
        raise ValueError(
            f"{label}: expected elements of type {expected.kind}, found {KIND_WORDS.get(array.dtype.kind, array.dtype)}"
        )
    if len(array.shape) == len(expected.shape):
        for axis, length in zip(expected.shape, array.shape, strict=True):
            if isinstance(axis, str):
                lengths.setdefault(axis, length)
    wanted = tuple(lengths.get(axis, 0) if isinstance(axis, str) else axis for axis in expected.shape)
    if tuple(array.shape) != wanted:
        raise ValueError(f"{label}: expected shape {wanted}, found {tuple(array.shape)}")


def check_values(label: str, array: Any, expected: ArrayFormat) -> None:
    """Check the numbers of an array.

    Raises:
        ValueError: a number is not finite or out of bounds; the message names the array.
    """
    if expected.kind not in ("number", "integer") or not array.size:
        return
    finite = np.isfinite(array)
    if expected.finite and not finite.all():
        raise ValueError(f"{label}: expected finite numbers, found {array[~finite].ravel()[0]}")
    numbers = array[finite]
    low, high = (float(numbers.min()), float(numbers.max())) if numbers.size else (expected.low, expected.high)
    if low < expected.low or high > expected.high:
        found = low if low < expected.low else high
        raise ValueError(f"{label}: expected numbers from {expected.low:g} to {expected.high:g}, found {found:g}")


def read_arrays(
    group: Any, formats: Mapping[str, ArrayFormat], lengths: dict[str, int], label: str = ""
) -> dict[str, Any]:
    """Read arrays of an HDF5 group by their descriptions.

    Args:
        group: open for reading.
        formats: by key in the group.
        lengths: of axes by letter, see `check_shape`.
        label: put before the keys in error messages.

    Returns:
        By key: float64, int64 or bool arrays, and text as tuples; without optional arrays that are not there.

    Raises:
        ValueError: an array is missing, or differs from its description.
    """
    found = {}
    for key, expected in formats.items():
        if key not in group:
            if expected.optional:
                continue
            raise ValueError(f"expected the array {label}{key}, found none")
        stored = group[key]
        if not hasattr(stored, "dtype"):
            raise ValueError(f"{label}{key}: expected an array, found a group")
        check_shape(f"{label}{key}", stored, expected, lengths)
        if expected.kind == "text":
            found[key] = tuple(str(text) for text in stored.asstr()[()])
            continue
        value = stored[()]
        check_values(f"{label}{key}", value, expected)
        found[key] = value.astype({"number": np.float64, "integer": np.int64, "truth": np.bool_}[expected.kind])
    return found
