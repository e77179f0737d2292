"""One open recording: its tracks, its corrections, its frames, and who may correct it."""

import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.rig import Rig, parse_calibration
from rafl.common.errors import InputError
from rafl.common.files import require_writable
from rafl.review.server import ReadOnlyError
from rafl.review.tracks.frames import FrameStore
from rafl.tracking.reconstruction.corrected_tracks import apply_corrections, is_doubtful, left_out
from rafl.tracking.reconstruction.corrections import (
    Correction,
    corrections_path,
    corrections_text,
    read_corrections,
    write_corrections,
)
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks
from rafl.tracking.video.reader import Video

Array = NDArray[Any]

# Pages say every few seconds that they are there; browsers let pages in the background do so once a minute.
CLAIM_S = 70.0

FindVideo = Callable[[str, str, Tracks], Video]


class OpenRecording:
    """A recording in memory.

    Attributes:
        raw: the tracks as tracked.
        found: the tracks with the corrections.
        revision: grows with every change, also beyond the time for which the recording is open.
        editing: lock that whoever changes corrections holds.
    """

    def __init__(self, path: Path, who: str, find_video: FindVideo) -> None:
        self.path, self.who, self.find_video = path, who, find_video
        self.stamp = path.stat().st_mtime_ns
        self.raw = read_tracks(path)
        self.beside = corrections_path(path)
        self.corrections = read_corrections(self.beside)
        self.text = self.beside.read_bytes() if self.beside.exists() else None
        self.found = apply_corrections(self.raw, self.corrections, path)
        self.undone: list[tuple[Correction, ...]] = []
        self.revision = time.time_ns() // 1_000_000
        self.editing = threading.RLock()
        self.stores: dict[str, FrameStore] = {}
        self.opening = threading.Lock()
        self.claim: tuple[str, float] = ("", -np.inf)
        self.used = time.monotonic()
        self.locked = _reason_to_lock(self.beside)

    @cached_property
    def rig(self) -> Rig | None:
        """The cameras with which it was tracked; None if the tracks do not hold them."""
        try:
            return parse_calibration(self.raw.calibration, self.path) if self.raw.calibration else None
        except InputError:
            return None

    @property
    def tracks(self) -> Tracks:
        """The tracks with the corrections."""
        return self.found.tracks

    def is_changed(self) -> bool:
        """Whether another program has changed the files."""
        with self.editing:
            on_disk = self.beside.read_bytes() if self.beside.exists() else None
            return not self.path.exists() or self.path.stat().st_mtime_ns != self.stamp or on_disk != self.text

    def frames(self, camera: str) -> FrameStore:
        """The frames of a camera.

        Raises:
            InputError: there is no such camera, or its video is not there or another one.
        """
        with self.opening:
            if camera not in self.stores:
                if camera not in self.raw.pixel:
                    raise InputError(f"expected a camera of the tracks, found {camera!r:.80}; load the page again")
                self.stores[camera] = FrameStore(self.find_video(self.path.stem, camera, self.raw))
            return self.stores[camera]

    def close(self) -> None:
        """Close the videos."""
        with self.opening:
            for store in self.stores.values():
                store.close()
            self.stores.clear()

    def claim_for(self, page: str) -> bool:
        """Whether a page may correct the recording: the first that asked, until it leaves."""
        with self.editing:
            holder, since = self.claim
            if page == holder or time.monotonic() - since > CLAIM_S:
                self.claim = (page, time.monotonic())
            return self.claim[0] == page

    def take_over(self, page: str) -> None:
        """A page corrects the recording from now on, whichever did before."""
        with self.editing:
            self.claim = (page, time.monotonic())

    def release(self, page: str) -> None:
        """A page leaves."""
        with self.editing:
            if self.claim[0] == page:
                self.claim = ("", -np.inf)

    def require_claim(self, page: str) -> None:
        """Raise `ReadOnlyError` unless a page may correct the recording."""
        if not self.claim_for(page):
            raise ReadOnlyError(
                "another page has this recording open; close it there, or take it over, to correct it here"
            )

    def next_moment(self) -> datetime:
        """The time of a new correction, later than all others: corrections of one time are undone together."""
        now = datetime.now(UTC)
        now = now.replace(microsecond=now.microsecond // 1000 * 1000)
        latest = max((entry.at for entry in self.corrections), default=now - timedelta(days=1))
        return now if now > latest else latest + timedelta(milliseconds=1)

    def add(self, entries: tuple[Correction, ...]) -> None:
        """Add corrections.

        Raises:
            InputError: they do not fit the tracks, or cannot be written.
        """
        self._replace((*self.corrections, *entries), len(entries))
        self.undone.clear()

    def replace_last(self, entry: Correction) -> None:
        """Replace the last correction by one that goes on from it."""
        self._replace((*self.corrections[:-1], entry), 1)

    def keep(self, number: int) -> None:
        """A correction that was made on other tracks holds for these.

        Raises:
            InputError: there is no such correction.
        """
        entry = self._doubtful(number).model_copy(update={"tracks": self.found.digest})
        self._replace((*self.corrections[:number], entry, *self.corrections[number + 1 :]), 0)
        self.undone.clear()

    def drop(self, number: int) -> None:
        """A correction that was made on other tracks does not hold for these: it is taken out.

        Raises:
            InputError: there is no such correction.
        """
        self._doubtful(number)
        self._replace((*self.corrections[:number], *self.corrections[number + 1 :]), 0)
        self.undone.clear()

    def _doubtful(self, number: int) -> Correction:
        if not (0 <= number < len(self.corrections) and is_doubtful(self.corrections[number], self.found.digest)):
            raise InputError("expected a correction that was made on other tracks, found none; load the page again")
        return self.corrections[number]

    def undo(self) -> bool:
        """Take back the last correction, and those made together with it; False if there is none."""
        if not self.corrections:
            return False
        moment = self.corrections[-1].at
        first = len(self.corrections)
        while first and self.corrections[first - 1].at == moment:
            first -= 1
        taken = self.corrections[first:]
        self._replace(self.corrections[:first], 0)
        self.undone.append(taken)
        return True

    def redo(self) -> bool:
        """Make the correction again that was taken back last; False if there is none."""
        if not self.undone:
            return False
        entries = self.undone[-1]
        self._replace((*self.corrections, *entries), len(entries))
        self.undone.pop()
        return True

    def _replace(self, corrections: tuple[Correction, ...], new: int) -> None:
        """Write the corrections, of which the last `new` must fit the tracks, and apply them."""
        if self.is_changed():
            raise InputError(f"{self.path.stem} was tracked or corrected by another program; load the page again")
        found = apply_corrections(self.raw, corrections, self.path, self.found)
        for number in range(len(corrections), len(corrections) - new, -1):
            begin = left_out(number, corrections[number - 1])
            for line in found.unfit:
                if line.startswith(begin):
                    raise InputError(line.removeprefix(begin))
        write_corrections(self.beside, corrections)
        self.text = corrections_text(corrections).encode()
        self.corrections, self.found = corrections, found
        self.revision += 1


def _reason_to_lock(path: Path) -> str:
    """Why no corrections can be written to a file; empty if they can."""
    try:
        require_writable(path)
    except InputError as error:
        return str(error)
    return ""
