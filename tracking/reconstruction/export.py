"""Export of tracks to other programs' formats: CSV, C3D, TRC and NumPy."""

import errno
import io
import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import ezc3d
import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.common.files import atomic_file, write_bytes, write_text
from rafl.common.text_tables import spreadsheet_text
from rafl.tracking.reconstruction.gap_filling import FILLED, MISSING
from rafl.tracking.reconstruction.tracks import Tracks

Places = Mapping[str, NDArray[np.float64]]  # of markers on the undeformed body [m], (3), by name
Writer = Callable[[Path, Tracks, Places], None]
# Of C3D files: bytes of a block, second byte, processor of our byte order, last frame in the header of a longer file.
C3D_BLOCK_BYTES, C3D_MARK, C3D_INTEL, C3D_MANY_FRAMES = 512, 0x50, 84, 65535
SPECIMEN_FRAME = "(specimen frame)"  # at the end of a TRC file's first line: the positions need no registration


def write_csv(path: Path, tracks: Tracks) -> None:
    """Write a CSV table with one row per frame and marker, in mm."""
    table = tracks.table()
    table["marker"] = table["marker"].map(spreadsheet_text)
    write_text(path, table.to_csv(index=False, float_format="%.6g"))


def write_c3d(path: Path, tracks: Tracks) -> None:
    """Write a C3D file, in mm. The residual is -1 for a missing point, 0 for a filled one, sigma for a measured one."""
    missing = tracks.state == MISSING
    file = ezc3d.c3d()
    points = np.ones((4, len(tracks.names), len(tracks.time)))
    points[:3] = np.where(missing[..., None], 0.0, 1e3 * tracks.position).transpose(2, 1, 0)
    sigma = 1e3 * np.linalg.norm(np.where(missing[..., None], 0.0, tracks.sigma), axis=-1)
    residual = np.where(missing, -1.0, np.where(tracks.state == FILLED, 0.0, sigma))
    parameters = file["parameters"]["POINT"]
    parameters["RATE"]["value"] = [tracks.fps]
    parameters["LABELS"]["value"] = list(tracks.names)
    parameters["UNITS"]["value"] = ["mm"]
    file.add_parameter("RAFL", "FRAME", ["specimen"])  # tells rafl-capture that the positions need no registration
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = residual.T[None]
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, len(tracks.names), len(tracks.time)), dtype=bool)
    with atomic_file(path) as temporary:
        file.write(str(temporary))  # ends quietly where the disk is full
        try:
            check_c3d_length(temporary)
        except InputError:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from None


def check_c3d_length(path: Path) -> None:
    """Check that a C3D file is as long as its header says; the library reads a shorter one as if it were whole.

    Raises:
        InputError: it is shorter, or has no header.
    """
    with path.open("rb") as file:
        head = file.read(C3D_BLOCK_BYTES)
        if len(head) < C3D_BLOCK_BYTES or head[1] != C3D_MARK or not head[0]:
            raise InputError(f"expected a C3D file in {path}, found no header of one; export it again")
        file.seek((head[0] - 1) * C3D_BLOCK_BYTES)
        parameters = file.read(4)
    if len(parameters) == 4 and parameters[3] != C3D_INTEL:
        return  # numbers in another byte order
    points, analog, first, last = struct.unpack_from("<4H", head, 2)
    scale, start = struct.unpack_from("<fH", head, 12)
    frames = max(last - first + 1, 0) if last < C3D_MANY_FRAMES else 0
    expected = (start - 1) * C3D_BLOCK_BYTES + frames * (4 * points + analog) * (4 if scale < 0 else 2)
    found = path.stat().st_size
    if found < expected:
        raise InputError(
            f"{path}: expected {frames} frames of {points} points ({expected} bytes), found {found} bytes; the file is "
            "cut short, copy or export it again"
        )


def write_trc(path: Path, tracks: Tracks) -> None:
    """Write OpenSim's TRC table, in mm. Cells of missing markers stay empty."""
    rate, frames, markers = f"{tracks.fps:.6g}", len(tracks.time), len(tracks.names)
    keys = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name} {SPECIMEN_FRAME}",
        keys.replace(" ", "\t"),
        "\t".join([rate, rate, str(frames), str(markers), "mm", rate, "1", str(frames)]),
        "Frame#\tTime\t" + "\t\t\t".join(tracks.names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(markers) for axis in "XYZ"),
        "",
    ]
    for frame in range(frames):
        cells = [f"{1e3 * x:.5f}" if np.isfinite(x) else "" for x in tracks.position[frame].ravel()]
        lines.append("\t".join([str(frame + 1), f"{tracks.time[frame]:.6f}", *cells]))
    write_text(path, "\n".join(lines) + "\n")


def write_npy(path: Path, tracks: Tracks, places: Places) -> None:
    """Write the paper authors' array (1 + T, M, 3), in mm, NaN where missing.

    Row 0 has the places of the markers on the undeformed body, NaN where they are not known.
    """
    rest = np.array([places.get(name, np.full(3, np.nan)) for name in tracks.names]).reshape(1, -1, 3)
    content = io.BytesIO()
    np.save(content, 1e3 * np.concatenate([rest, tracks.position]))
    write_bytes(path, content.getbuffer())


def _without_places(write: Callable[[Path, Tracks], None]) -> Writer:
    return lambda path, tracks, places: write(path, tracks)


WRITERS: dict[str, Writer] = {
    "csv": _without_places(write_csv),
    "c3d": _without_places(write_c3d),
    "trc": _without_places(write_trc),
    "npy": write_npy,
}


def export_name(kind: str, recording: str, number: int) -> str:
    """File name of a recording's export. `number` is that of the recording, by which the authors name their arrays."""
    return f"q{number}.npy" if kind == "npy" else f"{recording}.{kind}"
