"""Motions of a beam with markers, clean and disturbed, in closed form."""

import numpy as np


def swing(
    frames: int, start: float, speed: float = 0.0, period: float = 14.0, damping: float = 0.05, centre: float = 0.0
) -> np.ndarray:
    """A damped oscillation about a centre from a position [m] and a speed [m/frame] on, (T + 1): one value more."""
    omega = 2.0 * np.pi / period
    rate, time = damping * omega, np.arange(frames + 1)
    sine = (speed + rate * (start - centre)) / omega
    decay = np.exp(-rate * time)
    return centre + decay * ((start - centre) * np.cos(omega * time) + sine * np.sin(omega * time))


def bent(deflection: np.ndarray, noise: float = 1e-5) -> np.ndarray:
    """Twelve markers on a beam of 100 mm whose tip is deflected (T) [m], (T, 12, 3), with noise [m]."""
    x, y = (axis.ravel() for axis in np.meshgrid([0.02, 0.04, 0.06, 0.08, 0.09, 0.1], [0.0, 0.03]))
    share = (x / 0.1) ** 2
    z = 0.015 + share * deflection[:, None]
    shape = np.stack([np.broadcast_to(x, z.shape) - 5.0 * share * deflection[:, None] ** 2, y + 0.0 * z, z], axis=-1)
    return shape + np.random.default_rng(0).normal(0.0, noise, shape.shape)


def joined(*parts: np.ndarray) -> np.ndarray:
    """Motions one after the other; the last value of one is the first of the next."""
    return np.concatenate([part[:-1] for part in parts])


def slack_string() -> np.ndarray:
    """A tip that swings alone for 7 frames, and more slowly and lower once a load hangs on it, which takes speed."""
    alone = swing(7, 0.012, centre=-0.002)
    speed = 0.4 * float(alone[-1] - alone[-2])
    return joined(alone, swing(120, float(alone[-1]), speed, period=26.0, centre=-0.01))


def touching_load() -> np.ndarray:
    """A load that pushes the tip again in frames 14 to 17."""
    before = swing(14, -0.02)
    pushed = swing(4, float(before[-1]), float(before[-1] - before[-2]), centre=-0.012)
    return joined(before, pushed, swing(100, float(pushed[-1]), float(pushed[-1] - pushed[-2])))
