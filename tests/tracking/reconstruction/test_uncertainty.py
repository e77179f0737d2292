from pathlib import Path

import av
import numpy as np
import pytest
from support import draw_frame

from rafl.tracking.linking.follow import follow
from rafl.tracking.reconstruction.uncertainty import with_error_floor
from rafl.tracking.video.reader import open_video


def simulated_paths(random: np.random.Generator, noise: np.ndarray) -> np.ndarray:
    """Twenty markers on a body that moves in three modes, each with noise of its own standard deviation [px]."""
    time = np.arange(200)
    modes = random.normal(size=(3, 20, 2)) * np.array([40.0, 5.0, 1.0])[:, None, None]
    amplitudes = np.stack([np.sin(0.4 * time), np.sin(1.1 * time + 1), np.cos(0.4 * time) ** 2])
    return np.einsum("kt,kdi->tdi", amplitudes, modes) + random.normal(size=(200, 20, 2)) * noise[:, None]


def with_own_errors(pixel: np.ndarray, sigma: np.ndarray, predicted_frames: bool) -> np.ndarray:
    """Sigma of dots whose outlines do not change."""
    return with_error_floor(pixel, sigma, np.full(pixel.shape, 8.0), predicted_frames)


def test_correct_standard_deviations_are_kept(random: np.random.Generator) -> None:
    sigma = np.full((200, 20, 2), 0.02)
    found = with_own_errors(simulated_paths(random, np.full(20, 0.02)), sigma, predicted_frames=False)
    assert np.mean(found / sigma) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("frames", [30, 200])
@pytest.mark.parametrize("predicted_frames", [False, True])
def test_errors_that_the_fits_do_not_show_are_found(
    random: np.random.Generator, frames: int, predicted_frames: bool
) -> None:
    """The true error of half the markers is 0.03 px, that of the others 0.06 px; their fits give 0.01 px.

    In predicted frames, a motion of more than two frequencies may count as an error as large as this.
    """
    noise = np.where(np.arange(20) < 10, 0.03, 0.06)
    pixel = simulated_paths(random, noise)[:frames]
    found = with_own_errors(pixel, np.full(pixel.shape, 0.01), predicted_frames)
    for group in (slice(0, 10), slice(10, 20)):
        ratio = np.median(found[:, group]) / noise[group].mean()
        assert 0.75 < ratio < (1.5 if predicted_frames else 1.25)


def test_errors_that_all_dots_share_are_found_in_predicted_frames(random: np.random.Generator) -> None:
    """An encoder lets all dots lag by the same share of their reach, now more and now less."""
    truth = np.sin(0.4 * np.arange(200))[:, None, None] * random.normal(size=(20, 2)) * 10.0
    shape = np.linalg.svd(truth.reshape(200, -1), full_matrices=False)[2][0].reshape(20, 2)
    shared = random.normal(size=(200, 1, 1)) * shape * np.sqrt(40.0) * 0.03
    pixel = truth + shared + 0.03 * random.normal(size=truth.shape)
    sigma = np.full(pixel.shape, 0.01)
    covered = [np.mean(np.abs(pixel - truth) < with_own_errors(pixel, sigma, each)) for each in (False, True)]
    assert covered[0] < 0.58
    assert 0.6 < covered[1] < 0.8


def test_one_outlier_enlarges_only_its_own_sigma(random: np.random.Generator) -> None:
    """An undetected damaged frame shifts one position by 16 px, and so the modes' position of the others a little."""
    pixel = simulated_paths(random, np.full(20, 0.05))
    pixel[77, 8, 1] += 16.0
    found = with_own_errors(pixel, np.full(pixel.shape, 0.05), predicted_frames=False)
    assert found[77, 8, 1] > 4.0
    assert np.median(found[77]) < 0.3
    found[77] = np.nan
    assert np.nanmax(found) < 0.3
    assert np.nanmean(found) == pytest.approx(0.05, rel=0.15)


def test_a_marker_that_moves_on_its_own_is_uncertain(random: np.random.Generator) -> None:
    """It oscillates by ten times the others' errors, which its own sigma then contains."""
    pixel = simulated_paths(random, np.full(20, 0.05))
    pixel[:, 3, 0] += 0.5 * np.sin(2.3 * np.arange(200))
    found = with_own_errors(pixel, np.full(pixel.shape, 0.05), predicted_frames=False)
    assert np.median(found[:, 3, 0]) > 0.3
    assert np.median(np.delete(found, 3, axis=1)) < 0.06


def test_sigma_is_kept_where_markers_are_hidden_or_few(random: np.random.Generator) -> None:
    pixel = simulated_paths(random, np.full(20, 0.06))
    pixel[50:60, 4] = np.nan
    sigma = np.where(np.isnan(pixel), np.nan, 0.02)
    found = with_own_errors(pixel, sigma, predicted_frames=False)
    assert np.isnan(found[50:60, 4]).all()
    assert np.isfinite(found[50:60, 5]).all()
    assert np.median(found[50:60, 5]) > 0.04
    for part in (np.s_[:, :3], np.s_[:10]):
        np.testing.assert_array_equal(with_own_errors(pixel[part], sigma[part], predicted_frames=False), sigma[part])


QUIET = {"x265-params": "log-level=none"}


@pytest.mark.parametrize(
    ("codec", "options", "swing"),
    [
        ("libx264", {"crf": "8"}, 2.0),
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
def test_sigma_includes_compression_errors(tmp_path: Path, codec: str, options: dict[str, str], swing: float) -> None:
    """A beam of dots swings by up to 20 px. It is compressed finely, or so coarsely that most motion is skipped."""
    size, frames = (416, 320), 40
    column, row = np.meshgrid(np.arange(60, 400, 56.0), np.arange(60, 260, 50.0))
    rest = np.stack([column.ravel(), row.ravel()], axis=1)
    amplitude = (rest[:, 0] / size[0]) ** 2 * np.sin(0.45 * np.arange(frames) + 1.0)[:, None]
    position = np.repeat(rest[None], frames, axis=0)
    position[..., 1] += swing * amplitude
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as output:
        stream = output.add_stream(codec, rate=100)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.options = options
        for number in range(frames):
            dots = [(x, y, 8.0, 8.0, 0.0) for x, y in position[number]]
            frame = av.VideoFrame.from_ndarray(draw_frame(dots, size, noise=3.0, seed=number), format="gray")
            output.mux(stream.encode(frame.reformat(format="yuv420p", dst_color_range="MPEG")))
        output.mux(stream.encode())
    tracks = follow(open_video(path), lambda: None)
    order = np.linalg.norm(position[0][:, None] - tracks.start[None], axis=2).argmin(axis=1)
    error, sigma = tracks.pixel[:, order] - position, tracks.sigma[:, order]
    # Encoders are not deterministic.
    ratio, covered = np.sqrt((sigma**2).mean() / (error**2).mean()), np.mean(np.abs(error) < sigma)
    slow = (
        options.get("preset") == "veryfast"
    )  # it lets slow dots lag for many frames, which looks like a slower motion
    assert (0.4 if slow else 0.5) < ratio < 1.7
    assert covered == pytest.approx(0.68, abs=0.2 if slow else 0.14)
    assert np.mean((np.abs(error) > 0.25) & (np.abs(error) > 4.0 * sigma)) < (3e-2 if slow else 7e-3)
