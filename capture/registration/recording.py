"""Marker positions of one recording before its registration to a specimen."""

from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from rafl.data.views import View

Array = NDArray[Any]


@dataclass(frozen=True)
class Recording:
    """Marker positions of one recording, in the coordinate frame of the file.

    Attributes:
        names: of the markers, (M); None if the file has none.
        time: [s], (T).
        position: [m], (T, M, 3), NaN where missing.
        sigma: [m], (T, M, 3).
        rest: positions of the undeformed specimen in the same frame [m], (M, 3), if recorded.
        in_specimen_frame: whether a calibration has put the positions into the specimen frame.
        source: file name and SHA-256.
        corrections: how many corrections by a person the positions contain, their file and its SHA-256.
        unfit_corrections: those that do not fit the tracks and were left out, or that were made on other tracks.
        views: what each camera measured, by its name, with the camera in the frame of the file; empty if not known.
    """

    names: tuple[str, ...] | None
    time: Array
    position: Array
    sigma: Array
    rest: Array | None
    in_specimen_frame: bool
    source: str
    corrections: str = ""
    unfit_corrections: str = ""
    views: dict[str, View] = field(default_factory=dict)
