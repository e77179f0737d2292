"""Tracking through synthetic videos with known truth: small, dim, hidden, late and static dots."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support import curled_strip, draw_frame, marker_grid

from rafl.common.errors import InputError
from rafl.tracking.linking.follow import PixelTracks, follow
from rafl.tracking.video.frame import Frame
from rafl.tracking.video.reader import Reading

SIZE = (360, 240)


@dataclass(frozen=True)
class Drawn:
    """Replaces a video by dots drawn at given positions [px], (T, D, 2); NaN where a dot is hidden."""

    positions: np.ndarray
    path: Path = Path("drawn.mp4")
    predicted_frames: bool = False
    hidden: tuple[int, ...] = ()  # frames that do not show the first three dots
    blobs: tuple[tuple[float, float], ...] = ()  # static, shown from frame 5 on
    radius: float = 6.0
    blur: float = 1.0
    noise: float = 2.0
    contrast: float = 130.0
    light: Callable[[int], np.ndarray] = lambda _: np.ones(SIZE[0])  # factor for each column

    def read(self) -> Reading:
        return Reading(self.frames())

    def frames(self) -> Iterator[Frame]:
        for frame, positions in enumerate(self.positions):
            shown = positions[3:] if frame in self.hidden else positions
            blobs = self.blobs if frame >= 5 else ()
            dots = [(x, y, self.radius, self.radius, 0.0) for x, y in (*shown, *blobs) if np.isfinite(x)]
            options = {"blur": self.blur, "noise": self.noise, "contrast": self.contrast}
            lit = draw_frame(dots, SIZE, seed=frame, **options) * self.light(frame)
            yield Frame(0.01 * frame, np.clip(np.rint(lit), 0, 255).astype(np.uint8))


def track(video: Drawn) -> PixelTracks:
    return follow(video, lambda: None)


def bent(rest: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """The grid bent like a cantilever, its tip `tip` (T) px down."""
    share = (rest[:, 0] - 20) / (rest[:, 0].max() - 20)
    down = tip[:, None] * share**2 * (3 - share) / 2
    return np.stack([np.broadcast_to(rest[:, 0], down.shape), rest[:, 1] + down], axis=-1)


def order(start: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The track that starts nearest to each true position, (D)."""
    return np.linalg.norm(truth[:, None] - start[None], axis=2).argmin(axis=1)


def distances(tracks: PixelTracks, truth: np.ndarray) -> np.ndarray:
    """Distance of each tracked position from the true one [px], (T, D)."""
    return np.linalg.norm(tracks.pixel[:, order(tracks.start, truth[0])] - truth, axis=2)


@pytest.mark.parametrize(("radius", "blur"), [(2.8, 1.5), (4.0, 2.2)])
def test_small_blurred_dots_are_tracked(radius: float, blur: float) -> None:
    """The images do not determine radius, contrast and blur of such dots separately."""
    truth = bent(marker_grid(), 20.0 * np.cos(2 * np.pi * np.arange(16) / 7.3))
    tracks = track(Drawn(truth, radius=radius, blur=blur, noise=4.0))
    assert tracks.pixel.shape == truth.shape
    distance = distances(tracks, truth)
    assert np.isfinite(distance).mean() > 0.97
    assert np.nanmax(distance) < 0.4


@pytest.mark.parametrize(("radius", "noise"), [(5.0, 8.0), (8.0, 10.0)])
def test_dim_dots_in_noise_are_tracked(radius: float, noise: float) -> None:
    """The contrast is four or five times the pixel noise. So a disc's residual says little about its fit."""
    truth = bent(marker_grid(), 20.0 * np.cos(2 * np.pi * np.arange(24) / 7.3))
    tracks = track(Drawn(truth, radius=radius, noise=noise, contrast=40.0))
    assert tracks.pixel.shape == truth.shape
    match = order(tracks.start, truth[0])
    error = tracks.pixel[:, match] - truth
    assert np.isfinite(error).mean() > 0.98
    assert np.nanmax(np.abs(error)) < 1.0
    assert 0.8 < np.sqrt(np.nanmean((error / tracks.sigma[:, match]) ** 2)) < 1.25


