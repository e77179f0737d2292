import io
import struct
import zlib

import numpy as np
import pytest
import scipy.io

from rafl.calibration.foreign.mat_file import Unreadable, read_mat_variables
from rafl.common.errors import InputError

VALUES = {
    "matrix": np.arange(6.0).reshape(2, 3),
    "small": np.array([[7]], dtype=np.uint8),
    "integers": np.array([[-3, 40000]], dtype=np.int32),
    "flags": np.array([[True, False]]),
    "complex": np.array([[1 + 2j, -3.5]]),
    "deep": np.arange(24.0).reshape(2, 3, 4),
    "text": "milli\u00f6meters",
    "struct": {"a": 1.5, "inner": {"b": np.eye(2), "empty": np.zeros((0, 2))}},
    "structs": np.array([(1.0, "x"), (2.0, "y")], dtype=[("number", object), ("name", object)]),
    "cell": np.array(["left", np.eye(3)], dtype=object),
}


def written(compressed: bool = False) -> bytes:
    stream = io.BytesIO()
    scipy.io.savemat(stream, VALUES, do_compression=compressed)
    return stream.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
def test_variables_read_back(compressed: bool) -> None:
    found = read_mat_variables(written(compressed), "a.mat", "export it")
    assert list(found) == list(VALUES)
    for name in ("matrix", "small", "integers", "flags", "complex", "deep"):
        np.testing.assert_array_equal(found[name], VALUES[name])
    assert found["text"] == VALUES["text"]
    assert found["struct"]["a"] == 1.5
    np.testing.assert_array_equal(found["struct"]["inner"]["b"], np.eye(2))
    assert found["struct"]["inner"]["empty"].shape == (0, 2)
    assert [(part["number"].item(), part["name"]) for part in found["structs"]] == [(1.0, "x"), (2.0, "y")]
    assert found["cell"][0] == "left"


def test_big_endian_numbers_and_objects() -> None:
    """An array [1, 2] of doubles, and an object of a class of MATLAB's own."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack(">II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    numbers = element(6, struct.pack(">II", 6, 0)) + element(5, struct.pack(">ii", 1, 2)) + element(1, b"pair")
    numbers += element(9, struct.pack(">dd", 1.0, 2.0))
    thing = element(6, struct.pack(">II", 17, 0)) + element(1, b"stereoParams") + element(1, b"MCOS")
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    found = read_mat_variables(header + element(14, numbers) + element(14, thing), "a.mat", "export it")
    np.testing.assert_array_equal(found["pair"], [[1.0, 2.0]])
    assert found["stereoParams"] == Unreadable()


def test_mutated_files_are_read_or_refused(random: np.random.Generator) -> None:
    original = written()
    refused = 0
    for _ in range(400):
        changed = bytearray(original[: int(random.integers(128, len(original) + 1))])
        for index in random.integers(0, len(changed), int(random.integers(0, 6))):
            changed[int(index)] = int(random.integers(0, 256))
        try:
            read_mat_variables(bytes(changed), "a.mat", "export it")
        except InputError:
            refused += 1
    assert 200 < refused < 400


def test_what_unpacks_to_too_much_is_refused() -> None:
    packed = zlib.compress(struct.pack("<II", 14, 2**30) + b"\0" * 2**25)
    content = written()[:128] + struct.pack("<II", 15, len(packed)) + packed
    with pytest.raises(InputError, match=r"a damaged one \(it ends early\); export it"):
        read_mat_variables(content, "a.mat", "export it")
