"""The recordings of a folder of tracks: their names, summaries and videos."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from rafl.common.errors import InputError
from rafl.common.files import sha256
from rafl.common.hdf5_files import read_hdf5
from rafl.common.names import check_name
from rafl.review.tracks.recording import CLAIM_S, OpenRecording
from rafl.tracking.reconstruction.corrections import corrections_path
from rafl.tracking.reconstruction.gap_filling import FILLED, MEASURED, MISSING
from rafl.tracking.reconstruction.tracks import LABEL, Tracks
from rafl.tracking.video.reader import Video, is_video, open_video

Result = TypeVar("Result")

# Recordings whose tracks and frames are kept in memory: those that no page uses, and all.
MAX_UNUSED, MAX_OPEN = 3, 8


class Library:
    """A folder of tracks.

    Args:
        folder: with `<recording>.h5`.
        videos: folder of the videos; None where `rafl-track` found them.
        who: name of the person who corrects.
    """

    def __init__(self, folder: Path, videos: Path | None, who: str) -> None:
        self.folder, self.videos, self.who = folder, videos, who
        self.opened: OrderedDict[str, OpenRecording] = OrderedDict()
        self.opening, self.reading = threading.Lock(), threading.Lock()
        self.digests: dict[tuple[str, int, int], str] = {}

    def names(self) -> list[str]:
        """Names of the recordings, in order. Files that lead out of the folder, or have no valid name, are left out."""
        return sorted(path.stem for path in self.folder.glob("*.h5") if self._is_inside(path))

    def _is_inside(self, path: Path) -> bool:
        try:
            check_name(path.stem)
        except ValueError:
            return False
        return path.is_file() and path.resolve().parent == self.folder.resolve()

    def path(self, name: str) -> Path:
        """The tracks file of a recording.

        Raises:
            InputError: there is no such recording.
        """
        path = self.folder / f"{name}.h5"
        if "/" in name or "\\" in name or "\0" in name or not self._is_inside(path):
            raise InputError("expected the name of a recording in the folder; go back to the list")
        return path

    def summary(self, name: str) -> dict[str, object]:
        """Numbers of frames and markers, shares measured, filled and missing of a recording as tracked.

        Raises:
            InputError: the file cannot be read.
        """
        path = self.path(name)
        return self._read(lambda: _summary(path))

    def _read(self, reading: Callable[[], Result]) -> Result:
        """What reading a tracks file gives. One thread reads at a time, and no error keeps objects of h5py alive.

        Without that h5py stops for good when a thread frees such an object while another one reads.
        """
        with self.reading:
            try:
                return reading()
            except InputError as error:
                message = str(error)
        raise InputError(message)

    def has_corrections(self, name: str) -> bool:
        """Whether there is a file of corrections."""
        return corrections_path(self.folder / f"{name}.h5").is_file()

    def open(self, name: str, anew: bool = False) -> OpenRecording:
        """A recording, read if it is not open yet; with `anew` also if its files were changed meanwhile.

        Raises:
            InputError: there is no such recording, or a file is damaged.
        """
        path = self.path(name)
        with self.opening:
            known = self.opened.get(name)
            if known is not None and not (anew and known.is_changed()):
                known.used = time.monotonic()
                self.opened.move_to_end(name)
                return known
            if known is not None:
                self.opened.pop(name).close()
            found = self._read(lambda: OpenRecording(path, self.who, self._find_video))
            self.opened[name] = found
            while len(self.opened) > MAX_OPEN or self._is_oldest_unused():
                self.opened.popitem(last=False)[1].close()
            return found

    def _is_oldest_unused(self) -> bool:
        """Whether there are many recordings, of which no page has asked for the oldest one lately."""
        oldest = next(iter(self.opened.values()))
        return len(self.opened) > MAX_UNUSED and time.monotonic() - oldest.used > CLAIM_S

    def close(self) -> None:
        """Close all videos."""
        for recording in self.opened.values():
            recording.close()
        self.opened.clear()

    def _find_video(self, recording: str, camera: str, tracks: Tracks) -> Video:
        """The video of a camera, which must be the very one that was tracked.

        Raises:
            InputError: it is not there, or is another one.
        """
        stored = tracks.videos.get(camera)
        places = [Path(stored)] if stored else []
        if self.videos is not None:
            places = list(_named_videos(self.videos, recording, camera))
        there = [path for path in places if path.exists() and is_video(path)]
        if not there:
            where = f"at {places[0]}" if places else "named in the tracks file"
            if self.videos is not None:
                where = f"in {self.videos}"
            raise InputError(f"no video of camera {camera} {where}; give the folder of the videos with --videos")
        for path in there:
            if tracks.sources.get(path.name) == self._digest(path):
                return open_video(path)
        raise InputError(f"{there[0]} is not the video of camera {camera} that was tracked; track it again")

    def _digest(self, path: Path) -> str:
        stat = path.stat()
        key = (str(path), stat.st_mtime_ns, stat.st_size)
        if key not in self.digests:
            self.digests[key] = sha256(path)
        return self.digests[key]


def _summary(path: Path) -> dict[str, object]:
    """See `Library.summary`."""
    with read_hdf5(path, LABEL, "track again") as file:
        states = file["state"]
        if not isinstance(states, h5py.Dataset):
            raise ValueError("state: expected an array, found a group")
        if states.ndim != 2:
            raise ValueError(f"state: expected an array of frames and markers, found {states.ndim} dimensions")
        state = np.asarray(states[()])
        cameras = len(file.get("cameras", {}))
    shares = {
        word: float((state == value).mean()) if state.size else 0.0
        for word, value in (("measured", MEASURED), ("filled", FILLED), ("missing", MISSING))
    }
    return {"frames": state.shape[0], "markers": state.shape[1], "cameras": cameras} | shares


def _named_videos(folder: Path, recording: str, camera: str) -> list[Path]:
    """Videos in a folder that have the name of a recording's camera."""
    found = []
    for parent, stems in ((folder / recording, {camera}), (folder, {f"{recording}_{camera}", recording})):
        if parent.is_dir():
            found += [path for path in parent.iterdir() if {path.name, path.stem} & stems and is_video(path)]
    return found
