"""The free motion after a release: the frame from which on nothing but gravity and elasticity moves the specimen."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rafl.capture.registration.rigid import MIN_MARKERS, kabsch

Array = NDArray[Any]

MEASURED_SHARE = 0.75  # of the markers; the others of a frame are interpolated in time, or the frame is left out
HELD_RADIUS = 0.1  # distance from the centre of points that hold the rotation, relative to the markers' own
MODES = 2  # a release excites one mode of bending, or one of torsion and the bending under gravity
# Largest difference between a frame and its prediction, relative to the amplitude. Clean releases leave up to 0.04,
# simulated ones of elastic and relaxing materials and that of a real beam, and 0.07 after a twist by 126 degrees. A
# load that touches again, a hand that lowers it and a string that is slack at first leave 0.14 to 1.
MAX_UNEXPLAINED = 0.1
LATER_FACTOR = 1.5  # and relative to the largest difference in the two periods that follow
# Degree of the polynomial through the frames of the first eighth of a period: from rest, motion begins as a parabola. A
# higher degree would follow the modes that decay within frames.
VELOCITY_DEGREE = 2
# A release is found to the nearest frame, so that half a frame of acceleration may have passed; the rest is error.
MAX_REST_FRAMES = 0.75
MIN_SPEED_SIGMAS = 3.0
MIN_FRAMES = 10  # fewer show no oscillation


@dataclass(frozen=True)
class FreeMotion:
    """The motion of the markers as one body.

    Attributes:
        modes: the two largest principal components of the pose of all markers [m], (T, 2); NaN where too few markers
            are measured. An angle counts as the arc at the markers' root mean square distance from their centre.
        period: of the oscillation [frames].
    """

    modes: Array
    period: float

    @classmethod
    def of(cls, position: Array) -> "FreeMotion | None":
        """The motion of markers (T, M, 3) [m], in any frame; None if they do not oscillate."""
        pose = _pose_coordinates(position)
        known = np.isfinite(pose[:, 0])
        if known.sum() < MIN_FRAMES:
            return None
        axes = np.linalg.svd(pose[known], full_matrices=False)[2][:MODES]
        modes = pose @ axes.T
        period = _period(modes[:, 0])
        return None if period is None else cls(modes, period)

    def free_from(self) -> int | None:
        """The first frame from which on the motion is free; None if there is none in the first half.

        Where too few frames follow to tell, it is frame 0.
        """
        if np.isnan(self._differences(0)).all():
            return 0
        return next((frame for frame in range(len(self.modes) // 2) if self._free(frame)), None)

    def moves(self) -> bool:
        """Whether the specimen moves in the first frame, by its velocity there and the amplitude of the motion.

        After n frames of acceleration from rest the speed is (2 pi / P)^2 n times the amplitude, with the period P in
        frames.
        """
        near = self.modes[: max(int(self.period / 8), VELOCITY_DEGREE) + 1]
        known = np.flatnonzero(np.isfinite(near[:, 0]))
        if len(known) <= VELOCITY_DEGREE:
            return False
        inverse = np.linalg.pinv(np.vander(known, VELOCITY_DEGREE + 1, increasing=True).astype(float))[1]
        speed = float(np.linalg.norm(inverse @ near[known]))
        at_rest = (2.0 * np.pi / self.period) ** 2 * MAX_REST_FRAMES * float(np.nanmax(np.abs(self.modes[:, 0])))
        sigma = float(np.linalg.norm(inverse) * np.nanmedian(self._differences(0)))
        return speed > max(at_rest, MIN_SPEED_SIGMAS * sigma)

    def _free(self, start: int) -> bool:
        """Whether a free motion from `start` on explains the first two periods as well as the two after them."""
        difference = self._differences(start)
        two = round(2.0 * self.period)
        first, later = difference[:two], difference[two : 2 * two]
        if not np.isfinite(first).any():
            return False
        typical = float(np.nanmax(later)) if np.isfinite(later).any() else 0.0
        amplitude = float(np.nanmax(np.abs(self.modes[start:, 0])))
        return float(np.nanmax(first)) <= max(MAX_UNEXPLAINED * amplitude, LATER_FACTOR * typical)

    def _differences(self, start: int) -> Array:
        """Distances [m] of the frames from `start` on from a free motion; NaN where it is not known.

        A free motion of small amplitude is linear: with as many coordinates as modes, every frame t is the same linear
        function of later ones. With k frames in a quarter period,

            y(t) = A y(t + k) + B y(t + 2 k) + C y(t + 3 k) + d.

        An elastic material needs two of them, and one that relaxes slowly a third. Least squares over all frames from
        `start` on give A, B, C and d, whatever the material. Later frames predict earlier ones, because they are the
        ones that are free in any case.
        """
        y, k = self.modes[start:], max(int(self.period / 4), 1)
        count = max(len(y) - 3 * k, 0)
        rows = np.column_stack([*(y[lag * k : lag * k + count] for lag in (1, 2, 3)), np.ones(count)])
        known = np.isfinite(rows).all(axis=1) & np.isfinite(y[:count]).all(axis=1)
        if known.sum() < 2 * rows.shape[1]:
            return np.full(count, np.nan)
        relation = np.linalg.lstsq(rows[known], y[:count][known], rcond=None)[0]
        difference: Array = np.linalg.norm(y[:count] - rows @ relation, axis=1)
        return difference


def _pose_coordinates(position: Array) -> Array:
    """Translation and rotation of all markers from where they settle [m], (T, 6); NaN where too few are measured.

    Twisted and bent specimens move on arcs, on which positions are no linear functions of each other; angles are. Six
    more points near the centre, which only translate, hold the rotation about a row of markers.
    """
    frames = np.arange(len(position))
    measured = np.isfinite(position[..., 0])
    used = np.flatnonzero(measured.mean(axis=0) >= MEASURED_SHARE)
    pose = np.full((len(position), 6), np.nan)
    if len(used) < MIN_MARKERS:
        return pose
    filled = position[:, used].copy()
    for number, marker in enumerate(used):
        seen = measured[:, marker]
        for axis in range(3):
            filled[:, number, axis] = np.interp(frames, frames[seen], position[seen, marker, axis])
    enough = measured[:, used].sum(axis=1) >= max(MIN_MARKERS, MEASURED_SHARE * len(used))
    settled = np.median(filled[len(filled) // 2 :], axis=0)
    centre = settled.mean(axis=0)
    radius = float(np.sqrt(((settled - centre) ** 2).sum(axis=1).mean()))
    moved = filled.mean(axis=1)
    near = HELD_RADIUS * radius * np.concatenate([np.eye(3), -np.eye(3)])
    source, target = np.concatenate([filled, moved[:, None] + near], axis=1), np.concatenate([settled, centre + near])
    rotation = Rotation.from_matrix(kabsch(source, target).rotation).inv().as_rotvec()
    whole = np.concatenate([moved - centre, radius * rotation], axis=1)
    pose[enough] = whole[enough]
    return pose


def _period(x: Array) -> float | None:
    """Period of x (T) [frames], four times the first zero of its autocorrelation; None if it has none."""
    known = np.where(np.isfinite(x), x, 0.0)
    correlation = np.correlate(known, known, "full")[len(x) - 1 :]
    negative = np.flatnonzero(correlation[: len(x) // 4 + 1] < 0.0)
    if not len(negative):
        return None
    before, after = correlation[negative[0] - 1 : negative[0] + 1]
    return 4.0 * float(negative[0] - 1 + before / (before - after))
