"""MAT files of MATLAB, level 5 (versions 6 and 7): numbers, text, structs and cells.

After "MAT-File Format", The MathWorks, chapter 1. scipy's reader crashes on some damaged files, which ends the process;
this one raises.
"""

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from rafl.common.errors import InputError

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15  # types of data elements
NUMERIC_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
ENCODINGS = {  # by type of data element and order of bytes
    "<": {1: "latin-1", 2: "latin-1", 4: "utf-16-le", 16: "utf-8", 17: "utf-16-le", 18: "utf-32-le"},
    ">": {1: "latin-1", 2: "latin-1", 4: "utf-16-be", 16: "utf-8", 17: "utf-16-be", 18: "utf-32-be"},
}
CELL, STRUCT, CHAR, OPAQUE = 1, 2, 4, 17  # classes of arrays
NUMERIC_CLASSES = range(6, 16)
COMPLEX = 0x800  # flag of arrays
MAX_UNPACKED = 2**24  # bytes; a calibration has some ten thousand numbers


@dataclass(frozen=True)
class Unreadable:
    """A variable that only MATLAB can read, such as an object."""


class _DamagedError(Exception):
    """The bytes are no data elements."""


def read_mat_variables(content: bytes, label: str, advice: str) -> dict[str, Any]:
    """The variables of a MAT file by name.

    Numbers are arrays, texts are strings, structs are dictionaries, cells and arrays of structs are lists, and all else
    is `Unreadable`.

    Args:
        content: of the file.
        label: of the file, for messages.
        advice: what to do if the file is not readable.

    Raises:
        InputError: the content is damaged, or of another version.
    """
    if content.startswith(b"MATLAB 7.3") or content.startswith(b"\x89HDF"):
        raise InputError(f"{label}: expected a MAT file of version 7 or lower, found 7.3; {advice}")
    order = {b"IM": "<", b"MI": ">"}.get(content[HEADER_BYTES - 2 : HEADER_BYTES])
    if order is None:
        raise InputError(f"{label}: expected a MAT file of version 6 or 7, found none; {advice}")
    variables = {}
    try:
        elements = _Elements(content[HEADER_BYTES:], order)
        while not elements.at_end():
            kind, data = elements.next()
            if kind == COMPRESSED:
                unpacked = zlib.decompressobj().decompress(data, MAX_UNPACKED)
                kind, data = _Elements(unpacked, order).next()
            if kind != MATRIX:
                raise _DamagedError(f"a data element of type {kind} in the place of a variable")
            name, value = _array(data, order)
            if name:  # the workspace of objects has no name
                variables[name] = value
    except (_DamagedError, ValueError, OverflowError, zlib.error, RecursionError) as error:
        raise InputError(f"{label}: expected a MAT file, found a damaged one ({error}); {advice}") from None
    return variables


class _Elements:
    """Consecutive data elements in some bytes."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.position = data, order, 0

    def at_end(self) -> bool:
        return self.position >= len(self.data)

    def next(self) -> tuple[int, bytes]:
        """Type and data of the next element."""
        head = self._take(8)
        first, count = np.frombuffer(head, f"{self.order}u4").tolist()
        if first >> 16:  # a small element: its data are in the tag
            if first >> 16 > 4:
                raise _DamagedError("a small data element of more than 4 bytes")
            return first & 0xFFFF, head[4 : 4 + (first >> 16)]
        data = self._take(count)
        if first != COMPRESSED:
            self.position += -count % 8
        return first, data

    def numbers(self) -> np.ndarray:
        """The numbers of the next element."""
        kind, data = self.next()
        if kind not in NUMERIC_TYPES:
            raise _DamagedError(f"a data element of type {kind} in the place of numbers")
        dtype = np.dtype(self.order + NUMERIC_TYPES[kind])
        if len(data) % dtype.itemsize:
            raise _DamagedError("a data element that ends within a number")
        return np.frombuffer(data, dtype)

    def _take(self, count: int) -> bytes:
        taken = self.data[self.position : self.position + count]
        if len(taken) < count:
            raise _DamagedError("it ends early")
        self.position += count
        return taken


def _array(data: bytes, order: str) -> tuple[str, Any]:
    """Name and value of an array."""
    if not data:
        return "", np.zeros((0, 0))
    elements = _Elements(data, order)
    flags = int(elements.numbers().astype(np.int64)[:1].sum())
    kind = flags & 0xFF
    if kind not in (CELL, STRUCT, CHAR, *NUMERIC_CLASSES):
        if kind != OPAQUE:  # objects of newer classes have no shape
            elements.next()
        return elements.next()[1].decode("latin-1"), Unreadable()
    shape = elements.numbers().astype(np.int64).tolist()
    if not shape or min(shape) < 0:
        raise _DamagedError("an array without shape")
    count = math.prod(shape)
    name = elements.next()[1].decode("latin-1")
    if kind in NUMERIC_CLASSES:
        parts = [elements.numbers().astype(float) for _ in range(2 if flags & COMPLEX else 1)]
        if any(len(part) != count for part in parts):
            raise _DamagedError(f"{len(parts[0])} numbers in an array of {count}")
        numbers = parts[0] + 1j * parts[1] if flags & COMPLEX else parts[0]
        return name, numbers.reshape(shape, order="F")
    if kind == CHAR:
        text, characters = elements.next()
        if text not in ENCODINGS[order]:
            raise _DamagedError(f"a data element of type {text} in the place of text")
        return name, characters.decode(ENCODINGS[order][text])
    if kind == CELL:
        return name, [_inner(elements) for _ in range(count)]
    return name, _struct(elements, count)


def _struct(elements: _Elements, count: int) -> Any:
    """A struct as a dictionary, an array of structs as a list of them."""
    length = int(elements.numbers().astype(np.int64)[:1].sum())
    names = elements.next()[1]
    if length < 1 or len(names) % length:
        raise _DamagedError("a struct without names of its fields")
    fields = [names[k : k + length].split(b"\0")[0].decode("latin-1") for k in range(0, len(names), length)]
    structs = [{field: _inner(elements) for field in fields} for _ in range(count if fields else 0)]
    return structs[0] if len(structs) == 1 else structs


def _inner(elements: _Elements) -> Any:
    """The array in a cell or in the field of a struct."""
    kind, data = elements.next()
    if kind != MATRIX:
        raise _DamagedError(f"a data element of type {kind} in the place of an array")
    return _array(data, elements.order)[1]
