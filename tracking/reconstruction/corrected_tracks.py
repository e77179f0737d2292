"""Tracks with corrections: pixels are changed camera by camera, and what depends on them is computed anew."""

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache, singledispatchmethod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.rig import Rig, parse_calibration
from rafl.common.errors import InputError
from rafl.tracking.reconstruction.corrections import (
    Accept,
    Correction,
    Delete,
    Place,
    Rename,
    Swap,
    corrections_path,
    read_corrections,
)
from rafl.tracking.reconstruction.gap_filling import FILLED, MEASURED, MISSING, refill_gaps
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks
from rafl.tracking.reconstruction.triangulation import SAME_TIME_FRAMES, CameraPixels, triangulate_some

Array = NDArray[Any]

LAG_ERROR = 0.5  # of the distance that a dot moves between the time of its frame and that of the row


@dataclass(frozen=True)
class CorrectedTracks:
    """Tracks with the corrections of a person.

    Attributes:
        tracks: with the corrections.
        corrections: those in the file.
        changed: whether a camera's pixel of the marker was changed, (T, M).
        accepted: whether somebody has accepted the marker as it is there, (T, M).
        emptied: where a filled gap was deleted, (T, M).
        unfit: a line for each correction that does not fit the tracks and was left out.
        doubtful: a line for each correction that was applied, but made on other tracks, in which the markers may have
            had other dots. Positions that a person set or fitted name frame and pixel, so they hold for any tracks.
        digest: of the tracks as tracked.
    """

    tracks: Tracks
    corrections: tuple[Correction, ...]
    changed: NDArray[np.bool_]
    accepted: NDArray[np.bool_]
    emptied: NDArray[np.bool_]
    unfit: tuple[str, ...]
    doubtful: tuple[str, ...]
    digest: str


def read_corrected_tracks(path: str | Path) -> CorrectedTracks:
    """Read a tracks file and apply the corrections in `<recording>.corrections.yaml` beside it, if there is one.

    Corrections that do not fit the tracks are left out; the tracks' notes name them.

    Raises:
        InputError: a file is damaged, or there are corrections for tracks without a calibration.
    """
    path = Path(path)
    return with_corrections(read_tracks(path), path)


def with_corrections(tracks: Tracks, path: Path) -> CorrectedTracks:
    """Tracks with the corrections that lie beside the tracks file at `path`.

    Raises:
        InputError: as for `read_corrected_tracks`.
    """
    beside = corrections_path(path)
    found = apply_corrections(tracks, read_corrections(beside), path)
    if not found.corrections:
        return found
    applied = len(found.corrections) - len(found.unfit)
    notes = (
        f"{applied} correction{'' if applied == 1 else 's'} of {beside.name} applied",
        *found.unfit,
        *found.doubtful,
    )
    return replace(found, tracks=replace(found.tracks, notes=(*tracks.notes, *notes)))


def apply_corrections(
    tracks: Tracks, corrections: tuple[Correction, ...], source: Path, before: CorrectedTracks | None = None
) -> CorrectedTracks:
    """Apply corrections one after the other, and reconstruct the markers anew in the frames concerned.

    Gaps that have, or border on, a corrected measurement are filled anew.

    Args:
        tracks: as tracked.
        corrections: in order.
        source: the tracks file, for error messages.
        before: the same tracks with other corrections, known from an earlier call. Only what differs is computed, which
            saves time.

    Raises:
        InputError: the tracks hold no calibration.
    """
    work = _Work(tracks)
    unfit, doubtful = [], []
    own = before.digest if before is not None else tracks_digest(tracks)
    for number, correction in enumerate(corrections, start=1):
        try:
            work.apply(correction)
        except _UnfitError as error:
            unfit.append(f"{left_out(number, correction)}{error}")
            continue
        if is_doubtful(correction, own):
            doubtful.append(
                f"correction {number} ({correction.kind}, by {correction.by}) was made on other tracks: look in "
                "rafl-review whether it still holds"
            )
    result, differs = work.tracks, work.changed
    if before is not None and len(before.tracks.names) == len(result.names):
        known = before.tracks
        differs = _differing(work, before)
        result = replace(result, position=known.position, sigma=known.sigma, state=known.state, residual=known.residual)
    if differs.any():
        if not tracks.calibration:
            raise InputError(f"{source}: expected the calibration with which it was tracked, found none; track again")
        result = _reconstruct(result, differs, source)
    if (emptied := work.emptied & (result.state == FILLED)).any():
        nowhere = np.where(emptied[..., None], np.nan, 0.0)
        result = replace(
            result,
            position=result.position + nowhere,
            sigma=result.sigma + nowhere,
            state=np.where(emptied, np.uint8(MISSING), result.state),
        )
    changes = work.changed, work.accepted, work.emptied
    return CorrectedTracks(result, corrections, *changes, tuple(unfit), tuple(doubtful), own)


