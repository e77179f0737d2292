"""Markers of files by their names in the specimen."""

from pathlib import Path

import numpy as np
import pytest

from rafl.capture.dataset.naming import in_layout_order, read_marker_names
from rafl.capture.registration.recording import Recording
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError


def recording(specimen: Specimen, scale: float = 1.0, prefix: str = "") -> Recording:
    """The specimen at rest in two frames, its markers in reverse order."""
    position = scale * np.stack([specimen.layout.positions[::-1]] * 2)
    names = tuple(prefix + name for name in reversed(specimen.layout.names))
    return Recording(names, np.array([0.0, 0.01]), position, np.full_like(position, 1e-5), None, False, "a.c3d 0a1b")


def test_markers_are_sorted_and_renamed(small_specimen: Specimen, tmp_path: Path) -> None:
    rows = [f"dot {name};{name}" for name in small_specimen.layout.names]
    (tmp_path / "names.csv").write_text("\n".join(["file;specimen", *rows]))
    names = read_marker_names(tmp_path / "names.csv")
    found = in_layout_order(recording(small_specimen, prefix="dot "), small_specimen, "a", names)
    assert found.names == small_specimen.layout.names
    np.testing.assert_array_equal(found.position[0], small_specimen.layout.positions)


@pytest.mark.parametrize("scale", [1e-3, 0.1, 10.0, 1e3])
def test_a_wrong_unit_is_named(small_specimen: Specimen, scale: float) -> None:
    with pytest.raises(
        InputError, match=r"recording a: expected markers up to .* not in mm, or the unit of a\.c3d is wrong"
    ):
        in_layout_order(recording(small_specimen, scale), small_specimen, "a", {})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,specimen\na,L1\n", "with the columns file,specimen"),
        ("file,specimen\na,L1,3\n", "with the columns file,specimen"),
        ("", "with the columns file,specimen"),
        ("file,specimen\na,L1\na,L2\n", "found one twice"),
        ("file,specimen\na,L1\nb,L1\n", "found one twice"),
    ],
)
def test_wrong_tables_of_names_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "names.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_marker_names(tmp_path / "names.csv")
