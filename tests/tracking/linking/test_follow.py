from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rafl.tracking.linking.follow import follow
from rafl.tracking.video.frame import Frame
from rafl.tracking.video.reader import Reading
from support import curled, grid, picture

from rafl.common.errors import InputError

SIZE = (360, 240)


@dataclass(frozen=True)
class Drawn:
    """Stands in for a video: dots drawn at given places."""

    places: np.ndarray
    path: Path = Path("drawn.mp4")
    hidden: tuple[int, ...] = ()  # frames that do not show the first three dots
    blots: tuple[tuple[float, float], ...] = ()  # that stand still, from frame 5 on
    radius: float = 6.0
    blur: float = 1.0
    noise: float = 2.0
    contrast: float = 130.0
    light: Callable[[int], np.ndarray] = lambda _: np.ones(SIZE[0])  # by column

    def read(self) -> Reading:
        return Reading(self.frames())

    def frames(self) -> Iterator[Frame]:
        for frame, places in enumerate(self.places):
            shown = places[3:] if frame in self.hidden else places
            blots = self.blots if frame >= 5 else ()
            dots = [(x, y, self.radius, self.radius, 0.0) for x, y in (*shown, *blots) if np.isfinite(x)]
            look = {"blur": self.blur, "noise": self.noise, "contrast": self.contrast}
            lit = picture(dots, SIZE, seed=frame, **look) * self.light(frame)
            yield Frame(0.01 * frame, np.clip(np.rint(lit), 0, 255).astype(np.uint8))