def tracks_digest(tracks: Tracks) -> str:
    """SHA-256 of the names and of the cameras' frames and pixels, which corrections change; for tracks as tracked.

    Another calibration leaves it as it is.
    """
    digest = hashlib.sha256("\n".join(tracks.names).encode())
    for camera in sorted(tracks.pixel):
        digest.update(camera.encode())
        for values in (tracks.frame[camera].astype("<i8"), tracks.pixel[camera].astype("<f8")):
            digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()


def is_doubtful(correction: Correction, digest: str) -> bool:
    """Whether a correction was made on other tracks than those of a digest, and may not hold for them."""
    return correction.tracks not in ("", digest) and not isinstance(correction, Place)


def left_out(number: int, correction: Correction) -> str:
    """How the line about a correction that was left out begins; the reason follows."""
    return f"correction {number} ({correction.kind}, by {correction.by}) is left out: "


def _differing(work: "_Work", before: CorrectedTracks) -> NDArray[np.bool_]:
    """The measurements that are others than before, and the gaps that are to be filled again, (T, M)."""
    differs = before.emptied & ~work.emptied
    columns = np.flatnonzero((work.changed | before.changed).any(axis=0))
    for key in ("pixel", "pixel_sigma"):
        for camera, values in getattr(work.tracks, key).items():
            new, old = values[:, columns], getattr(before.tracks, key)[camera][:, columns]
            differs[:, columns] |= ((new != old) & ~(np.isnan(new) & np.isnan(old))).any(axis=-1)
    return differs


class _UnfitError(Exception):
    """A correction does not fit the tracks."""


