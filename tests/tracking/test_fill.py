import numpy as np

from tracking.fill import fill_gaps


def test_short_gaps_are_filled_and_long_ones_left() -> None:
    time = 0.01 * np.arange(40)
    truth = np.stack([np.sin(20 * time), np.cos(15 * time), time], axis=-1)[:, None]
    position, sigma = truth.copy(), np.full((40, 1, 3), 1e-4)
    position[10:13] = np.nan
    position[20:30] = np.nan
    position[:2] = np.nan
    filled, grown, state = fill_gaps(position, sigma, time, 5)
    assert state[:, 0].tolist() == [0, 0, *[1] * 8, 2, 2, 2, *[1] * 7, *[0] * 10, *[1] * 10]
    assert np.abs(filled[10:13] - truth[10:13]).max() < 2e-3
    assert (np.abs(filled[10:13] - truth[10:13]) < 3 * grown[10:13]).all()
    assert (grown[10:13] > sigma[0]).all()
    assert np.isnan(filled[20:30]).all()


def test_a_hidden_marker_moves_as_its_neighbours_do() -> None:
    """A swing of 30 mm at 9 Hz, 5 frames hidden across its turning point: a cubic in time is off by millimetres."""
    time = 0.01 * np.arange(120)
    place = np.linspace(0.2, 1.0, 8)
    swing = 0.03 * np.sin(2 * np.pi * 9.1 * time) * np.exp(-2 * time)
    ripple = 0.002 * np.sin(2 * np.pi * 31 * time)
    truth = np.zeros((120, 8, 3))
    truth[..., 0] = 0.1 * place - 0.5 * (swing[:, None] * place) ** 2 / 0.1
    truth[..., 2] = swing[:, None] * place**2 + ripple[:, None] * np.sin(4 * place)
    random = np.random.default_rng(0)
    position = truth + random.normal(0, 2e-6, truth.shape)
    sigma = np.full(truth.shape, 2e-6)
    position[44:49, 6] = np.nan
    filled, grown, state = fill_gaps(position, sigma, time, 5)
    assert (state[44:49, 6] == 2).all()
    error = np.abs(filled[44:49, 6] - truth[44:49, 6])
    assert error.max() < 5e-5
    assert (error < 4 * grown[44:49, 6]).all()