def shadow(frame: int) -> np.ndarray:
    """A shadow that enters from the left and leaves a quarter of the light."""
    return 1.0 / (1.0 + 3.0 / (1.0 + np.exp(np.clip((np.arange(SIZE[0]) - 20.0 * frame) / 15.0, -30, 30))))


def flicker(frame: int) -> np.ndarray:
    return np.full(SIZE[0], 0.8 + 0.35 * np.sin(2.1 * frame))


@pytest.mark.parametrize("light", [shadow, flicker])
def test_dots_are_tracked_in_changing_light(light: Callable[[int], np.ndarray]) -> None:
    truth = bent(marker_grid(), 20.0 * np.cos(2 * np.pi * np.arange(24) / 7.3))
    tracks = track(Drawn(truth, light=light))
    assert tracks.pixel.shape == truth.shape
    distance = distances(tracks, truth)
    assert np.isfinite(distance).all()
    assert np.max(distance) < 0.3


@pytest.mark.parametrize("swing", [10.0, 20.0, 30.0])
def test_swinging_dots_keep_their_identity(swing: float) -> None:
    """The tip moves by up to `swing` px, three quarters of a spacing a frame, in a grid of equal dots."""
    truth = bent(marker_grid(), swing * np.cos(2 * np.pi * np.arange(24) / 7.3))
    tracks = track(Drawn(truth))
    assert tracks.pixel.shape == truth.shape
    distance = distances(tracks, truth)
    assert np.isfinite(distance).mean() > 0.99
    assert np.nanmax(distance) < 0.3


@pytest.mark.parametrize(("turn", "height"), [(0.5, 205.0), (-0.5, 20.0)])
def test_static_dots_beside_a_fast_body_keep_their_identity(turn: float, height: float) -> None:
    """Six static dots lie within a spacing of a tip that moves by one spacing a frame."""
    swinging = bent(marker_grid(), 34.0 * np.sin(2 * np.pi * np.arange(24) / 6.3 + np.pi * turn)) - np.array([0.0, 5.0])
    static = np.stack([30.0 + 44.0 * np.arange(6), np.full(6, height)], axis=1)
    truth = np.concatenate([swinging, np.tile(static, (24, 1, 1))], axis=1)
    distance = distances(track(Drawn(truth)), truth)
    assert np.isfinite(distance).mean() > 0.99
    assert np.nanmax(distance) < 0.3


def test_hidden_dots_keep_their_identity_when_they_reappear() -> None:
    truth = bent(marker_grid(), 15.0 * np.sin(2 * np.pi * np.arange(20) / 16))
    tracks = track(Drawn(truth, hidden=tuple(range(6, 12))))
    found = tracks.pixel[:, order(tracks.start, truth[0])]
    assert np.isnan(found[6:12, :3]).all()
    assert np.abs(found[12:] - truth[12:]).max() < 0.3
    assert np.abs(found[:, 3:] - truth[:, 3:]).max() < 0.3


def test_dots_reappearing_in_a_curl_are_not_taken_for_their_neighbours() -> None:
    """A strip curls by up to 2.2 rad behind an edge, so that reappearing dots come close to former positions of others.

    When the rest shape alone predicted them, 24 positions had a neighbour's identity. A row that curls more than ever
    before stays missing.
    """
    turn = 0.45 * np.sin(0.3 * np.arange(60))[:, None] * np.arange(6)
    step = 30.0 * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    across = 17.0 * np.stack([np.cos(turn), -np.sin(turn)], axis=-1)
    middle = np.cumsum(step, axis=1)
    truth = np.stack([middle + across, middle - across], axis=2).reshape(60, 12, 2)
    truth += np.array([180.0, 20.0])
    hidden = truth[..., 1] > np.median(truth[..., 1])
    hidden[0] = False
    distance = distances(track(Drawn(np.where(hidden[..., None], np.nan, truth))), truth)
    assert np.nanmax(distance) < 0.5
    assert np.isfinite(distance[~hidden]).mean() > 0.65


