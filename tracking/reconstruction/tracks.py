"""The tracks file: 3-D markers of one recording over time."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import h5py
import numpy as np
import pandas as pd
import pydantic
from numpy.typing import NDArray

from rafl.common.arrays import ArrayFormat, read_arrays
from rafl.common.hdf5_files import read_hdf5, write_hdf5
from rafl.common.marker_table import marker_table
from rafl.common.names import check_names, require_names
from rafl.common.version import VERSION
from rafl.common.yaml_files import check_format
from rafl.tracking.reconstruction.triangulation import HALF_FRAME, SAME_TIME_FRAMES

Array = NDArray[Any]

FORMAT = "rafl-tracks/2"
STATES = ("missing", "measured", "filled")  # words for the values of `Tracks.state`
LABEL = "tracks written by rafl-track"  # in messages about unreadable files
# The arrays of a tracks file and of each camera in it. T: frames, M: markers, S: frames of the camera's video.
TRACKS_ARRAYS = {
    "time": ArrayFormat(("T",)),
    "position": ArrayFormat(("T", "M", 3), finite=False),
    "sigma": ArrayFormat(("T", "M", 3), finite=False, low=0.0),
    "state": ArrayFormat(("T", "M"), "integer", low=0, high=len(STATES) - 1),
}
CAMERA_ARRAYS = {
    "pixel": ArrayFormat(("T", "M", 2), finite=False),
    "residual": ArrayFormat(("T", "M"), finite=False),
    "pixel_sigma": ArrayFormat(("T", "M", 2), finite=False, low=0.0),
    "damaged": ArrayFormat(("T",), "truth"),
    "frame": ArrayFormat(("T",), "integer", low=-1),
    "lag": ArrayFormat(("T",), optional=True),
}
# Of a camera whose frames do not coincide with the rows.
FILMED_ARRAYS = {
    "filmed_time": ArrayFormat(("S",), optional=True),
    "filmed_pixel": ArrayFormat(("S", "M", 2), finite=False, low=-1e6, high=1e6, optional=True),
    "filmed_sigma": ArrayFormat(("S", "M", 2), finite=False, low=1e-6, high=1e6, optional=True),
}
MAX_LAG_FRAMES = 1.05 * HALF_FRAME  # of a frame to the row that shows it; cameras' frame rates may be rounded
SAME_INSTANT_FRAMES = 1e-3  # difference of two statements about the time of a frame that rounding explains
PICTURE = ArrayFormat(("bytes",), "integer", low=0, high=255)


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
        videos: by camera, the path of the video; empty where not known, as in files of earlier programs.
        lag: by camera, time of the frame shown minus that of the row [s], (T); empty where not known.
        filmed_time: by camera whose frames do not coincide with the rows, the times of all its frames on the clock of
            `time` [s], (S). Its `pixel` is then one at the times of the rows, interpolated between frames.
        filmed_pixel: by these cameras, as measured in their frames, (S, M, 2) [px], NaN where not seen.
        filmed_sigma: of each coordinate, (S, M, 2) [px].
        longest_gap: that was filled [frames]; None where not known.

    Raises:
        InputError: the name of a marker or camera is invalid.
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
    videos: dict[str, str] = field(default_factory=dict)
    lag: dict[str, Array] = field(default_factory=dict)
    filmed_time: dict[str, Array] = field(default_factory=dict)
    filmed_pixel: dict[str, Array] = field(default_factory=dict)
    filmed_sigma: dict[str, Array] = field(default_factory=dict)
    longest_gap: int | None = None

    def __post_init__(self) -> None:
        require_names(self.names, "markers of tracks")
        require_names(self.pixel, "cameras of tracks")

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

    def in_frames(self, camera: str) -> tuple[Array, Array]:
        """Pixels and sigmas [px], (T, M, 2) each, in the frame of a camera that each row shows; NaN where not seen."""
        if camera not in self.filmed_time:
            return self.pixel[camera], self.pixel_sigma[camera]
        frame = self.frame[camera]
        shown = (frame >= 0)[:, None, None]
        pixel, sigma = self.filmed_pixel[camera][frame], self.filmed_sigma[camera][frame]
        return np.where(shown, pixel, np.nan), np.where(shown, sigma, np.nan)

    def lacks_filmed(self, camera: str) -> bool:
        """Whether a camera's pixels are interpolated between its frames, and those of the frames are not known.

        So it is in files of earlier programs.
        """
        lag = self.lag.get(camera)
        late = lag is not None and bool((np.abs(lag) * self.fps >= SAME_TIME_FRAMES).any())
        return late and camera not in self.filmed_time


def write_tracks(path: str | Path, tracks: Tracks) -> None:
    """Write a tracks file, completely or not at all.

    Raises:
        InputError: the file cannot be written, or could not be read again.
    """
    path = Path(path)
    sources = [f"{digest}  {name}" for name, digest in tracks.sources.items()]
    with write_hdf5(path, read_tracks) as file:
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
        if tracks.longest_gap is not None:
            file.attrs["longest_gap"] = tracks.longest_gap
        for key in TRACKS_ARRAYS:
            file.create_dataset(key, data=getattr(tracks, key), fletcher32=True)
        for name in tracks.pixel:
            for key in CAMERA_ARRAYS | FILMED_ARRAYS:
                if name in getattr(tracks, key):
                    file.create_dataset(f"cameras/{name}/{key}", data=getattr(tracks, key)[name], fletcher32=True)
            if name in tracks.videos:
                file[f"cameras/{name}"].attrs["video"] = os.path.relpath(tracks.videos[name], path.parent)
            for number, image in sorted(tracks.images[name].items()):
                file[f"cameras/{name}/pictures/{number}"] = np.frombuffer(image, np.uint8)


def read_tracks(path: str | Path) -> Tracks:
    """Read a tracks file.

    Raises:
        InputError: the file is missing, no tracks file, of a newer version, or damaged.
    """
    path = Path(path)
    with read_hdf5(path, LABEL, "track again") as file:
        check_format(str(file.attrs.get("format", "")), FORMAT, path)
        return _read(file, path.parent)


class _FileAttributes(pydantic.BaseModel):
    """Attributes of a tracks file."""

    model_config = pydantic.ConfigDict(allow_inf_nan=False)

    marker_names: tuple[str, ...] = pydantic.Field(min_length=1)
    fps: float = pydantic.Field(gt=0)
    calibration: str
    settings: str
    software: str
    notes: tuple[str, ...]
    sources: tuple[Annotated[str, pydantic.Field(pattern="^[0-9a-f]+  ")], ...]
    longest_gap: int | None = pydantic.Field(None, ge=0)


def _read(file: h5py.File, folder: Path) -> Tracks:
    """The content of an open file in a folder.

    Raises:
        ValueError: a part differs from its description, or parts contradict one another.
    """
    about = _FileAttributes.model_validate(
        {key: value.tolist() if hasattr(value, "tolist") else value for key, value in file.attrs.items()}
    )
    check_names(about.marker_names)
    lengths = {"M": len(about.marker_names)}
    arrays = read_arrays(file, TRACKS_ARRAYS, lengths)
    time, measured = arrays["time"], arrays["state"] > 0
    if len(time) < 1 or (np.diff(time) <= 0).any():
        raise ValueError("time: expected one frame or more, each later than the one before")
    if not np.isfinite(arrays["position"][measured]).all():
        raise ValueError("position: expected finite numbers where the state is not missing")
    cameras = file.get("cameras", {})
    check_names(cameras)
    by_camera = {name: _read_camera(group, name, time, about.fps, lengths) for name, group in cameras.items()}
    return Tracks(
        names=about.marker_names,
        time=time,
        position=arrays["position"],
        sigma=arrays["sigma"],
        state=arrays["state"].astype(np.uint8),
        **{
            key: {name: found[key] for name, found in by_camera.items() if key in found}
            for key in CAMERA_ARRAYS | FILMED_ARRAYS
        },
        images={name: _read_images(group, f"cameras/{name}/pictures") for name, group in cameras.items()},
        fps=about.fps,
        calibration=about.calibration,
        sources={name: digest for digest, name in (line.split("  ", 1) for line in about.sources)},
        settings=about.settings,
        notes=about.notes,
        version=about.software.removeprefix("rafl "),
        videos={
            name: os.path.normpath(folder / str(group.attrs["video"]))
            for name, group in cameras.items()
            if "video" in group.attrs
        },
        longest_gap=about.longest_gap,
    )


def _read_camera(group: h5py.Group, name: str, time: Array, fps: float, lengths: dict[str, int]) -> dict[str, Array]:
    """The arrays of one camera by key.

    Raises:
        ValueError: an array differs from its description, or arrays contradict one another.
    """
    label = f"cameras/{name}"
    found = read_arrays(group, CAMERA_ARRAYS | FILMED_ARRAYS, dict(lengths), f"{label}/")
    frame, lag = found["frame"], found.get("lag")
    shown = frame >= 0
    if lag is not None and (late := np.abs(lag[shown]).max(initial=0.0)) * fps > MAX_LAG_FRAMES:
        raise ValueError(f"{label}/lag: expected times within half a frame interval of the rows', found {late:g} s")
    there = FILMED_ARRAYS.keys() & found.keys()
    if not there:
        return found
    if lag is None or len(there) < len(FILMED_ARRAYS):
        lacking = sorted(({"lag"} | FILMED_ARRAYS.keys()) - found.keys())
        raise ValueError(f"expected the array {label}/{lacking[0]} beside {label}/{min(there)}, found none")
    own = found["filmed_time"]
    if len(own) < 2 or (np.diff(own) <= 0.0).any():
        raise ValueError(f"{label}/filmed_time: expected two frames or more, each later than the one before")
    if frame.max(initial=-1) >= len(own):
        raise ValueError(f"{label}/frame: expected frames up to {len(own) - 1} as in filmed_time, found {frame.max()}")
    if np.abs(own[frame] - time - lag)[shown].max(initial=0.0) * fps > SAME_INSTANT_FRAMES:
        raise ValueError(f"{label}/lag: expected filmed_time minus time, found another time of a frame")
    return found


def _read_images(camera: h5py.Group, label: str) -> dict[int, bytes]:
    """The JPEG images of a camera by frame number."""
    stored = camera.get("pictures", {})
    arrays = {key: read_arrays(stored, {key: PICTURE}, {}, f"{label}/")[key] for key in stored}
    return {int(number): image.astype(np.uint8).tobytes() for number, image in arrays.items()}
