"""Tracks in other programs' formats."""

from collections.abc import Callable
from pathlib import Path

import ezc3d
import numpy as np
import pandas as pd
from rafl.tracking.reconstruction.gap_filling import FILLED, MISSING
from rafl.tracking.reconstruction.tracks import Tracks

from rafl.common.files import whole_file, write_text

STATES = ("missing", "measured", "filled")


def write_csv(path: Path, tracks: Tracks) -> None:
    """One row a frame and marker, in mm."""
    frames, markers = tracks.state.shape
    table = pd.DataFrame(
        {
            "frame": np.repeat(np.arange(frames), markers),
            "time_s": np.repeat(tracks.time, markers),
            "marker": np.tile(np.array(tracks.names, dtype=object), frames),
        }
    )
    for axis, name in enumerate("xyz"):
        table[f"{name}_mm"] = 1e3 * tracks.position[..., axis].ravel()
    for axis, name in enumerate("xyz"):
        table[f"sigma_{name}_mm"] = 1e3 * tracks.sigma[..., axis].ravel()
    table["state"] = np.array(STATES, dtype=object)[tracks.state.ravel()]
    with whole_file(path) as temporary:
        table.to_csv(temporary, index=False, float_format="%.6g")


def write_c3d(path: Path, tracks: Tracks) -> None:
    """Points in mm; a missing point has residual -1, a filled one 0, a measured one its sigma."""
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
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = residual.T[None]
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, len(tracks.names), len(tracks.time)), dtype=bool)
    with whole_file(path) as temporary:
        file.write(str(temporary))


def write_trc(path: Path, tracks: Tracks) -> None:
    """OpenSim's table, in mm; cells of missing markers stay empty."""
    rate, frames, markers = f"{tracks.fps:.6g}", len(tracks.time), len(tracks.names)
    keys = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
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


def write_npy(path: Path, tracks: Tracks) -> None:
    """The paper authors' array (T, M, 3) in mm, NaN where missing."""
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.save(stream, 1e3 * tracks.position)


WRITERS: dict[str, Callable[[Path, Tracks], None]] = {
    "csv": write_csv,
    "c3d": write_c3d,
    "trc": write_trc,
    "npy": write_npy,
}


def export_name(kind: str, recording: str, number: int) -> str:
    """File name of a recording's export; `number` counts recordings, as the authors' arrays do."""
    return f"q{number}.npy" if kind == "npy" else f"{recording}.{kind}"