def bent(rest: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """The grid bent like a cantilever, its tip `tip` (T) px down."""
    share = (rest[:, 0] - 20) / (rest[:, 0].max() - 20)
    down = tip[:, None] * share**2 * (3 - share) / 2
    return np.stack([np.broadcast_to(rest[:, 0], down.shape), rest[:, 1] + down], axis=-1)


def order(tracks_start: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(truth[:, None] - tracks_start[None], axis=2).argmin(axis=1)


@pytest.mark.parametrize(("radius", "blur"), [(2.8, 1.5), (4.0, 2.2)])
def test_small_dots_out_of_focus_are_followed(radius: float, blur: float) -> None:
    """Whose radius, contrast and blur cannot be told apart: all are found in the first picture and kept."""
    truth = bent(grid(), 20.0 * np.cos(2 * np.pi * np.arange(16) / 7.3))
    tracks = follow(Drawn(truth, radius=radius, blur=blur, noise=4.0), lambda: None)
    assert tracks.pixel.shape == truth.shape
    found = tracks.pixel[:, order(tracks.start, truth[0])]
    assert np.isfinite(found).mean() > 0.97
    assert np.nanmax(np.linalg.norm(found - truth, axis=2)) < 0.4


@pytest.mark.parametrize(("radius", "noise"), [(5.0, 8.0), (8.0, 10.0)])
def test_dim_dots_in_noise_are_followed(radius: float, noise: float) -> None:
    """Of a contrast four or five times the pixels' noise, by how much a disc's residual is of no account."""
    truth = bent(grid(), 20.0 * np.cos(2 * np.pi * np.arange(24) / 7.3))
    tracks = follow(Drawn(truth, radius=radius, noise=noise, contrast=40.0), lambda: None)
    assert tracks.pixel.shape == truth.shape
    named = order(tracks.start, truth[0])
    error = tracks.pixel[:, named] - truth
    assert np.isfinite(error).mean() > 0.98
    assert np.nanmax(np.abs(error)) < 1.0
    assert 0.8 < np.sqrt(np.nanmean((error / tracks.sigma[:, named]) ** 2)) < 1.25


def shadow(frame: int) -> np.ndarray:
    """Comes in from the left and leaves a quarter of the light."""
    return 1.0 / (1.0 + 3.0 / (1.0 + np.exp(np.clip((np.arange(SIZE[0]) - 20.0 * frame) / 15.0, -30, 30))))


def flicker(frame: int) -> np.ndarray:
    return np.full(SIZE[0], 0.8 + 0.35 * np.sin(2.1 * frame))


@pytest.mark.parametrize("light", [shadow, flicker])
def test_dots_are_followed_in_changing_light(light: Callable[[int], np.ndarray]) -> None:
    truth = bent(grid(), 20.0 * np.cos(2 * np.pi * np.arange(24) / 7.3))
    tracks = follow(Drawn(truth, light=light), lambda: None)
    assert tracks.pixel.shape == truth.shape
    found = tracks.pixel[:, order(tracks.start, truth[0])]
    assert np.isfinite(found).all()
    assert np.max(np.linalg.norm(found - truth, axis=2)) < 0.3


@pytest.mark.parametrize("swing", [10.0, 20.0, 30.0])
def test_no_dot_changes_its_identity(swing: float) -> None:
    """Up to `swing` px of tip motion, up to three quarters of a spacing a frame, in a pattern of equal dots."""
    rest = grid()
    truth = bent(rest, swing * np.cos(2 * np.pi * np.arange(24) / 7.3))
    tracks = follow(Drawn(truth), lambda: None)
    assert tracks.pixel.shape == truth.shape
    found = tracks.pixel[:, order(tracks.start, truth[0])]
    assert np.isfinite(found).mean() > 0.99
    assert np.nanmax(np.linalg.norm(found - truth, axis=2)) < 0.3


@pytest.mark.parametrize(("turn", "height"), [(0.5, 205.0), (-0.5, 20.0)])
def test_marks_on_the_frame_keep_their_names_beside_a_fast_body(turn: float, height: float) -> None:
    """Six marks stand still within a spacing of a tip that moves by one a frame; they do not move with it."""
    swinging = bent(grid(), 34.0 * np.sin(2 * np.pi * np.arange(24) / 6.3 + np.pi * turn)) - np.array([0.0, 5.0])
    marks = np.stack([30.0 + 44.0 * np.arange(6), np.full(6, height)], axis=1)
    truth = np.concatenate([swinging, np.tile(marks, (24, 1, 1))], axis=1)
    tracks = follow(Drawn(truth), lambda: None)
    found = tracks.pixel[:, order(tracks.start, truth[0])]
    assert np.isfinite(found).mean() > 0.99
    assert np.nanmax(np.linalg.norm(found - truth, axis=2)) < 0.3


def test_hidden_dots_come_back_under_their_names() -> None:
    rest = grid()
    truth = bent(rest, 15.0 * np.sin(2 * np.pi * np.arange(20) / 16))
    tracks = follow(Drawn(truth, hidden=tuple(range(6, 12))), lambda: None)
    found = tracks.pixel[:, order(tracks.start, truth[0])]
    assert np.isnan(found[6:12, :3]).all()
    assert np.abs(found[12:] - truth[12:]).max() < 0.3
    assert np.abs(found[:, 3:] - truth[:, 3:]).max() < 0.3


def test_who_comes_back_into_a_curl_is_not_taken_for_its_neighbour() -> None:
    """A strip curls by up to 2.2 rad behind a screen's edge, so that returning dots come close to where others stood.

    Guessed from the shape at rest, 24 places bore a neighbour's name. A row curled on by more than was ever seen waits.
    """
    turn = 0.45 * np.sin(0.3 * np.arange(60))[:, None] * np.arange(6)
    step = 30.0 * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    across = 17.0 * np.stack([np.cos(turn), -np.sin(turn)], axis=-1)
    middle = np.cumsum(step, axis=1)
    truth = np.stack([middle + across, middle - across], axis=2).reshape(60, 12, 2)
    truth += np.array([180.0, 20.0])
    behind = truth[..., 1] > np.median(truth[..., 1])
    behind[0] = False
    tracks = follow(Drawn(np.where(behind[..., None], np.nan, truth)), lambda: None)
    away = np.linalg.norm(tracks.pixel[:, order(tracks.start, truth[0])] - truth, axis=2)
    assert np.nanmax(away) < 0.5
    assert np.isfinite(away[~behind]).mean() > 0.65


def test_a_bar_that_passes_takes_no_names_with_it() -> None:
    """It hides five of eight columns at a time of a body that swings by half a spacing a frame.

    Where markers were told by the shapes that are most alike, two went by a neighbour's name.
    """
    truth = bent(grid(), 40.0 * np.sin(2 * np.pi * np.arange(60) / 13.1))
    bar = np.linspace(-60.0, 400.0, 60)
    behind = np.abs(truth[..., 0] - bar[:, None]) < 80.0
    behind[0] = False
    assert behind.sum(axis=1).max() == 15
    tracks = follow(Drawn(np.where(behind[..., None], np.nan, truth)), lambda: None)
    away = np.linalg.norm(tracks.pixel[:, order(tracks.start, truth[0])] - truth, axis=2)
    assert np.nanmax(away) < 0.3
    assert np.isfinite(away[~behind]).mean() > 0.99
    assert np.isfinite(away[-1]).all()


def test_dots_hidden_at_first_are_taken_in() -> None:
    """A hand holds the specimen for fifteen frames, then it swings; the dots are known from the moment they show."""
    rest = grid()
    rest = np.concatenate([rest[[4, 13, 23]], np.delete(rest, [4, 13, 23], axis=0)])
    truth = bent(rest, np.concatenate([np.zeros(15), 20.0 * np.sin(2 * np.pi * np.arange(55) / 16)]))
    tracks = follow(Drawn(truth, hidden=tuple(range(15))), lambda: None)
    assert tracks.late == 3
    assert tracks.pixel.shape == truth.shape
    match = order(tracks.start, truth[0])
    assert sorted(match) == list(range(24))
    found = tracks.pixel[:, match]
    assert np.isnan(found[:15, :3]).all()
    assert np.abs(found[15:] - truth[15:]).max() < 0.3


def test_hidden_columns_far_apart_are_taken_in() -> None:
    """Three rows, two and a half times as far from column to column as from row to row; the last two columns hide."""
    rest = grid(5, 3) * [1.6, 0.64] - [24.0, -30.0]
    truth = bent(rest, np.concatenate([np.zeros(15), 20.0 * np.sin(2 * np.pi * np.arange(85) / 16)]))
    places = truth.copy()
    places[:15, rest[:, 0] > 180.0] = np.nan
    tracks = follow(Drawn(places), lambda: None)
    assert tracks.late == 6
    match = order(tracks.start, truth[0])
    assert sorted(match) == list(range(15))
    assert np.nanmax(np.linalg.norm(tracks.pixel[:, match] - truth, axis=2)) < 0.3
    assert np.isfinite(tracks.pixel[60:]).all()


@pytest.mark.parametrize("tip", [25.0, 45.0])
def test_dots_hidden_at_first_beside_the_clamp_are_taken_in(tip: float) -> None:
    """They move by 0.2 to 10 px, and the body begins bent: from what swings nobody could tell where they belong."""
    truth = bent(grid(), tip * np.cos(0.4 * np.arange(90)))
    places = truth.copy()
    places[:20, truth[0, :, 0] < 130.0] = np.nan
    tracks = follow(Drawn(places), lambda: None)
    assert tracks.late == 9
    match = order(tracks.start, truth[0])
    assert sorted(match) == list(range(24))
    assert np.linalg.norm(tracks.start[match] - truth[0], axis=1).max() < 5.0
    assert np.nanmax(np.linalg.norm(tracks.pixel[:, match] - truth, axis=2)) < 0.3
    assert np.isfinite(tracks.pixel[-1]).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_dot_put_by_hand_beside_the_clamp_is_taken_in(seed: int) -> None:
    """It moves by 0.1 px, and stands in no row."""
    rest = grid() + np.random.default_rng(seed).uniform(-6.0, 6.0, (24, 2))
    truth = bent(rest, 2.4 * np.cos(0.4 * np.arange(90)))
    places = truth.copy()
    places[:20, 1] = np.nan
    tracks = follow(Drawn(places), lambda: None)
    assert tracks.late == 1
    assert np.linalg.norm(tracks.start[-1] - truth[0, 1]) < 1.0


@pytest.mark.parametrize("speed", [0.2, 0.3, 0.4])
def test_a_tip_hidden_at_first_is_put_where_it_was(speed: float) -> None:
    """Beyond what is in sight a strip curls as nobody could foretell; later it is seen to curl so again."""
    curls = [curled(0.14 * np.cos(speed * frame)) for frame in range(100)]
    truth = np.array(curls) + np.array([60.0, 118.0])
    places = truth.copy()
    places[:15, 6:] = np.nan
    places[:40, 12:] = np.nan
    tracks = follow(Drawn(places), lambda: None)
    assert tracks.late == 8
    match = order(tracks.start, truth[0])
    assert sorted(match) == list(range(14))
    assert np.linalg.norm(tracks.start[match] - truth[0], axis=1).max() < 2.0
    assert np.nanmax(np.linalg.norm(tracks.pixel[:, match] - truth, axis=2)) < 0.3
    assert np.isfinite(tracks.pixel[-1]).all()


@pytest.mark.parametrize("speed", [0.6, 0.65, 0.7])
def test_a_fast_tip_hidden_at_first_is_known_again_from_look_to_look(speed: float) -> None:
    """It goes nearly three spacings a frame, and seems to be anywhere on the body within one."""
    truth = np.array([curled(0.2 * np.cos(speed * frame)) for frame in range(90)]) + np.array([60.0, 118.0])
    places = truth.copy()
    places[:20, 8:] = np.nan
    tracks = follow(Drawn(places), lambda: None)
    assert tracks.late == 6
    match = order(tracks.start, truth[0])
    assert sorted(match) == list(range(14))
    assert np.nanmax(np.linalg.norm(tracks.pixel[:, match] - truth, axis=2)) < 1.0
    assert np.isfinite(tracks.pixel[-1]).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_swarm_of_dots_that_stand_still_is_not_taken_in(seed: int) -> None:
    """So many that, where the body swings, there is always one that it could have carried there."""
    truth = bent(grid(), 30.0 * np.sin(2 * np.pi * np.arange(80) / 23))
    random, blots = np.random.default_rng(seed), np.empty((0, 2))
    while len(blots) < 24:
        blot = random.uniform([8.0, 8.0], [350.0, 230.0])
        others = np.concatenate([truth.reshape(-1, 2), blots])
        if np.linalg.norm(others - blot, axis=1).min() > 16.0:
            blots = np.concatenate([blots, blot[None]])
    tracks = follow(Drawn(truth, blots=tuple(map(tuple, blots))), lambda: None)
    assert tracks.late == 0
    assert np.isfinite(tracks.pixel).mean() > 0.99
    assert np.nanmax(np.linalg.norm(tracks.pixel[:, order(tracks.start, truth[0])] - truth, axis=2)) < 0.3


@pytest.mark.parametrize("period", [10, 35, 160])
def test_what_stands_still_behind_the_body_is_not_taken_in(period: int) -> None:
    """Nor where the swinging body comes back to it again and again, or leaves it slowly."""
    truth = bent(grid(), 20.0 * np.sin(2 * np.pi * np.arange(100) / period))
    blots = ((20.0, 40.0), (160.0, 40.0), (330.0, 100.0), (330.0, 180.0), (100.0, 195.0), (220.0, 210.0))
    tracks = follow(Drawn(truth, blots=blots), lambda: None)
    assert tracks.late == 0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_shakes_with_the_camera_beside_the_clamp_is_not_taken_in(seed: int) -> None:
    """Dots that come into sight late; the clamped end of the body shakes just so."""
    truth = bent(grid(), 25.0 * np.sin(2 * np.pi * np.arange(80) / 25))
    blots = np.tile([[12.0, 55.0], [10.0, 100.0], [16.0, 135.0], [30.0, 215.0], [50.0, 30.0]], (80, 1, 1))
    blots[:5] = np.nan
    shake = np.random.default_rng(seed).normal(0.0, 0.45, (80, 1, 2))
    tracks = follow(Drawn(np.concatenate([truth, blots], axis=1) + shake), lambda: None)
    assert tracks.late == 0


def test_frames_before_the_first_that_shows_dots_are_missing() -> None:
    truth = np.concatenate([np.full((4, 24, 2), np.nan), np.repeat(grid()[None], 3, axis=0)])
    tracks = follow(Drawn(truth), lambda: None)
    assert np.isnan(tracks.pixel[:4]).all()
    assert not tracks.damaged.any()
    assert np.abs(tracks.pixel[4:, order(tracks.start, truth[4])] - truth[4:]).max() < 0.3


def test_too_few_dots_are_refused() -> None:
    with pytest.raises(InputError, match=r"drawn\.mp4: expected at least 3 dots .* found 2"):
        follow(Drawn(grid(2, 1)[None]), lambda: None)
