from pathlib import Path

import av
import numpy as np
import pytest
from rafl.tracking.detection.detect import fit_dots, start_of
from rafl.tracking.linking.follow import follow
from rafl.tracking.reconstruction.uncertainty import (
    LAGGING,
    POWER,
    STILL,
    Others,
    coding_errors,
    places_and_errors,
    share_of_noise,
    with_shared_errors,
)
from rafl.tracking.video.reader import open_video
from support import hand_drawn, outlined, picture


def paths(random: np.random.Generator, noise: np.ndarray) -> np.ndarray:
    """Twenty markers on a body that moves in three modes, each marker's places off by its own noise."""
    time = np.arange(200)
    modes = random.normal(size=(3, 20, 2)) * np.array([40.0, 5.0, 1.0])[:, None, None]
    amounts = np.stack([np.sin(0.4 * time), np.sin(1.1 * time + 1), np.cos(0.4 * time) ** 2])
    return np.einsum("kt,kdi->tdi", amounts, modes) + random.normal(size=(200, 20, 2)) * noise[:, None]


def with_others(pixel: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    others = Others.of(pixel, sigma)
    assert others is not None
    return with_shared_errors(sigma, others)


def coded(pixel: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Places and standard deviations of paths whose coding leads one to expect that error, if they move."""
    step = 16.0
    leverage = np.full(pixel.shape, (error / LAGGING) ** (1.0 / POWER) / step)
    fitted = np.where(np.isnan(pixel), np.nan, 0.3 * step * leverage)  # noise of a third of the step
    return places_and_errors(pixel, fitted, leverage, np.full(pixel.shape[:2], step), np.ones(len(pixel)), 1.0)


def test_honest_fits_are_left_alone(random: np.random.Generator) -> None:
    pixel = paths(random, np.full(20, 0.02))
    sigma = np.full(pixel.shape, 0.02)
    assert np.mean(with_others(pixel, sigma) / sigma) == pytest.approx(1.0, abs=0.05)


def test_errors_no_picture_shows_are_found(random: np.random.Generator) -> None:
    """Half of the markers are really off by 0.06 px, where their fits say 0.02."""
    noise = np.where(np.arange(20) < 10, 0.02, 0.06)
    sigma = np.full((200, 20, 2), 0.02)
    found = with_others(paths(random, noise), sigma)
    for group in (slice(0, 10), slice(10, 20)):
        assert found[0, group].mean() == pytest.approx(noise[group].mean(), rel=0.2)


@pytest.mark.parametrize("error", [0.03, 0.08])
def test_the_others_mend_what_coding_moved(random: np.random.Generator, error: float) -> None:
    """A sixteenth of the errors' variance all have in common, along the body's motion, which nobody can mend."""
    truth = paths(random, np.zeros(20))
    ways = np.linalg.svd(truth.transpose(1, 0, 2), full_matrices=False)[2][:, 0]
    shape = np.linalg.svd(truth.reshape(200, -1), full_matrices=False)[2][0].reshape(20, 2) * np.sqrt(20)
    pixel = truth + random.normal(size=(200, 20, 1)) * ways * np.sqrt(15.0) / 4.0 * error
    pixel += random.normal(size=(200, 1, 1)) * shape * 0.25 * error
    place, sigma = coded(pixel, error)
    off = np.sqrt(np.mean((place - truth) ** 2))
    assert off < 0.5 * np.sqrt(np.mean((pixel - truth) ** 2))
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(off, rel=0.2)


def test_dots_that_are_no_discs_leave_more_than_noise(random: np.random.Generator) -> None:
    """Of dots drawn by hand the fits leave what moves along with them, of discs noise only."""
    shares = []
    for waves in (0.0, 0.1):
        centres = np.array([(40.0 + 60.0 * k, 40.0) for k in range(10)]) + random.uniform(-0.5, 0.5, (10, 2))
        outlines = [hand_drawn(random, 10.0, waves) + centre for centre in centres]
        image = np.mean([outlined(outlines, (620, 80), random) for _ in range(8)], axis=0).astype(np.float32)
        starts = [start_of(x, y, np.array([0.1, 0.0, 0.1]), -120.0, 170.0) for x, y in centres]
        dots = fit_dots(image, np.array(starts))
        shares.append(share_of_noise(dots.grain, dots.residual))
    assert shares[0] == 1.0
    assert shares[1] < 0.9
    assert share_of_noise(np.zeros(3), np.zeros(3)) == 1.0
    assert share_of_noise(np.zeros(3), np.ones(3)) > 0.2  # there is always some


def test_what_moves_along_with_dots_makes_no_place_worse(random: np.random.Generator) -> None:
    """A body with small motions of its own, which errors as large as these fits' could be taken for."""
    time, error = np.arange(200), 0.02
    ways = random.normal(size=(6, 20, 2)) * np.array([40.0, 5.0, 1.0, 0.05, 0.05, 0.05])[:, None, None]
    truth = np.einsum("kt,kdi->tdi", np.sin(np.arange(1, 7)[:, None] * 0.17 * time), ways)
    pixel = truth + random.normal(size=truth.shape) * error
    step, fitted = np.full((200, 20), 4.0), np.full(pixel.shape, 0.06)
    leverage = np.full(pixel.shape, (error / LAGGING) ** (1.0 / POWER) / 4.0)
    off = []
    for noise in (1.0, 0.2):
        place, sigma = places_and_errors(pixel, fitted, leverage, step, np.ones(200), noise)
        off.append(np.sqrt(np.mean((place - truth) ** 2)))
    assert off[0] > 1.5 * error > 1.5 * off[1]
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(off[1], rel=0.35)


def test_coding_lags_along_the_way(random: np.random.Generator) -> None:
    """By 0.1 px, of markers that go at 30 degrees; of two that hardly move, the others' way tells."""
    reach = np.append(random.uniform(2.0, 20.0, 18), [0.02, 0.02])
    pixel = reach[:, None] * np.array([np.sqrt(0.75), 0.5]) * np.sin(0.45 * np.arange(200))[:, None, None]
    pixel += 0.01 * random.normal(size=pixel.shape)
    leverage, fitted = np.full(pixel.shape, (0.1 / LAGGING) ** (1.0 / POWER) / 16.0), np.full(pixel.shape, 0.02)
    square = coding_errors(pixel, fitted, leverage, np.full((200, 20), 16.0)) ** 2
    still = (STILL * 0.02) ** 2
    np.testing.assert_allclose(square.sum(axis=2) - still, 0.1**2, rtol=1e-6)
    np.testing.assert_allclose((square[..., 0] - still) / (square[..., 1] - still), 3.0, rtol=0.15)


def test_markers_that_turn_round_wait_together(random: np.random.Generator) -> None:
    """All lag where they hardly move, which is a motion of their own; the others cannot tell it from the body's."""
    speed = np.cos(0.45 * np.arange(200))
    reach = random.uniform(1.0, 1.5, 20)
    truth = np.zeros((200, 20, 2))
    truth[..., 1] = 3.0 * reach * np.sin(0.45 * np.arange(200))[:, None]
    turning = np.abs(speed) < 0.1
    pixel = truth + random.normal(size=truth.shape) * 0.1
    pixel[turning, :, 1] -= 0.25 * reach * np.sign(speed[turning, None])
    place, sigma = coded(pixel, 0.15)
    assert np.mean(np.abs(place - truth) > 4.0 * sigma) < 0.005
    assert np.median(sigma[np.abs(speed) > 0.5]) < 0.8 * np.median(sigma[turning])


@pytest.mark.parametrize("swing", [1.0, 2000.0])
def test_slow_motion_lags_in_haste(random: np.random.Generator, swing: float) -> None:
    """Three of four frames show slow markers half way to where those before and after have them, fast ones right."""
    time = np.arange(201)
    truth = np.zeros((201, 20, 2))
    truth[..., 1] = swing * np.linspace(0.5, 1.0, 20) * np.sin(0.45 * time)[:, None]
    pixel = truth + random.normal(size=truth.shape) * 0.05
    between = time % 4 > 0
    if swing < 100.0:
        for k in range(20):
            straight = np.interp(time, time[~between], truth[~between, k, 1])
            pixel[between, k, 1] += 0.5 * (straight - truth[:, k, 1])[between]
    step, fitted = 15.0, 0.03
    leverage = np.full(pixel.shape, (0.05 / LAGGING) ** (1.0 / POWER) / step)
    place, sigma = places_and_errors(
        pixel, np.full(pixel.shape, fitted), leverage, np.full((201, 20), step), np.where(between, 4.0, 1.5), 1.0
    )
    usual = np.sqrt((sigma[..., 1] ** 2).mean(axis=1))
    if swing < 100.0:
        assert np.median(usual[between]) > 1.5 * np.median(usual[~between])
        assert np.mean(np.abs(place - truth) > 3.0 * sigma) < 0.01
    else:
        assert np.median(usual[between]) == pytest.approx(np.median(usual[~between]), rel=0.2)


def test_a_marker_that_seems_still_on_a_body_that_moves_may_move(random: np.random.Generator) -> None:
    """It was not seen to: an encoder passes over so little. Where nobody moves, nothing speaks against it."""
    sigmas = []
    for swing in (0.0, 1.0):
        pixel = swing * paths(random, np.zeros(20)) + random.normal(size=(200, 20, 2)) * 0.02
        pixel[:, 3] = random.normal(size=(200, 2)) * 0.005
        sigmas.append(coded(pixel, 0.1)[1][:, 3])
    assert np.median(sigmas[1]) > 1.15 * np.median(sigmas[0])


def test_a_marker_that_moves_on_its_own_stays_where_it_was_seen(random: np.random.Generator) -> None:
    """One that trembles all the time, by ten times the error expected, and one that is jerked once: or so it seems."""
    pixel = paths(random, np.full(20, 0.05))
    pixel[:, 3, 0] += 0.5 * np.sin(2.3 * np.arange(200))
    pixel[77, 8, 1] += 1.0
    place, sigma = coded(pixel, 0.05)
    assert np.sqrt(np.mean((place - pixel)[:, 3, 0] ** 2)) < 0.02
    assert abs((place - pixel)[77, 8, 1]) < 0.05
    assert sigma[77, 8, 1] > 0.25


def test_places_stay_where_nothing_is_known_of_the_coding(random: np.random.Generator) -> None:
    pixel = paths(random, np.full(20, 0.05))
    pixel[50:60, 4] = np.nan
    sigma = np.where(np.isnan(pixel), np.nan, 0.05)
    place, _ = places_and_errors(
        pixel, sigma, np.full(pixel.shape, 0.01), np.full(pixel.shape[:2], np.nan), np.ones(200), 1.0
    )
    np.testing.assert_array_equal(place, pixel)


def test_a_place_far_off_says_so_and_no_other_does(random: np.random.Generator) -> None:
    """As a picture whose damage went unnoticed puts it, 16 px away for one frame; nothing is known of the coding."""
    pixel = paths(random, np.full(20, 0.05))
    pixel[77, 8, 1] += 16.0
    sigma = np.full(pixel.shape, 0.05)
    unknown = np.full(pixel.shape, np.nan)
    place, found = places_and_errors(pixel, sigma, unknown, unknown[..., 0], np.ones(200), 1.0)
    np.testing.assert_array_equal(place, pixel)
    assert found[77, 8, 1] > 4.0
    found[77, 8, 1] = np.nan
    assert np.nanmax(found) < 0.2
    assert np.nanmean(found) == pytest.approx(0.05, rel=0.1)


def test_frames_in_which_some_are_hidden_keep_their_places(random: np.random.Generator) -> None:
    pixel = paths(random, np.full(20, 0.05))
    pixel[50:60, 4] = np.nan
    place, sigma = coded(pixel, 0.05)
    np.testing.assert_array_equal(place[50:60], pixel[50:60])
    assert not (place[:50] == pixel[:50]).any()
    assert (sigma[50:60, 5] > sigma[60, 5]).all()


def test_of_few_frames_errors_are_told_but_no_place_is_mended(random: np.random.Generator) -> None:
    pixel = paths(random, np.full(20, 0.06))[:30]
    place, _ = coded(pixel, 0.06)
    np.testing.assert_array_equal(place, pixel)
    assert with_others(pixel, np.full(pixel.shape, 0.02)).mean() == pytest.approx(0.06, rel=0.15)


@pytest.mark.parametrize(("frames", "markers"), [(100, 6), (16, 20), (60, 7)])
def test_motion_in_more_modes_than_can_be_told_apart_is_no_error(
    random: np.random.Generator, frames: int, markers: int
) -> None:
    time = np.arange(frames)
    amounts = np.stack([np.sin(rate * time) for rate in (0.2, 0.31, 0.43, 0.57, 0.7)])
    pixel = np.einsum("kt,kdi->tdi", amounts, 5.0 * random.normal(size=(5, markers, 2)))
    pixel += random.normal(size=pixel.shape) * 0.02
    assert Others.of(pixel, np.full(pixel.shape, 0.02)) is None


QUIET = {"x265-params": "log-level=none"}


@pytest.mark.parametrize(
    ("codec", "options", "swing"),
    [
        ("libx264", {"crf": "4"}, 2.0),
        ("libx264", {"crf": "23"}, 2.0),
        ("libx264", {"crf": "23"}, 20.0),
        ("libx264", {"crf": "28"}, 2.0),
        ("libx264", {"crf": "23", "preset": "veryfast"}, 2.0),
        ("libx264", {"crf": "23", "preset": "faster"}, 8.0),
        ("libx265", {"crf": "18"} | QUIET, 8.0),
        ("libx265", {"crf": "23"} | QUIET, 20.0),
        ("libx265", {"crf": "22", "preset": "ultrafast"} | QUIET, 8.0),
        ("libsvtav1", {"crf": "30", "preset": "8"}, 8.0),
        ("libvpx-vp9", {"crf": "31", "b": "0", "cpu-used": "5"}, 8.0),
        ("mpeg4", {"qmin": "4", "qmax": "4"}, 8.0),
    ],
)
def test_sigma_knows_of_compression(tmp_path: Path, codec: str, options: dict[str, str], swing: float) -> None:
    """A beam of dots that swings by up to 20 px, coded finely or so coarsely that most motion is passed over."""
    size, frames = (416, 320), 40
    column, row = np.meshgrid(np.arange(60, 400, 56.0), np.arange(60, 260, 50.0))
    rest = np.stack([column.ravel(), row.ravel()], axis=1)
    away = (rest[:, 0] / size[0]) ** 2 * np.sin(0.45 * np.arange(frames) + 1.0)[:, None]
    place = np.repeat(rest[None], frames, axis=0)
    place[..., 1] += swing * away
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as output:
        stream = output.add_stream(codec, rate=100)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.options = options
        for number in range(frames):
            dots = [(x, y, 8.0, 8.0, 0.0) for x, y in place[number]]
            frame = av.VideoFrame.from_ndarray(picture(dots, size, noise=3.0, seed=number), format="gray")
            output.mux(stream.encode(frame.reformat(format="yuv420p", dst_color_range="MPEG")))
        output.mux(stream.encode())
    tracks = follow(open_video(path), lambda: None)
    order = np.linalg.norm(place[0][:, None] - tracks.start[None], axis=2).argmin(axis=1)
    error, sigma = tracks.pixel[:, order] - place, tracks.sigma[:, order]
    # Encoders do not write the same twice, and of fine coding, whose error is 0.004 px, too much is expected.
    ratio, covered = np.sqrt((sigma**2).mean() / (error**2).mean()), np.mean(np.abs(error) < sigma)
    fine, known = options.get("crf") == "4", codec == "libx264"
    assert 0.7 < ratio < (3.0 if fine else 1.5 if known else 2.2)
    assert covered == pytest.approx(0.68, abs=0.29 if fine else 0.14 if known else 0.24)
    assert np.mean((np.abs(error) > 0.25) & (np.abs(error) > 4.0 * sigma)) < 5e-3