class _Work:
    """Tracks whose pixels are being corrected; the arrays of a camera are copied before they are changed first."""

    def __init__(self, tracks: Tracks) -> None:
        self.tracks = replace(tracks, pixel=dict(tracks.pixel), pixel_sigma=dict(tracks.pixel_sigma))
        self.copied: set[str] = set()  # cameras
        self.changed = np.zeros(tracks.state.shape, bool)
        self.accepted = np.zeros(tracks.state.shape, bool)
        self.emptied = np.zeros(tracks.state.shape, bool)  # where no gap is filled

    @singledispatchmethod
    def apply(self, correction: Correction) -> None:
        """Apply a correction.

        Raises:
            _UnfitError: it does not fit.
        """
        raise NotImplementedError

    @apply.register
    def _(self, correction: Place) -> None:
        camera = self._camera(correction.camera)
        values = correction.positions
        frames = values[:, 0].astype(int)
        shown, first_rows = np.unique(self.tracks.frame[camera], return_index=True)
        there = np.minimum(np.searchsorted(shown, frames), len(shown) - 1)
        if (absent := frames[shown[there] != frames]).size:
            raise _UnfitError(f"no row of the tracks shows frame {absent[0]} of camera {camera}")
        if correction.new and correction.marker not in self.tracks.names:
            self._add_marker(correction.marker)
        column = self._column(correction.marker)
        rows = first_rows[there]
        pixel, sigma = self._at_row_times(camera, column, rows, values[:, 1:3], values[:, 3:])
        paths, sigmas = self._changeable(camera)
        paths[rows, column] = pixel
        sigmas[rows, column] = sigma
        self.changed[rows, column] = True

    @apply.register
    def _(self, correction: Delete) -> None:
        rows, column = self._stretch(correction)
        camera = correction.camera
        seen = np.isfinite(self.tracks.pixel_sigma[camera][:, column, 0])
        if not (rows & seen).any():  # what is deleted is a filled gap
            self.emptied[rows, column] = True
        rows &= seen
        for values in self._changeable(camera):
            values[rows, column] = np.nan
        self.changed[rows, column] = True

    @apply.register
    def _(self, correction: Accept) -> None:
        rows, column = self._stretch(correction)
        self.accepted[rows, column] = True

    @apply.register
    def _(self, correction: Swap) -> None:
        camera = self._camera(correction.camera)
        pair = np.array([self._column(marker) for marker in correction.markers])
        frame = self.tracks.frame[camera]
        if frame.max() < correction.first:
            raise _UnfitError(f"camera {camera} has frames up to {frame.max()}, not {correction.first}")
        rows = np.arange(len(frame)) >= int(np.argmax(frame >= correction.first))
        first = int(np.argmax(rows))
        for values in self._changeable(camera):
            values[first:, pair] = values[first:, pair[::-1]]
        seen = np.isfinite(self.tracks.pixel_sigma[camera][:, pair, 0]).any(axis=1)
        self.changed[np.ix_(rows & seen, pair)] = True

    @apply.register
    def _(self, correction: Rename) -> None:
        column = self._column(correction.marker)
        names = list(self.tracks.names)
        if correction.to in names:
            raise _UnfitError(f"there is a marker {correction.to} already")
        names[column] = correction.to
        try:
            self.tracks = replace(self.tracks, names=tuple(names))
        except InputError as error:
            raise _UnfitError(str(error)) from None

    def _camera(self, camera: str) -> str:
        if camera not in self.tracks.pixel:
            raise _UnfitError(f"the tracks have no camera {camera}")
        return camera

    def _changeable(self, camera: str) -> tuple[Array, Array]:
        """Pixels and sigmas of a camera that may be changed, (T, M, 2)."""
        pixel, sigma = self.tracks.pixel, self.tracks.pixel_sigma
        if camera not in self.copied:
            self.copied.add(camera)
            pixel[camera], sigma[camera] = pixel[camera].copy(), sigma[camera].copy()
        return pixel[camera], sigma[camera]

    def _column(self, marker: str) -> int:
        if marker not in self.tracks.names:
            raise _UnfitError(f"the tracks have no marker {marker}")
        return self.tracks.names.index(marker)

    def _stretch(self, correction: Delete | Accept) -> tuple[NDArray[np.bool_], int]:
        frame = self.tracks.frame[self._camera(correction.camera)]
        column = self._column(correction.marker)
        rows = (frame >= correction.first) & (frame <= correction.last)
        if correction.last > frame.max() or not rows.any():
            raise _UnfitError(
                f"camera {correction.camera} has frames up to {frame.max()}, not {correction.first} to "
                f"{correction.last}"
            )
        return rows, column

    def _add_marker(self, marker: str) -> None:
        """Add a marker that is missing everywhere, as the last one."""
        tracks = self.tracks

        def wider(values: Array) -> Array:
            empty: float = np.nan if values.dtype.kind == "f" else MISSING
            return np.concatenate([values, np.full_like(values[:, :1], empty)], axis=1)

        try:
            self.tracks = replace(
                tracks,
                names=(*tracks.names, marker),
                position=wider(tracks.position),
                sigma=wider(tracks.sigma),
                state=wider(tracks.state),
                pixel={camera: wider(values) for camera, values in tracks.pixel.items()},
                pixel_sigma={camera: wider(values) for camera, values in tracks.pixel_sigma.items()},
                residual={camera: wider(values) for camera, values in tracks.residual.items()},
            )
        except InputError as error:
            raise _UnfitError(str(error)) from None
        for key in ("changed", "accepted", "emptied"):
            setattr(self, key, np.pad(getattr(self, key), ((0, 0), (0, 1))))

    def _at_row_times(
        self, camera: str, column: int, rows: NDArray[np.int64], pixel: Array, sigma: Array
    ) -> tuple[Array, Array]:
        """Pixels and sigmas (F, 2) at the times of rows (F), of a dot that was seen in the frames shown there.

        A camera whose clock is offset shows its frames a little earlier or later than the rows.
        """
        lag = self.tracks.lag.get(camera)
        if lag is None or (np.abs(lag[rows]) * self.tracks.fps < SAME_TIME_FRAMES).all():
            return pixel, sigma
        path, time = self.tracks.pixel[camera], self.tracks.time
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(time) - 1)
        velocity = (path[after] - path[before]) / (time[after] - time[before])[:, None, None]
        own = velocity[:, column]
        known = np.isfinite(velocity)
        others = np.where(known, velocity, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        shift = lag[rows, None] * np.where(np.isfinite(own), own, others)
        return pixel - shift, np.hypot(sigma, LAG_ERROR * shift)


def _reconstruct(tracks: Tracks, changed: NDArray[np.bool_], source: Path) -> Tracks:
    """The tracks, with positions triangulated from the pixels where `changed`, (T, M)."""
    rig = _rig(tracks.calibration, source)
    rows, columns = np.nonzero(changed)
    pixels = {
        camera: CameraPixels(tracks.pixel[camera][rows, columns][None], tracks.pixel_sigma[camera][rows, columns][None])
        for camera in tracks.pixel
    }
    found, found_sigma, found_residual = triangulate_some(rig, pixels)
    position, sigma, state = tracks.position.copy(), tracks.sigma.copy(), tracks.state.copy()
    residual = {camera: values.copy() for camera, values in tracks.residual.items()}
    position[rows, columns], sigma[rows, columns] = found[0], found_sigma[0]
    state[rows, columns] = np.where(np.isfinite(found[0, :, 0]), MEASURED, MISSING)
    for camera, values in residual.items():
        values[rows, columns] = found_residual[camera][0]
    longest = tracks.longest_gap
    position, sigma, state = refill_gaps(
        position, sigma, state, tracks.time, _longest_filled(tracks.state) if longest is None else longest, changed
    )
    return replace(tracks, position=position, sigma=sigma, state=state, residual=residual)


@lru_cache(maxsize=8)
def _rig(calibration: str, source: Path) -> Rig:
    return parse_calibration(calibration, source)


def _longest_filled(state: NDArray[np.uint8]) -> int:
    """Length of the longest filled gap, (T, M): files of earlier programs do not say up to which gaps were filled."""
    longest = 0
    for filled in (state == FILLED).T:
        edges = np.flatnonzero(np.diff(np.r_[False, filled, False]))
        longest = max(longest, int((edges[1::2] - edges[::2]).max(initial=0)))
    return longest
