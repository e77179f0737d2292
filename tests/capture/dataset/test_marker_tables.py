"""Tables of marker trajectories of other programs, each written here from the same positions."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import SHARED

from rafl.capture.dataset.marker_tables import read_marker_table
from rafl.capture.dataset.sources import read_recording
from rafl.common.errors import InputError

NAMES = ("L1", "L2", "R1")
MILLIMETRES = 20.0 * np.random.default_rng(4).normal(size=(5, 3, 3)).round(2)
MILLIMETRES[2, 1] = np.nan  # L2 is missing in frame 2
RATE = 50.0


def cells(frame: np.ndarray, missing: str = "") -> list[str]:
    return [f"{x:.4f}" if np.isfinite(x) else missing for x in frame.ravel()]


def motive() -> str:
    """With a rigid body beside the markers, and lengths in metres."""
    head = ["Format Version", "1.23", "Capture Frame Rate", "100", "Export Frame Rate", "50", "Length Units", "Meters"]
    three = [name for name in NAMES for _ in range(3)]
    rows = [
        head,
        [],
        ["", "", "Rigid Body", *["Marker"] * 9],
        ["", "", "plate", *(f"beam:{name}" for name in three)],
        ["", "", "1", *three],
        ["", "", "Rotation", *["Position"] * 9],
        ["Frame", "Time (Seconds)", "X", *["X", "Y", "Z"] * 3],
    ]
    rows += [[str(k), f"{k / RATE}", "0.5", *cells(1e-3 * x)] for k, x in enumerate(MILLIMETRES)]
    return "\n".join(",".join(row) for row in rows).replace("0.0000", "0.00001")


def vicon() -> str:
    """After another section, as Nexus writes it."""
    rows = [
        ["Devices"],
        ["1000"],
        [],
        ["Trajectories"],
        ["50"],
        ["", "", *(cell for name in NAMES for cell in (f"beam:{name}", "", ""))],
        ["Frame", "Sub Frame", *["X", "Y", "Z"] * 3],
        ["", "", *["mm"] * 9],
    ]
    rows += [[str(k + 7), "0", *cells(x)] for k, x in enumerate(MILLIMETRES)]
    return "\n".join(",".join(row) for row in rows) + "\n\n"


def qualisys(with_time: bool = False) -> str:
    head = [["NO_OF_FRAMES", "5"], ["FREQUENCY", "50"], ["DATA_INCLUDED", "3D"], ["MARKER_NAMES", *NAMES]]
    if with_time:
        head += [["Frame", "Time", *(f"{name} {axis}" for name in NAMES for axis in "XYZ")]]
    before = [[str(k + 1), f"{k / RATE}"] if with_time else [] for k in range(5)]
    rows = head + [own + cells(x, "0.000") for own, x in zip(before, MILLIMETRES, strict=True)]
    return "\n".join("\t".join(row) for row in rows) + "\n"


def trc() -> str:
    """With an empty line after the header, as OpenSim has it."""
    head = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits", "50\t50\t5\t3\tmm"]
    head += ["Frame#\tTime\t" + "\t\t\t".join(NAMES) + "\t\t", "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\tX3\tY3\tZ3", ""]
    return "\n".join([*head, *("\t".join([str(k + 1), "0", *cells(x)]) for k, x in enumerate(MILLIMETRES))]) + "\n"


def deeplabcut() -> str:
    three = [name for name in NAMES for _ in range(3)]
    rows = [["scorer", *["net"] * 9], ["bodyparts", *three], ["coords", *["x", "y", "z"] * 3]]
    rows += [[str(k), *cells(x, "nan")] for k, x in enumerate(MILLIMETRES)]
    return "\n".join(",".join(row) for row in rows)


def anipose() -> str:
    parts = ("x", "y", "z", "error", "ncams")
    rows = [[f"{name}_{part}" for name in NAMES for part in parts] + ["M_00", "fnum"]]
    rows += [
        [cell for own in x for cell in (*cells(own), "0.3", "2")] + ["1.0", str(k)] for k, x in enumerate(MILLIMETRES)
    ]
    return "\n".join(",".join(row) for row in rows)


def dltdv() -> str:
    rows = [[f"pt{k + 1}_{axis}" for k in range(3) for axis in "XYZ"], *(cells(x, "NaN") for x in MILLIMETRES)]
    return "\n".join(",".join(row) for row in rows)


@pytest.mark.parametrize(
    ("name", "write", "names"),
    [
        ("a.csv", motive, NAMES),
        ("a.csv", vicon, NAMES),
        ("a.tsv", qualisys, NAMES),
        ("a.tsv", lambda: qualisys(with_time=True), NAMES),
        ("a.trc", trc, NAMES),
        ("a.csv", deeplabcut, NAMES),
        ("a.csv", anipose, NAMES),
        ("axyzpts.csv", dltdv, None),
    ],
)
def test_positions_are_read(name: str, write: Callable[[], str], names: tuple[str, ...] | None, tmp_path: Path) -> None:
    (tmp_path / name).write_text(write())
    found = read_recording(tmp_path / name, RATE, "mm")
    assert found.names == names
    np.testing.assert_allclose(found.time, np.arange(5) / RATE)
    np.testing.assert_allclose(found.position, 1e-3 * MILLIMETRES, atol=6e-5)  # metres with four digits
    np.testing.assert_array_equal(np.isfinite(found.position), np.isfinite(MILLIMETRES))
    assert not found.in_specimen_frame


@pytest.mark.parametrize("write", [deeplabcut, anipose, dltdv])
def test_a_unit_that_the_file_does_not_name_must_be_given(write: Callable[[], str], tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(write())
    with pytest.raises(InputError, match=r"expected a unit, m, cm or mm, found none in the file; give it with --unit"):
        read_recording(tmp_path / "a.csv", RATE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "expected a table of .* found one that begins 'a,b'"),
        ("", "expected a table of"),
        (motive().replace("Export Frame Rate", "x").replace("Capture Frame Rate", "y"), "incomplete"),
        (vicon().partition("Frame,Sub")[0], "incomplete"),
        (vicon().replace("7,0,", "seven,0,", 1), r"line 9, column 1: expected a number, found 'seven'"),
        (vicon().replace("\n50\n", "\n0\n"), "expected a frame rate above 0, found 0"),
        (dltdv().partition("\n")[0], "expected frames and markers, found none"),
        (deeplabcut().replace("scorer", "scorer", 1).replace("bodyparts", "individuals"), "incomplete|individuals"),
    ],
)
def test_damaged_tables_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_marker_table(tmp_path / "a.csv")


@pytest.mark.reference
def test_examples_of_other_programs() -> None:
    """Files of eight kinds hold the same motion of 32 dots; ours to the hundredth of a millimetre."""
    folder = SHARED / "cases" / "foreign"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    found = {path.parent.name: read_recording(path, 100.0, "mm") for path in folder.glob("*/load020g*")}
    assert len(found) == 8
    for kind, recording in found.items():
        assert recording.position.shape == (90, 32, 3)
        assert np.isfinite(recording.position).all()
        assert recording.in_specimen_frame == (kind == "owncsv")
        other = found["owncsv" if kind.startswith("own") else "vicon"]
        np.testing.assert_allclose(recording.position, other.position, atol=1e-6)
        np.testing.assert_allclose(recording.time, 0.01 * np.arange(90))
