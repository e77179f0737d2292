"""`<recording>.corrections.yaml`: what a person corrected in tracks. The tracks file itself stays as tracked."""

from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import AfterValidator, AwareDatetime, Field, model_validator

from rafl.common.errors import InputError
from rafl.common.files import write_text
from rafl.common.names import Name, check_visible
from rafl.common.yaml_files import LARGEST, MAX_YAML_BYTES, StrictModel, read_yaml

Array = NDArray[Any]

FORMAT = "rafl-corrections/1"
SUFFIX = ".corrections.yaml"
LABEL = "corrections of tracks"

Frame = Annotated[int, Field(ge=0)]  # number in the camera's video


def _check_path(text: str) -> str:
    rows = [line.split() for line in text.splitlines()]
    if not rows or any(len(row) != 5 for row in rows):
        raise ValueError("expected lines of frame, x, y, sigma of x, sigma of y")
    try:
        numbers = np.array(rows, dtype=float)
    except ValueError:
        raise ValueError("expected lines of five numbers, found other text") from None
    if not (np.isfinite(numbers).all() and np.abs(numbers).max() < LARGEST and (numbers[:, 3:] > 0.0).all()):
        raise ValueError("expected finite positions and positive sigmas")
    frames = numbers[:, 0]
    if frames[0] < 0 or (frames % 1).any() or (np.diff(frames) <= 0).any():
        raise ValueError("expected ascending frame numbers")
    return text


class _Correction(StrictModel):
    """Who made a correction, when, and in which camera.

    Attributes:
        by: name of the person.
        at: date and time.
        camera: whose frames the frame numbers count.
        tracks: digest of the tracks on which it was made (`tracks_digest`); empty in files of earlier programs.
    """

    by: Annotated[str, AfterValidator(check_visible)]
    at: AwareDatetime
    camera: Name
    tracks: Annotated[str, Field(pattern="^([0-9a-f]{64})?$")] = ""


class _Stretch(_Correction):
    """A marker in frames `first` to `last`."""

    marker: Name
    first: Frame
    last: Frame

    @model_validator(mode="after")
    def _check_order(self) -> "_Stretch":
        if self.last < self.first:
            raise ValueError(f"expected a last frame of {self.first} or later, found {self.last}")
        return self


class Place(_Correction):
    """Positions of a marker.

    Attributes:
        marker: its name.
        new: whether the tracker did not find the marker at all.
        how: fitted to a dot, set by hand, or followed from frame to frame.
        path: a line per frame: frame, x, y, sigma of x, sigma of y [px].
    """

    kind: Literal["place"] = "place"
    marker: Name
    new: bool = False
    how: Literal["fit", "hand", "followed"]
    path: Annotated[str, AfterValidator(_check_path)]

    @property
    def positions(self) -> Array:
        """`path` as numbers, (F, 5)."""
        return _path_numbers(self.path)


class Delete(_Stretch):
    """A marker is not seen in the frames."""

    kind: Literal["delete"] = "delete"


class Accept(_Stretch):
    """Somebody has looked at the frames and leaves the marker as it is there."""

    kind: Literal["accept"] = "accept"


class Swap(_Correction):
    """Two markers have each other's dots from frame `first` on."""

    kind: Literal["swap"] = "swap"
    markers: tuple[Name, Name]
    first: Frame

    @model_validator(mode="after")
    def _check_two(self) -> "Swap":
        if self.markers[0] == self.markers[1]:
            raise ValueError("expected two markers, found one twice")
        return self


class Rename(_Correction):
    """A marker gets another name, in all cameras."""

    kind: Literal["rename"] = "rename"
    marker: Name
    to: Name


Correction = Place | Delete | Accept | Swap | Rename


class _CorrectionsFile(StrictModel):
    format: str
    corrections: list[Annotated[Correction, Field(discriminator="kind")]]


@lru_cache(maxsize=4096)
def _path_numbers(path: str) -> Array:
    """Numbers of a path, kept beside the corrections: an array among their fields would make them incomparable."""
    numbers = np.array([line.split() for line in path.splitlines()], dtype=float)
    numbers.setflags(write=False)
    return numbers


def path_text(frames: Array, pixel: Array, sigma: Array) -> str:
    """`Place.path` of frames (F), positions (F, 2) and sigmas (F, 2) [px]."""
    rows = np.column_stack([pixel, sigma])
    return "".join(
        f"{int(frame)} {x:.4f} {y:.4f} {max(a, 1e-4):.4f} {max(b, 1e-4):.4f}\n"
        for frame, (x, y, a, b) in zip(frames, rows, strict=True)
    )


def corrections_path(tracks: Path) -> Path:
    """The file of the corrections of a tracks file."""
    return tracks.with_name(tracks.stem + SUFFIX)


def read_corrections(path: Path) -> tuple[Correction, ...]:
    """The corrections in a file, in the order in which they are made; none if there is no file.

    Raises:
        InputError: the file is damaged or of a newer version.
    """
    if not path.exists():
        return ()
    return tuple(read_yaml(path, _CorrectionsFile, LABEL, FORMAT).corrections)


def corrections_text(corrections: tuple[Correction, ...]) -> str:
    """The content of a file of corrections."""
    if not corrections:
        return f"format: {FORMAT}\ncorrections: []\n"
    return f"format: {FORMAT}\ncorrections:\n" + "".join(map(_entry_text, corrections))


def write_corrections(path: Path, corrections: tuple[Correction, ...]) -> None:
    """Write a file of corrections, completely or not at all.

    Raises:
        InputError: the file cannot be written, or would be too large to be read again.
    """
    text = corrections_text(corrections)
    if len(text.encode()) > MAX_YAML_BYTES:  # far more than a person corrects, except by following many markers on
        raise InputError(
            f"{path}: expected at most {MAX_YAML_BYTES / 1e6:g} MB of corrections, found more; take the last one back"
        )
    write_text(path, text)


class _Dumper(yaml.SafeDumper):
    """Writes texts of several lines as they are."""


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.Node:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None)


_Dumper.add_representer(str, _represent_text)


@lru_cache(maxsize=4096)
def _entry_text(correction: Correction) -> str:
    values = correction.model_dump(exclude_defaults=True)
    entry: dict[str, Any] = {"kind": correction.kind} | {
        key: value.isoformat(timespec="milliseconds")
        if isinstance(value, datetime)
        else list(value)
        if isinstance(value, tuple)
        else value
        for key, value in values.items()
    }
    return yaml.dump([entry], Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=10**6)
