"""The calls by which a specimen is described: corners give the size of the body, its tracks the dots."""

import itertools
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from fastapi import Body, FastAPI
from pydantic import BaseModel, ConfigDict, Field

from rafl.calibration.rig import Rig
from rafl.common.errors import InputError
from rafl.common.names import check_name
from rafl.review.specimen.corners import box_outline, measure_body
from rafl.tracking.reconstruction.corrected_tracks import CorrectedTracks

if TYPE_CHECKING:
    from rafl.review.specimen.description import DescribedSpecimen

SUFFIX = ".yaml"

Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]
Length = Annotated[float, Field(gt=0.0, le=1e5)]


class _Form(BaseModel):
    """The body as it is typed; see `BodyForm`."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    size_mm: tuple[Length, Length, Length]
    element_mm: Length | None = None
    youngs_modulus: Annotated[float, Field(ge=1.0, le=1e12)] | None = None
    density: Annotated[float, Field(ge=1.0, le=1e6)] | None = None
    lying: bool = False
    left_out: Annotated[tuple[str, ...], Field(max_length=1000)] = ()


class _Writing(BaseModel):
    """Which description is written to which file.

    Attributes:
        key: of the description that is shown.
        file: name without the suffix.
        replace_files: whether files of this name are replaced.
    """

    model_config = ConfigDict(extra="forbid")

    key: int
    file: str
    replace_files: bool = False


@dataclass(frozen=True)
class ShownTracks:
    """The tracks that a page shows.

    Attributes:
        path: of their file.
        found: with the corrections.
        rig: the cameras; None if the file does not hold them.
    """

    path: Path
    found: CorrectedTracks
    rig: Rig | None


def add_specimen_calls(app: FastAPI, tracks_of: Callable[[str], ShownTracks], folder: Path) -> None:
    """Add the calls.

    Args:
        app: of the page.
        tracks_of: the tracks of a recording; raises InputError if there are none.
        folder: to which specimens are written.
    """
    described: dict[int, DescribedSpecimen] = {}  # the last one: what is written is what somebody has seen
    keys, describing = itertools.count(1), threading.Lock()

    @app.post("/api/specimen/corners")
    def corners(
        name: str, pixels: Annotated[dict[str, list[tuple[Pixel, Pixel]]], Body(max_length=100)]
    ) -> dict[str, object]:
        rig = tracks_of(name).rig
        if rig is None:
            raise InputError("expected tracks that hold their cameras, found none; track the recording again")
        if unknown := [camera for camera in pixels if camera not in rig.cameras]:
            raise InputError(f"expected a camera of the tracks, found {unknown[0]!r:.80}; load the page again")
        found = measure_body(rig, {camera: np.array(points).reshape(-1, 2) for camera, points in pixels.items()})
        x, y, z = (side or 0.0 for side in found.size_mm)
        return {"size_mm": found.size_mm, "remarks": found.remarks, "outline": box_outline((x, y, z), rig)}

    @app.post("/api/specimen/describe")
    def describe(name: str, form: _Form) -> dict[str, object]:
        from rafl.review.specimen.description import BodyForm, describe_tracks  # it loads torch, which takes seconds

        tracks = tracks_of(name)
        with describing:  # the simulator's kernels use all threads
            found = describe_tracks(tracks.found, tracks.path, BodyForm(**form.model_dump()))
        described.clear()
        key = next(keys)
        described[key] = found
        return {"key": key, "folder": str(folder.resolve()), **found.shown(tracks.rig)}

    @app.post("/api/specimen/write")
    def write(name: str, writing: _Writing) -> dict[str, object]:
        from rafl.review.specimen.description import write_specimen

        found = described.get(writing.key)
        if found is None or found.still != tracks_of(name).path.name:
            raise InputError("expected the description that is shown, found an older one; find the places again")
        try:
            path = folder / (check_name(writing.file) + SUFFIX)
        except ValueError as error:
            raise InputError(f"file: {error}") from None
        with describing:
            there = write_specimen(found, path, writing.replace_files)
        return {"written": not there, "there": [item.name for item in there], "file": str(path.resolve())}
