"""What the markers of a recording look like."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tracking.dots import LEAST_CONTRAST, VAGUEST, Dots, find_dots

SHARP = 0.08  # px: a localisation error that a printed dot stays under
UNLIKE = 3.0  # such differences added up, in usual ones: a dot that is none of the family
WORST_SIGMA = 0.4  # px: a dot located worse than this is none


@dataclass(frozen=True)
class Family:
    """What the markers of a recording have in common.

    Attributes:
        dark: darker than their surroundings.
        radius: median [px].
        contrast: median [grey levels].
    """

    dark: bool
    radius: float
    contrast: float

    def admits(self, dots: Dots) -> NDArray[np.bool_]:
        """Which dots could be markers of this family, (D)."""
        figures = dots.radius, dots.vague, dots.flattening, dots.contrast, dots.residual, dots.used, dots.sigma
        return _admitted(self.radius, self.contrast, *figures)


@njit(cache=True)
def _admitted(usual_radius, usual_contrast, radius, vague, flattening, contrast, residual, used, sigma):  # type: ignore[no-untyped-def]
    good = np.empty(len(radius), np.bool_)
    for k in range(len(radius)):
        ratio = contrast[k] / usual_contrast
        good[k] = (
            abs(np.log(radius[k] / usual_radius)) < np.log(1.35) + 2.0 * min(vague[k], VAGUEST)
            and flattening[k] > 0.45
            and 0.3 < ratio < 3.0
            and abs(contrast[k]) > LEAST_CONTRAST
            and residual[k] < 0.2
            and used[k] > 0.55
            and sigma[k, 0] < WORST_SIGMA
            and sigma[k, 1] < WORST_SIGMA
        )
    return good


def _kin(dots: Dots) -> Dots:
    """Those that are like most in size, contrast and fit taken together: a blot is a little off in all."""
    vague = np.minimum(dots.vague, VAGUEST)
    unlike = np.log(dots.radius / np.median(dots.radius)) ** 2 / (0.12**2 + vague**2)
    unlike += (np.log(dots.contrast / np.median(dots.contrast)) / 0.35) ** 2
    worse = dots.residual - np.median(dots.residual)
    unlike += (np.maximum(worse, 0.0) / max(0.5 * float(np.median(dots.residual)), 0.02)) ** 2
    return dots[unlike < UNLIKE**2]


def find_family(image: NDArray) -> tuple[Family, Dots] | None:
    """The markers of a picture: the largest set of well-located dots alike in size and contrast."""
    best: tuple[float, Family, Dots] | None = None
    for dark in (True, False):
        dots = find_dots(image, dark)
        dots = dots[(dots.residual < 0.15) & (dots.flattening > 0.5)]
        # A printed dot is located ten times as well as a blot that happens to be round.
        sigma = dots.sigma.max(axis=1)
        quality = 1.0 / (1.0 + (sigma / SHARP) ** 2) ** 2
        for seed in range(len(dots)):
            vague = np.minimum(dots.vague + dots.vague[seed], VAGUEST)
            alike = np.abs(np.log(dots.radius / dots.radius[seed])) < np.log(1.2) + 2.0 * vague
            alike &= np.abs(np.log(dots.contrast / dots.contrast[seed])) < np.log(2.2)
            score = float(quality[alike].sum())
            if best is None or score > best[0]:
                members = _kin(dots[alike & (sigma < max(5.0 * float(np.median(sigma[alike])), 0.05))])
                family = Family(dark, float(np.median(members.radius)), float(np.median(members.contrast)))
                best = (score, family, members)
    return None if best is None else (best[1], best[2])
