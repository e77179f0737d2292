import numpy as np

from rafl.tracking.reconstruction.gap_filling import fill_gaps


def test_only_short_gaps_are_filled() -> None:
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


def test_a_hidden_marker_is_predicted_from_the_others() -> None:
    """An oscillation of 30 mm at 9 Hz is hidden for 5 frames at its reversal, where a cubic is millimetres off."""
    time = 0.01 * np.arange(120)
    along = np.linspace(0.2, 1.0, 8)
    swing = 0.03 * np.sin(2 * np.pi * 9.1 * time) * np.exp(-2 * time)
    ripple = 0.002 * np.sin(2 * np.pi * 31 * time)
    truth = np.zeros((120, 8, 3))
    truth[..., 0] = 0.1 * along - 0.5 * (swing[:, None] * along) ** 2 / 0.1
    truth[..., 2] = swing[:, None] * along**2 + ripple[:, None] * np.sin(4 * along)
    random = np.random.default_rng(0)
    position = truth + random.normal(0, 2e-6, truth.shape)
    sigma = np.full(truth.shape, 2e-6)
    position[44:49, 6] = np.nan
    filled, grown, state = fill_gaps(position, sigma, time, 5)
    assert (state[44:49, 6] == 2).all()
    error = np.abs(filled[44:49, 6] - truth[44:49, 6])
    assert error.max() < 5e-5
    assert (error < 4 * grown[44:49, 6]).all()


def strip(random: np.random.Generator, frames: int) -> np.ndarray:
    """Five pairs of markers (T, 10, 3), 40 apart, on a strip that curls to and fro; the last pair is its tip."""
    time, along = np.arange(frames), np.linspace(0.0, 1.0, 400)
    slow, fast = (np.sin(2 * np.pi * rate * time + random.uniform(0, 6)) for rate in (0.07, 0.19))
    slope = 0.8 * slow[:, None] * (2 * along - along**2) + 0.1 * fast[:, None] * np.sin(2.5 * np.pi * along) * along
    line = 0.5 * np.cumsum(np.stack([np.cos(slope), np.sin(slope)], axis=2), axis=1)
    at = np.arange(39, 400, 80)
    normal = np.stack([-np.sin(slope[:, at]), np.cos(slope[:, at])], axis=2)
    pairs = line[:, at, None] + 20.0 * np.array([-1.0, 1.0])[:, None] * normal[:, :, None]
    return np.concatenate([pairs.reshape(frames, 10, 2), np.zeros((frames, 10, 1))], axis=2)


def test_a_marker_seen_in_the_gap_is_used_though_hidden_before_it() -> None:
    """One marker of the tip is hidden for five frames, the other one only in the frame before."""
    worst = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        truth = strip(random, 150)
        position = truth + random.normal(0, 0.015, truth.shape)
        position[70, 9] = position[71:76, 8] = np.nan
        filled, _, state = fill_gaps(position, np.full(truth.shape, 0.015), 0.01 * np.arange(150), 5)
        assert (state[71:76, 8] == 2).all()
        worst.append(np.abs(filled[71:76, 8] - truth[71:76, 8]).max())
    assert max(worst) < 0.15


def test_sigma_of_filled_positions_matches_their_errors() -> None:
    """It is no smaller than a measured position's, and much larger if the whole tip is hidden."""
    random = np.random.default_rng(0)
    for hidden, least, most in (([4], 1.0, 1.5), ([8, 9], 2.0, 12.0)):
        errors, sigmas = [], []
        for start in range(20, 140, 12):
            truth = strip(random, 160)
            position = truth + random.normal(0, 0.015, truth.shape)
            gap = np.ix_(range(start, start + 5), hidden, [0, 1])
            position[start : start + 5, hidden] = np.nan
            filled, grown, _ = fill_gaps(position, np.full(truth.shape, 0.015), 0.01 * np.arange(160), 5)
            errors.append((filled - truth)[gap])
            sigmas.append(grown[gap])
        error, sigma = np.array(errors), np.array(sigmas)
        assert least * 0.015 < np.median(sigma) < most * 0.015
        assert np.mean(np.abs(error) < sigma) > 0.64
        assert np.mean(np.abs(error) < 3.0 * sigma) > 0.98