def test_dots_keep_their_identity_while_a_bar_passes() -> None:
    """The bar hides five of eight columns at a time of a body that swings by half a spacing a frame.

    When the most similar shapes identified the markers, two had a neighbour's identity.
    """
    truth = bent(marker_grid(), 40.0 * np.sin(2 * np.pi * np.arange(60) / 13.1))
    bar = np.linspace(-60.0, 400.0, 60)
    hidden = np.abs(truth[..., 0] - bar[:, None]) < 80.0
    hidden[0] = False
    assert hidden.sum(axis=1).max() == 15
    distance = distances(track(Drawn(np.where(hidden[..., None], np.nan, truth))), truth)
    assert np.nanmax(distance) < 0.3
    assert np.isfinite(distance[~hidden]).mean() > 0.99
    assert np.isfinite(distance[-1]).all()


def test_a_body_that_was_hidden_wholly_is_found_again_with_its_identities() -> None:
    """After its motion is forgotten, only the shapes seen before tell which dot is which."""
    truth = bent(marker_grid(), 20.0 * np.sin(2 * np.pi * np.arange(60) / 12.4))
    positions = truth.copy()
    positions[25:40] = np.nan
    tracks = track(Drawn(positions))
    distance = distances(tracks, truth)
    assert np.nanmax(distance) < 0.5
    assert np.isfinite(distance[-1]).all()


def test_dots_hidden_at_first_are_detected_late() -> None:
    """A hand holds the specimen for fifteen frames. Then it swings, and the dots are tracked once they are visible."""
    rest = marker_grid()
    rest = np.concatenate([rest[[4, 13, 23]], np.delete(rest, [4, 13, 23], axis=0)])
    truth = bent(rest, np.concatenate([np.zeros(15), 20.0 * np.sin(2 * np.pi * np.arange(55) / 16)]))
    tracks = track(Drawn(truth, hidden=tuple(range(15))))
    assert tracks.late_count == 3
    assert tracks.pixel.shape == truth.shape
    match = order(tracks.start, truth[0])
    assert sorted(match) == list(range(24))
    found = tracks.pixel[:, match]
    assert np.isnan(found[:15, :3]).all()
    assert np.abs(found[15:] - truth[15:]).max() < 0.3


def test_hidden_columns_with_a_large_spacing_are_detected_late() -> None:
    """In a grid of three rows, the column spacing is 2.5 times the row spacing. The last two columns are hidden."""
    rest = marker_grid(5, 3) * [1.6, 0.64] - [24.0, -30.0]
    truth = bent(rest, np.concatenate([np.zeros(15), 20.0 * np.sin(2 * np.pi * np.arange(85) / 16)]))
    positions = truth.copy()
    positions[:15, rest[:, 0] > 180.0] = np.nan
    tracks = track(Drawn(positions))
    assert tracks.late_count == 6
    assert sorted(order(tracks.start, truth[0])) == list(range(15))
    assert np.nanmax(distances(tracks, truth)) < 0.3
    assert np.isfinite(tracks.pixel[60:]).all()


@pytest.mark.parametrize("tip", [25.0, 45.0])
def test_hidden_dots_beside_the_clamp_are_detected_late(tip: float) -> None:
    """They move by 0.2 to 10 px. The body is bent at first, so the moving markers alone do not give their position."""
    truth = bent(marker_grid(), tip * np.cos(0.4 * np.arange(90)))
    positions = truth.copy()
    positions[:20, truth[0, :, 0] < 130.0] = np.nan
    tracks = track(Drawn(positions))
    assert tracks.late_count == 9
    match = order(tracks.start, truth[0])
    assert sorted(match) == list(range(24))
    assert np.linalg.norm(tracks.start[match] - truth[0], axis=1).max() < 5.0
    assert np.nanmax(distances(tracks, truth)) < 0.3
    assert np.isfinite(tracks.pixel[-1]).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_irregular_dot_beside_the_clamp_is_detected_late(seed: int) -> None:
    """It moves by 0.1 px, and is in no row, because the dots were placed by hand."""
    rest = marker_grid() + np.random.default_rng(seed).uniform(-6.0, 6.0, (24, 2))
    truth = bent(rest, 2.4 * np.cos(0.4 * np.arange(90)))
    positions = truth.copy()
    positions[:20, 1] = np.nan
    tracks = track(Drawn(positions))
    assert tracks.late_count == 1
    assert np.linalg.norm(tracks.start[-1] - truth[0, 1]) < 1.0


