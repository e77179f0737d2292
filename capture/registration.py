"""Rigid registration of recorded markers to the specimen frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Rigid:
    """x -> R x + t.

    Attributes:
        rotation: (..., 3, 3).
        translation: [m], (..., 3).
        residual: root mean square distance after the fit [m], (...).
    """

    rotation: Array
    translation: Array
    residual: Array

    def apply(self, points: Array) -> Array:
        """Transform points (..., M, 3)."""
        return points @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :]


IDENTITY = Rigid(np.eye(3), np.zeros(3), np.zeros(()))


def rigid_fit(source: Array, target: Array) -> Rigid:
    """The proper rotation and translation that bring points onto others (Kabsch).

    Args:
        source: (..., M, 3), at least three points not in a line.
        target: (M, 3).

    Returns:
        A `Rigid` for each leading index.
    """
    source_mean = source.mean(axis=-2, keepdims=True)
    target_mean = target.mean(axis=-2)
    moment = np.swapaxes(source - source_mean, -1, -2) @ (target - target_mean)
    u, _, vt = np.linalg.svd(moment)
    flip = np.ones(moment.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    rotation = np.swapaxes(vt, -1, -2) @ (flip[..., None] * np.swapaxes(u, -1, -2))
    translation = target_mean - (rotation @ np.swapaxes(source_mean, -1, -2))[..., 0]
    moved = source @ np.swapaxes(rotation, -1, -2) + translation[..., None, :]
    residual = np.sqrt(((moved - target) ** 2).sum(-1).mean(-1))
    return Rigid(rotation, translation, residual)
