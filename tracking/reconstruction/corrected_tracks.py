"""Tracks with corrections: pixels are changed camera by camera, and what depends on them is computed anew."""

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.rig import Rig, parse_calibration
from rafl.common.errors import InputError
from rafl.tracking.reconstruction.corrected_pixels import ROW_PIXELS, CorrectedPixels, UnfitError
from rafl.tracking.reconstruction.corrections import Correction, Place, corrections_path, read_corrections
from rafl.tracking.reconstruction.gap_filling import FILLED, MEASURED, MISSING, refill_gaps
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels, triangulate_some

Array = NDArray[Any]


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

    Where a camera's frames do not coincide with the rows, corrections change what it filmed in its frames, and the
    pixels in the rows follow by the same interpolation as when they were tracked.

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
    work = CorrectedPixels(tracks)
    unfit, doubtful = [], []
    own = before.digest if before is not None else tracks_digest(tracks)
    for number, correction in enumerate(corrections, start=1):
        try:
            work.apply(correction)
        except UnfitError as error:
            unfit.append(f"{left_out(number, correction)}{error}")
            continue
        if is_doubtful(correction, own):
            doubtful.append(
                f"correction {number} ({correction.kind}, by {correction.by}) was made on other tracks: look in "
                "rafl-review whether it still holds"
            )
    work.resample()
    result, differs = work.tracks, work.changed | work.moved
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


def _differing(work: CorrectedPixels, before: CorrectedTracks) -> NDArray[np.bool_]:
    """The measurements that are others than before, and the gaps that are to be filled again, (T, M)."""
    differs = before.emptied & ~work.emptied
    columns = np.flatnonzero((work.changed | before.changed).any(axis=0))
    for key in ROW_PIXELS:
        for camera, values in getattr(work.tracks, key).items():
            new, old = values[:, columns], getattr(before.tracks, key)[camera][:, columns]
            differs[:, columns] |= ((new != old) & ~(np.isnan(new) & np.isnan(old))).any(axis=-1)
    return differs


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
