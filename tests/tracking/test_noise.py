import numpy as np
import pytest

from tracking.noise import with_shared_errors


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
