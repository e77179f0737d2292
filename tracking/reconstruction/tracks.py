"""The tracks file: 3-D markers of one recording over time."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.common.files import require_file, whole_file
from rafl.common.version import VERSION
from rafl.common.yaml_files import check_format

Array = NDArray[Any]

FORMAT = "rafl-tracks/1"
OF_CAMERA = ("pixel", "residual", "pixel_sigma", "damaged", "frame")


@dataclass(frozen=True)
class Tracks:
    """Markers of one recording, world frame.

    Attributes:
        names: of the markers, (M).
        time: [s], (T).
        position: [m], (T, M, 3), NaN where missing.
        sigma: one standard deviation [m], (T, M, 3).
        state: 0 missing, 1 measured, 2 filled, (T, M).
        pixel: by camera (T, M, 2) [px], NaN where not seen.
        residual: reprojection residual by camera, (T, M) [px].
        pixel_sigma: one standard deviation of each coordinate by camera, (T, M, 2) [px].
        damaged: frames by camera that could not be decoded, (T).
        frame: by camera, the number in its video of the frame shown at each time, -1 for none, (T).
        pictures: by camera, the first frame and the worst, by number, as JPEG.
        fps: frames per second.
        calibration: text of calib.yaml; empty for positions from elsewhere.
        sources: SHA-256 by source file.
        settings: text of the settings used.
        notes: what the videos said that contradicts itself.
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
    pictures: dict[str, dict[int, bytes]]
    fps: float
    calibration: str
    sources: dict[str, str]
    settings: str
    notes: tuple[str, ...] = ()
    version: str = VERSION

    def rows(self, camera: str) -> dict[int, int]:
        """The first row that shows each frame of a camera's video, by the frame's number."""
        return {number: row for row, number in reversed(list(enumerate(self.frame[camera].tolist())))}


def write_tracks(path: Path, tracks: Tracks) -> None:
    """Write a tracks file, whole or not at all."""
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
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
                "sources": np.array([f"{h}  {n}" for n, h in tracks.sources.items()], h5py.string_dtype()),
            }
        )
        for key in ("time", "position", "sigma", "state"):
            file.create_dataset(key, data=getattr(tracks, key), fletcher32=True)
        for name in tracks.pixel:
            for key in OF_CAMERA:
                file.create_dataset(f"cameras/{name}/{key}", data=getattr(tracks, key)[name], fletcher32=True)
            for number, picture in sorted(tracks.pictures[name].items()):
                file[f"cameras/{name}/pictures/{number}"] = np.frombuffer(picture, np.uint8)


def read_tracks(path: Path) -> Tracks:
    """Read a tracks file.

    Raises:
        InputError: missing, not a tracks file, newer, or damaged.
    """
    require_file(path, "a tracks file (.h5)")
    try:
        with h5py.File(path, "r") as file:
            check_format(str(file.attrs.get("format", "")), FORMAT, path)
            cameras = file.get("cameras", {})
            lines = [str(line).split("  ", 1) for line in file.attrs["sources"]]
            of_camera = {key: {name: group[key][()] for name, group in cameras.items()} for key in OF_CAMERA}
            pictures = {
                name: {int(number): bytes(data[()]) for number, data in group.get("pictures", {}).items()}
                for name, group in cameras.items()
            }
            return Tracks(
                names=tuple(str(name) for name in file.attrs["marker_names"]),
                time=file["time"][()],
                position=file["position"][()],
                sigma=file["sigma"][()],
                state=file["state"][()],
                pixel=of_camera["pixel"],
                residual=of_camera["residual"],
                pixel_sigma=of_camera["pixel_sigma"],
                damaged=of_camera["damaged"],
                frame=of_camera["frame"],
                pictures=pictures,
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
