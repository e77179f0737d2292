from pathlib import Path

import av
import numpy as np
import pytest
from support import picture

from tracking.follow import follow
from tracking.noise import with_shared_errors
from tracking.video import open_video


def paths(random: np.random.Generator, noise: np.ndarray) -> np.ndarray:
    """Twenty markers on a body that moves in three modes, each marker's places off by its own noise."""
    time = np.arange(200)
    modes = random.normal(size=(3, 20, 2)) * np.array([40.0, 5.0, 1.0])[:, None, None]
    amounts = np.stack([np.sin(0.4 * time), np.sin(1.1 * time + 1), np.cos(0.4 * time) ** 2])
    return np.einsum("kt,kdi->tdi", amounts, modes) + random.normal(size=(200, 20, 2)) * noise[:, None]


def test_honest_fits_are_left_alone(random: np.random.Generator) -> None:
    pixel = paths(random, np.full(20, 0.02))
    sigma = np.full(pixel.shape, 0.02)
    assert np.mean(with_shared_errors(pixel, sigma) / sigma) == pytest.approx(1.0, abs=0.05)


def test_errors_no_picture_shows_are_found(random: np.random.Generator) -> None:
    """Half of the markers are really off by 0.06 px, where their fits say 0.02."""
    noise = np.where(np.arange(20) < 10, 0.02, 0.06)
    sigma = np.full((200, 20, 2), 0.02)
    found = with_shared_errors(paths(random, noise), sigma)
    for group in (slice(0, 10), slice(10, 20)):
        assert found[0, group].mean() == pytest.approx(noise[group].mean(), rel=0.2)


def test_few_frames_say_nothing(random: np.random.Generator) -> None:
    pixel = paths(random, np.full(20, 0.1))[:20]
    sigma = np.full(pixel.shape, 0.02)
    np.testing.assert_array_equal(with_shared_errors(pixel, sigma), sigma)


@pytest.mark.parametrize(("crf", "swing"), [("4", 2.0), ("23", 2.0), ("23", 20.0), ("28", 2.0)])
def test_sigma_knows_of_compression(tmp_path: Path, crf: str, swing: float) -> None:
    """A beam of dots that swings by up to 2 or 20 px, coded finely or so coarsely that most motion is passed over."""
    size, frames = (416, 320), 40
    column, row = np.meshgrid(np.arange(60, 400, 56.0), np.arange(60, 260, 50.0))
    rest = np.stack([column.ravel(), row.ravel()], axis=1)
    away = (rest[:, 0] / size[0]) ** 2 * np.sin(0.45 * np.arange(frames) + 1.0)[:, None]
    place = np.repeat(rest[None], frames, axis=0)
    place[..., 1] += swing * away
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=100)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.options = {"crf": crf}
        for number in range(frames):
            dots = [(x, y, 8.0, 8.0, 0.0) for x, y in place[number]]
            frame = av.VideoFrame.from_ndarray(picture(dots, size, noise=3.0, seed=number), format="gray")
            output.mux(stream.encode(frame.reformat(format="yuv420p", dst_color_range="MPEG")))
        output.mux(stream.encode())
    tracks = follow(open_video(path), lambda: None)
    order = np.linalg.norm(place[0][:, None] - tracks.start[None], axis=2).argmin(axis=1)
    error, sigma = tracks.pixel[:, order] - place, tracks.sigma[:, order]
    assert 0.65 < np.sqrt((sigma**2).mean() / (error**2).mean()) < 1.6
    assert np.mean(np.abs(error) < sigma) == pytest.approx(0.7, abs=0.12)
    assert np.mean((np.abs(error) > 0.25) & (np.abs(error) > 4.0 * sigma)) < 5e-3
