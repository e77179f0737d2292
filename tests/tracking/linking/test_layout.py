"""The markers of a specimen file: single ones and grids."""

from pathlib import Path

import numpy as np
import pytest
from support import ROOT

from rafl.common.errors import InputError
from rafl.tracking.linking.layout import read_layout

HEAD = "format: rafl-specimen/1\nmarkers:\n"


def layout_file(folder: Path, *entries: str) -> Path:
    path = folder / "specimen.yaml"
    path.write_text(HEAD + "".join(f"  - {entry}\n" for entry in entries))
    return path


def test_grids_give_the_canonical_beam(tmp_path: Path) -> None:
    shape = "rows: 2, columns: 8, spacing_mm: [12, 10]"
    path = layout_file(
        tmp_path,
        f"{{name: L, face: y-min, at_mm: [10, 0, 20], {shape}}}",
        f"{{name: R, face: y-max, at_mm: [10, 30, 20], {shape}, at_sigma_mm: 0.2}}",
    )
    found, typed = read_layout(path), read_layout(ROOT / "datasets" / "specimens" / "canonical.yaml")
    assert found.names == typed.names
    np.testing.assert_allclose(found.positions, typed.positions, atol=1e-12)
    assert typed.box == pytest.approx((0.1, 0.03, 0.03))
    assert found.box is None
    assert read_layout(ROOT / "datasets" / "specimens" / "fishtail-fine.yaml").box is None
    np.testing.assert_allclose(found.sigma, [0.5e-3] * 16 + [0.2e-3] * 16)


@pytest.mark.parametrize(
    ("face", "second", "last"),
    [("z-max", [16, 5, 30], [16, 11, 30]), ("x-max", [10, 11, 30], [10, 11, 24])],
)
def test_directions_of_rows_and_columns(tmp_path: Path, face: str, second: list[float], last: list[float]) -> None:
    entry = f"{{name: T, face: {face}, at_mm: [10, 5, 30], rows: 2, columns: 2, spacing_mm: 6}}"
    found = read_layout(layout_file(tmp_path, entry))
    assert found.names == ("T1", "T2", "T3", "T4")
    np.testing.assert_allclose(1e3 * found.positions[[1, 3]], [second, last])


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("{name: L, face: y-min, at_mm: [1, 0, 2], rows: 0, columns: 2, spacing_mm: 6}", r"markers\.1\.rows: "),
        ("{name: L, face: front, at_mm: [1, 0, 2], rows: 1, columns: 2, spacing_mm: 6}", r"markers\.1\.face: "),
        ("{name: L, at_mm: [1, 0]}", r"markers\.1\.at_mm\.2: "),
        ("{name: L, at_mm: [1, 0, 2], at_sigma_mm: -1}", r"markers\.1\.at_sigma_mm: "),
        ("{name: L, face: y-min, at_mm: [1, 0, 2], rows: 1, columns: 2, spacing_mm: 6}", "'L1' more than once"),
        (
            "{name: K, face: y-min, at_mm: [0, 0, 0], rows: 1, columns: 2, spacing_mm: 6}",
            r"found L1 and K1 both at \[0.0, 0.0, 0.0\] mm",
        ),
    ],
)
def test_wrong_entries_are_named(tmp_path: Path, entry: str, message: str) -> None:
    path = layout_file(tmp_path, "{name: L1, at_mm: [0, 0, 0]}", entry)
    with pytest.raises(InputError, match=message):
        read_layout(path)
