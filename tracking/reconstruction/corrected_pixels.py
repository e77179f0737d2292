"""The pixels of tracks while corrections are applied to them one after the other, camera by camera."""

from dataclasses import replace
from functools import singledispatchmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.tracking.reconstruction.corrections import Accept, Correction, Delete, Place, Rename, Swap
from rafl.tracking.reconstruction.gap_filling import MISSING
from rafl.tracking.reconstruction.tracks import Tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels, nearest_frames, resample_pixels

Array = NDArray[Any]

LAG_ERROR = 0.5  # of the distance that a dot moves between the time of its frame and that of the row
ROW_PIXELS, FRAME_PIXELS = ("pixel", "pixel_sigma"), ("filmed_pixel", "filmed_sigma")  # of `Tracks`
SAME_PIXEL = 1e-5  # a spline far from a corrected frame changes by less [px]


class UnfitError(Exception):
    """A correction does not fit the tracks."""


class CorrectedPixels:
    """Tracks whose pixels are being corrected; the arrays of a camera are copied before they are changed first.

    Corrections change the pixels of a camera's frames where they are known, else those of the rows.
    """

    def __init__(self, tracks: Tracks) -> None:
        by_camera: dict[str, Any] = {key: dict(getattr(tracks, key)) for key in (*ROW_PIXELS, *FRAME_PIXELS)}
        self.tracks = replace(tracks, **by_camera)
        self.copied: set[str] = set()  # cameras
        self.refilmed: dict[str, set[int]] = {}  # columns of which frames were corrected, by camera
        self.placed: list[tuple[str, NDArray[np.int64], int]] = []  # camera, rows and column of corrected frames
        self.moved = np.zeros(tracks.state.shape, bool)  # where pixels of rows follow corrected frames
        self.changed = np.zeros(tracks.state.shape, bool)
        self.accepted = np.zeros(tracks.state.shape, bool)
        self.emptied = np.zeros(tracks.state.shape, bool)  # where no gap is filled

    @singledispatchmethod
    def apply(self, correction: Correction) -> None:
        """Apply a correction.

        Raises:
            UnfitError: it does not fit.
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
            raise UnfitError(f"no row of the tracks shows frame {absent[0]} of camera {camera}")
        if correction.new and correction.marker not in self.tracks.names:
            self._add_marker(correction.marker)
        column = self._column(correction.marker)
        rows, pixel, sigma = first_rows[there], values[:, 1:3], values[:, 3:]
        entries = rows
        if camera in self.tracks.filmed_time:
            entries = frames
            self.placed.append((camera, rows, column))
        elif self.tracks.lacks_filmed(camera):
            pixel, sigma = self._at_row_times(camera, column, rows, pixel, sigma)
        paths, sigmas = self._changeable(camera, [column])
        paths[entries, column] = pixel
        sigmas[entries, column] = sigma
        self.changed[self._rows(camera, entries), column] = True

    @apply.register
    def _(self, correction: Delete) -> None:
        rows, column = self._stretch(correction)
        camera, numbers = correction.camera, self._numbers(correction.camera)
        paths, sigmas = self._changeable(camera, [column])
        seen = np.isfinite(sigmas[:, column, 0])
        entries = np.flatnonzero((numbers >= correction.first) & (numbers <= correction.last) & seen)
        if not len(entries):  # what is deleted is a filled gap
            self.emptied[rows, column] = True
        paths[entries, column], sigmas[entries, column] = np.nan, np.nan
        self.changed[self._rows(camera, entries), column] = True

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
            raise UnfitError(f"camera {camera} has frames up to {frame.max()}, not {correction.first}")
        first = int(np.argmax(self._numbers(camera) >= correction.first))
        paths, sigmas = self._changeable(camera, pair.tolist())
        for values in (paths, sigmas):
            values[first:, pair] = values[first:, pair[::-1]]
        entries = first + np.flatnonzero(np.isfinite(sigmas[first:, pair, 0]).any(axis=1))
        self.changed[np.ix_(self._rows(camera, entries), pair)] = True

    @apply.register
    def _(self, correction: Rename) -> None:
        column = self._column(correction.marker)
        names = list(self.tracks.names)
        if correction.to in names:
            raise UnfitError(f"there is a marker {correction.to} already")
        names[column] = correction.to
        try:
            self.tracks = replace(self.tracks, names=tuple(names))
        except InputError as error:
            raise UnfitError(str(error)) from None

    def _camera(self, camera: str) -> str:
        if camera not in self.tracks.pixel:
            raise UnfitError(f"the tracks have no camera {camera}")
        return camera

    def _changeable(self, camera: str, columns: list[int]) -> tuple[Array, Array]:
        """Pixels and sigmas of a camera, (S, M, 2) of its frames or (T, M, 2) of rows, to change columns of."""
        filmed = camera in self.tracks.filmed_time
        pixel, sigma = (getattr(self.tracks, key) for key in (FRAME_PIXELS if filmed else ROW_PIXELS))
        if camera not in self.copied:
            self.copied.add(camera)
            pixel[camera], sigma[camera] = pixel[camera].copy(), sigma[camera].copy()
        if filmed:
            self.refilmed.setdefault(camera, set()).update(columns)
        return pixel[camera], sigma[camera]

    def _numbers(self, camera: str) -> NDArray[np.int64]:
        """Frame numbers along the first axis of the arrays that `_changeable` gives."""
        if camera in self.tracks.filmed_time:
            return np.arange(len(self.tracks.filmed_time[camera]))
        return self.tracks.frame[camera]

    def _rows(self, camera: str, entries: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows that show entries of the arrays that `_changeable` gives; for a frame that none shows, the nearest."""
        if camera not in self.tracks.filmed_time:
            return entries
        frame, own = self.tracks.frame[camera], self.tracks.filmed_time[camera]
        between = entries[~np.isin(entries, frame)]
        return np.append(np.flatnonzero(np.isin(frame, entries)), nearest_frames(self.tracks.time, own[between]))

    def resample(self) -> None:
        """Interpolate the pixels of the rows anew from those of corrected frames.

        A dot that a person set in one frame, and that is not seen in the next, has no pixels to interpolate between: it
        is moved to the time of the row.
        """
        tracks = self.tracks
        for camera, chosen in self.refilmed.items():
            columns = sorted(chosen)
            frames = CameraPixels(*(getattr(tracks, key)[camera][:, columns] for key in FRAME_PIXELS))
            found = resample_pixels(frames, tracks.filmed_time[camera], tracks.time)
            for by_camera, new in ((tracks.pixel, found.pixel), (tracks.pixel_sigma, found.sigma)):
                values = by_camera[camera] = by_camera[camera].copy()
                old = values[:, columns]
                kept = (np.abs(new - old) < SAME_PIXEL) | (np.isnan(new) & np.isnan(old))
                values[:, columns] = np.where(kept, old, new)
                self.moved[:, columns] |= ~kept.all(axis=-1)
        for camera, rows, column in self.placed:
            pixel, sigma = (values[rows, column] for values in tracks.in_frames(camera))
            alone = np.isnan(tracks.pixel[camera][rows, column, 0]) & np.isfinite(sigma[:, 0])
            found_pixel, found_sigma = self._at_row_times(camera, column, rows[alone], pixel[alone], sigma[alone])
            tracks.pixel[camera][rows[alone], column] = found_pixel
            tracks.pixel_sigma[camera][rows[alone], column] = found_sigma
            self.moved[rows[alone], column] = True

    def _column(self, marker: str) -> int:
        if marker not in self.tracks.names:
            raise UnfitError(f"the tracks have no marker {marker}")
        return self.tracks.names.index(marker)

    def _stretch(self, correction: Delete | Accept) -> tuple[NDArray[np.bool_], int]:
        frame = self.tracks.frame[self._camera(correction.camera)]
        column = self._column(correction.marker)
        rows = (frame >= correction.first) & (frame <= correction.last)
        if correction.last > frame.max() or not rows.any():
            raise UnfitError(
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

        by_camera: dict[str, Any] = {
            key: {camera: wider(values) for camera, values in getattr(tracks, key).items()}
            for key in (*ROW_PIXELS, *FRAME_PIXELS, "residual")
        }
        try:
            self.tracks = replace(
                tracks,
                names=(*tracks.names, marker),
                position=wider(tracks.position),
                sigma=wider(tracks.sigma),
                state=wider(tracks.state),
                **by_camera,
            )
        except InputError as error:
            raise UnfitError(str(error)) from None
        for key in ("changed", "accepted", "emptied", "moved"):
            setattr(self, key, np.pad(getattr(self, key), ((0, 0), (0, 1))))

    def _at_row_times(
        self, camera: str, column: int, rows: NDArray[np.int64], pixel: Array, sigma: Array
    ) -> tuple[Array, Array]:
        """Pixels and sigmas (F, 2) moved to the times of rows (F), of a dot that was seen in the frames shown there.

        It moves as it does around, or as the others do.
        """
        lag = self.tracks.lag[camera]
        path, time = self.tracks.pixel[camera], self.tracks.time
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(time) - 1)
        velocity = (path[after] - path[before]) / (time[after] - time[before])[:, None, None]
        own = velocity[:, column]
        known = np.isfinite(velocity)
        others = np.where(known, velocity, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        shift = lag[rows, None] * np.where(np.isfinite(own), own, others)
        return pixel - shift, np.hypot(sigma, LAG_ERROR * shift)