@pytest.mark.parametrize("speed", [0.2, 0.3, 0.4])
def test_start_of_a_hidden_tip_is_predicted(speed: float) -> None:
    """The hidden part of a strip curls unpredictably at first, but is seen to curl in the same way later."""
    curls = [curled_strip(0.14 * np.cos(speed * frame)) for frame in range(100)]
    truth = np.array(curls) + np.array([60.0, 118.0])
    positions = truth.copy()
    positions[:15, 6:] = np.nan
    positions[:40, 12:] = np.nan
    tracks = track(Drawn(positions))
    assert tracks.late_count == 8
    match = order(tracks.start, truth[0])
    assert sorted(match) == list(range(14))
    assert np.linalg.norm(tracks.start[match] - truth[0], axis=1).max() < 2.0
    assert np.nanmax(distances(tracks, truth)) < 0.3
    assert np.isfinite(tracks.pixel[-1]).all()


@pytest.mark.parametrize("speed", [0.6, 0.65, 0.7])
def test_fast_tip_hidden_at_first_is_detected_late(speed: float) -> None:
    """It moves nearly three spacings a frame; its estimated position on the body varies by about one spacing."""
    truth = np.array([curled_strip(0.2 * np.cos(speed * frame)) for frame in range(90)]) + np.array([60.0, 118.0])
    positions = truth.copy()
    positions[:20, 8:] = np.nan
    tracks = track(Drawn(positions))
    assert tracks.late_count == 6
    assert sorted(order(tracks.start, truth[0])) == list(range(14))
    assert np.nanmax(distances(tracks, truth)) < 1.0
    assert np.isfinite(tracks.pixel[-1]).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_many_background_blobs_are_not_tracked(seed: int) -> None:
    """They are so many that some blob is always at a position to which the swinging body could have carried it."""
    truth = bent(marker_grid(), 30.0 * np.sin(2 * np.pi * np.arange(80) / 23))
    random, blobs = np.random.default_rng(seed), np.empty((0, 2))
    while len(blobs) < 24:
        blob = random.uniform([8.0, 8.0], [350.0, 230.0])
        others = np.concatenate([truth.reshape(-1, 2), blobs])
        if np.linalg.norm(others - blob, axis=1).min() > 16.0:
            blobs = np.concatenate([blobs, blob[None]])
    tracks = track(Drawn(truth, blobs=tuple(map(tuple, blobs))))
    assert tracks.late_count == 0
    assert np.isfinite(tracks.pixel).mean() > 0.99
    assert np.nanmax(distances(tracks, truth)) < 0.3


@pytest.mark.parametrize("period", [10, 35, 160])
def test_background_blobs_behind_the_body_are_not_tracked(period: int) -> None:
    """The swinging body returns to them again and again, or moves away from them slowly."""
    truth = bent(marker_grid(), 20.0 * np.sin(2 * np.pi * np.arange(100) / period))
    blobs = ((20.0, 40.0), (160.0, 40.0), (330.0, 100.0), (330.0, 180.0), (100.0, 195.0), (220.0, 210.0))
    assert track(Drawn(truth, blobs=blobs)).late_count == 0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_background_blobs_that_shake_with_the_camera_are_not_tracked(seed: int) -> None:
    """They appear late beside the clamp, where the body shakes in the same way."""
    truth = bent(marker_grid(), 25.0 * np.sin(2 * np.pi * np.arange(80) / 25))
    blobs = np.tile([[12.0, 55.0], [10.0, 100.0], [16.0, 135.0], [30.0, 215.0], [50.0, 30.0]], (80, 1, 1))
    blobs[:5] = np.nan
    shake = np.random.default_rng(seed).normal(0.0, 0.45, (80, 1, 2))
    assert track(Drawn(np.concatenate([truth, blobs], axis=1) + shake)).late_count == 0


def test_frames_before_the_first_dots_are_missing() -> None:
    truth = np.concatenate([np.full((4, 24, 2), np.nan), np.repeat(marker_grid()[None], 3, axis=0)])
    tracks = track(Drawn(truth))
    assert np.isnan(tracks.pixel[:4]).all()
    assert not tracks.damaged.any()
    assert np.abs(tracks.pixel[4:, order(tracks.start, truth[4])] - truth[4:]).max() < 0.3


def test_too_few_dots_raise() -> None:
    with pytest.raises(InputError, match=r"drawn\.mp4: expected at least 3 dots .* found 2"):
        track(Drawn(marker_grid(2, 1)[None]))
