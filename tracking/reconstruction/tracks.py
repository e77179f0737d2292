"""The tracks file: 3-D markers of one recording over time."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.common.files import atomic_file, require_file
from rafl.common.marker_table import marker_table
from rafl.common.version import VERSION
from rafl.common.yaml_files import check_format

Array = NDArray[Any]

FORMAT = "rafl-tracks/1"
STATES = ("missing", "measured", "filled")  # words for the values of `Tracks.state`
PER_CAMERA_ARRAYS = ("pixel", "residual", "pixel_sigma", "damaged", "frame")


@dataclass(frozen=True)
class Tracks:
    """Markers of one recording, in the world frame. A `sigma` is one standard deviation of the error.

    Attributes:
        names: of the markers, (M).
        time: [s], (T).
        position: [m], (T, M, 3), NaN where missing.
        sigma: of the position [m], (T, M, 3).
        state: 0 missing, 1 measured, 2 filled, (T, M).
        pixel: by camera, (T, M, 2) [px], NaN where not seen.
        residual: reprojection residual by camera, (T, M) [px].
        pixel_sigma: of each pixel coordinate by camera, (T, M, 2) [px].
        damaged: by camera, whether the frame could not be decoded, (T).
        frame: by camera, the number in its video of the frame shown at each time, -1 for none, (T).
        images: by camera, the first and the worst frames, by frame number, as JPEG.
        fps: frames per second.
        calibration: text of calib.yaml; empty for positions from elsewhere.
        sources: SHA-256 by source file.
        settings: text of the settings used.
        notes: on contradictory video data, damaged frames and clock delays.
        version: of the program that tracked.
    """

    names: tuple[str, ...]
    time: Array
    position: Array
    sigma: Array
    state: NDArray[np.uint8]
    pixel: dict[str, Array]
    residual: dict[str, Array]
    pixel_sigma: dict[str, Array]
    damaged: dict[str, NDArray[np.bool_]]
    frame: dict[str, NDArray[np.int64]]
    images: dict[str, dict[int, bytes]]
    fps: float
    calibration: str
    sources: dict[str, str]
    settings: str
    notes: tuple[str, ...] = ()
    version: str = VERSION

    def table(self) -> pd.DataFrame:
        """One row per frame and marker: frame, time_s, marker, x_mm, ..., sigma_x_mm, ..., state (in words)."""
        table = marker_table(self.time, self.names, self.position)
        for axis, name in enumerate("xyz"):
            table[f"sigma_{name}_mm"] = 1e3 * self.sigma[..., axis].ravel()
        table["state"] = np.array(STATES, dtype=object)[self.state.ravel()]
        return table

    def rows_by_frame(self, camera: str) -> dict[int, int]:
        """By frame number in a camera's video, the first row (index along T) that shows the frame."""
        return {number: row for row, number in reversed(list(enumerate(self.frame[camera].tolist())))}


def write_tracks(path: str | Path, tracks: Tracks) -> None:
    """Write a tracks file, completely or not at all."""
    path = Path(path)
    sources = [f"{digest}  {name}" for name, digest in tracks.sources.items()]
    with atomic_file(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(
            {
                "format": FORMAT,
                "marker_names": np.array(tracks.names, dtype=h5py.string_dtype()),
                "fps": tracks.fps,
                "units": "s, m, px; world frame of the calibration",
                "calibration": tracks.calibration,
                "software": f"rafl {tracks.version}",
                "settings": tracks.settings,
                "notes": np.array(tracks.notes, dtype=h5py.string_dtype()),
                "sources": np.array(sources, h5py.string_dtype()),
            }
        )
        for key in ("time", "position", "sigma", "state"):
            file.create_dataset(key, data=getattr(tracks, key), fletcher32=True)
        for name in tracks.pixel:
            for key in PER_CAMERA_ARRAYS:
                file.create_dataset(f"cameras/{name}/{key}", data=getattr(tracks, key)[name], fletcher32=True)
            for number, image in sorted(tracks.images[name].items()):
                file[f"cameras/{name}/pictures/{number}"] = np.frombuffer(image, np.uint8)


def read_tracks(path: str | Path) -> Tracks:
    """Read a tracks file.

    Raises:
        InputError: the file is missing, no tracks file, of a newer version, or damaged.
    """
    path = Path(path)
    require_file(path, "a tracks file (.h5)")
    try:
        with h5py.File(path, "r") as file:
            check_format(str(file.attrs.get("format", "")), FORMAT, path)
            cameras = file.get("cameras", {})
            lines = [str(line).split("  ", 1) for line in file.attrs["sources"]]
            by_camera = {key: {name: group[key][()] for name, group in cameras.items()} for key in PER_CAMERA_ARRAYS}
            images = {
                name: {int(number): bytes(data[()]) for number, data in group.get("pictures", {}).items()}
                for name, group in cameras.items()
            }
            return Tracks(
                names=tuple(str(name) for name in file.attrs["marker_names"]),
                time=file["time"][()],
                position=file["position"][()],
                sigma=file["sigma"][()],
                state=file["state"][()],
                pixel=by_camera["pixel"],
                residual=by_camera["residual"],
                pixel_sigma=by_camera["pixel_sigma"],
                damaged=by_camera["damaged"],
                frame=by_camera["frame"],
                images=images,
                fps=float(file.attrs["fps"]),
                calibration=str(file.attrs["calibration"]),
                sources={name: digest for digest, name in lines},
                settings=str(file.attrs["settings"]),
                notes=tuple(str(note) for note in file.attrs["notes"]),
                version=str(file.attrs["software"]).removeprefix("rafl "),
            )
    except (OSError, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"expected tracks written by rafl-track in {path}, which cannot be read: {reason}; track again"
        ) from None
