"""Stretches of tracks that are worth a look: jumps, gaps, large residuals and large sigmas, the worst first."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.tracking.reconstruction.corrected_tracks import CorrectedTracks
from rafl.tracking.reconstruction.gap_filling import FILLED, MISSING

Array = NDArray[Any]

USUAL_QUANTILE = 0.95  # of all markers' values: what is usual in the recording
JUMP_RATIO, MIN_JUMP_PX = 5.0, 2.0  # an acceleration above both is a jump: a dot was taken for another
RESIDUAL_RATIO, MIN_RESIDUAL_PX = 4.0, 0.5
SIGMA_RATIO, MIN_SIGMA_PX = 4.0, 0.15
NEAR_SHARE = 0.4  # of a jump: how far from where another marker was it ends at most, if the two exchanged dots
JOINED_ROWS = 2  # stretches of a marker this close are one
MOST = 500  # stretches that are listed
WEIGHT = {"jump": 1000.0, "missing": 100.0, "residual": 10.0, "sigma": 1.0, "filled": 0.1}


@dataclass(frozen=True)
class Stretch:
    """A marker in some rows.

    Attributes:
        kind: jump, missing, residual, sigma or filled.
        marker: index.
        camera: its name; empty if the stretch is one of all cameras.
        first: row.
        last: row.
        size: jump, residual or sigma [px], or the number of rows.
        reviewed: whether somebody accepted it.
        other: index of the marker with which this one seems to have exchanged its dot; -1 if there is none.
    """

    kind: str
    marker: int
    camera: str
    first: int
    last: int
    size: float
    reviewed: bool
    other: int = -1


def find_stretches(found: CorrectedTracks) -> list[Stretch]:
    """The stretches worth a look, the worst first: jumps, then gaps, residuals, sigmas and filled gaps."""
    tracks, result = found.tracks, []
    count = np.sum([np.isfinite(values) for values in tracks.residual.values()], axis=0) if tracks.residual else 0
    for camera, path in tracks.pixel.items():
        acceleration = np.zeros(path.shape[:2])
        acceleration[1:-1] = np.nan_to_num(np.linalg.norm(path[2:] - 2.0 * path[1:-1] + path[:-2], axis=2))
        limit = max(JUMP_RATIO * _usual(acceleration), MIN_JUMP_PX)
        result += _paired(_runs(found, "jump", camera, acceleration > limit, acceleration), path)
        residual = np.where(count > 1, np.nan_to_num(tracks.residual[camera]), 0.0)
        limit = max(RESIDUAL_RATIO * _usual(residual), MIN_RESIDUAL_PX)
        result += _runs(found, "residual", camera, residual > limit, residual)
        sigma = np.nan_to_num(tracks.pixel_sigma[camera].max(axis=2))
        limit = max(SIGMA_RATIO * _usual(sigma), MIN_SIGMA_PX)
        result += _runs(found, "sigma", camera, sigma > limit, sigma)
    result += _runs(found, "missing", "", tracks.state == MISSING, None)
    result += _runs(found, "filled", "", tracks.state == FILLED, None)
    result.sort(key=lambda item: (-WEIGHT[item.kind], -item.size))
    return result[:MOST]


def _paired(jumps: list[Stretch], path: Array) -> list[Stretch]:
    """Jumps, of which two markers' that go to each other's dots are one; `path` (T, M, 2) [px]."""
    result: list[Stretch] = []
    for jump in jumps:
        before = path[jump.first, jump.marker]
        nearest = [
            other
            for other in jumps
            if other.marker != jump.marker
            and (other.first, other.last) == (jump.first, jump.last)
            and np.hypot(*(path[jump.last, other.marker] - before)) < NEAR_SHARE * jump.size
            and np.hypot(*(path[jump.last, jump.marker] - path[jump.first, other.marker])) < NEAR_SHARE * jump.size
        ]
        if not nearest:
            result.append(jump)
        elif jump.marker < nearest[0].marker:
            result.append(replace(jump, other=nearest[0].marker, reviewed=jump.reviewed or nearest[0].reviewed))
    return result


def _usual(values: Array) -> float:
    known = values[values > 0.0]
    return float(np.quantile(known, USUAL_QUANTILE)) if len(known) else 0.0


def _runs(
    found: CorrectedTracks, kind: str, camera: str, chosen: NDArray[np.bool_], values: Array | None
) -> list[Stretch]:
    """A stretch for each run of chosen rows of a marker, (T, M)."""
    result = []
    for marker in np.flatnonzero(chosen.any(axis=0)).tolist():
        rows = np.flatnonzero(chosen[:, marker])
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > JOINED_ROWS) + 1):
            first, last = int(run[0]), int(run[-1])
            size = float(last - first + 1) if values is None else float(values[run, marker].max())
            reviewed = bool(found.accepted[run, marker].all())
            result.append(Stretch(kind, marker, camera, first, last, size, reviewed))
    return result
