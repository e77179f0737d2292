"""What the markers of a recording look like."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rafl.tracking.detection.detect import (
    LEAST_CONTRAST,
    SAME_PLACE,
    SHADES,
    VAGUEST,
    Dots,
    apart,
    candidates,
    dots_at,
    fit_dots,
    shade_of,
)
from scipy.spatial import cKDTree

SHARP = 0.08  # px: a localisation error that a printed dot stays under
UNLIKE = 3.0  # such differences added up, in usual ones: a dot that is none of the family
STRANGE = 4.5  # likewise, though it stands where the family's rows go on: under a gloss a dot hardly looks like one
AROUND, IN_LINE, LINES = 8, 0.12, 3  # nearest members, of their distance, and how many lines it then must stand in
BESIDE = 0.5  # sine of the angle from the line to its nearest neighbour, from which on one stands beside a member
NEXT = 1.3  # breadths: farther from all members no row goes on, though lines lead there
DARKER = 0.15  # of its neighbours' light: a gloss adds some, so that such a dot's surroundings are hardly darker
DIM, DIMMEST = 0.3, 0.15  # of the usual contrast; between them a dot must keep back as large a share of the light
BLACKEST = 1.25  # shade: a dot that seems to keep back more than all light is none
SPOT_SHARE, SPOT_LEAST = 0.3, 0.5  # of the usual and of the dimmest marker's contrast: what a spot must stand out by
WORST_SIGMA = 0.4  # px: a dot located worse than this is none


@dataclass(frozen=True)
class Family:
    """What the markers of a recording have in common.

    Attributes:
        dark: darker than their surroundings.
        radius: median [px].
        contrast: median [grey levels].
        shade: median, see `Dots.shade`.
    """

    dark: bool
    radius: float
    contrast: float
    shade: float

    @classmethod
    def of(cls, dark: bool, dots: Dots) -> "Family":
        """That of these dots."""
        return cls(dark, *(float(np.median(figure)) for figure in (dots.radius, dots.contrast, dots.shade)))

    def least(self, dimmest: float) -> float:
        """What a spot must stand out by, where the dimmest of the markers has this contrast [grey levels]."""
        return float(np.copysign(min(SPOT_SHARE * abs(self.contrast), SPOT_LEAST * abs(dimmest)), self.contrast))

    def admits(self, dots: Dots) -> NDArray[np.bool_]:
        """Which dots could be markers of this family, (D)."""
        figures = dots.radius, dots.vague, dots.flattening, dots.parameters, dots.misfit, dots.used, dots.sigma
        return _admitted(self.radius, self.contrast, self.shade, *figures)


@njit(cache=True)
def _admitted(usual_radius, usual_contrast, usual_shade, radius, vague, flattening, parameters, misfit, used, sigma):
    good = np.empty(len(radius), np.bool_)
    for k in range(len(radius)):
        contrast, level = parameters[k, 8], parameters[k, 9]
        ratio = contrast / usual_contrast
        good[k] = (
            abs(np.log(radius[k] / usual_radius)) < np.log(1.35) + 2.0 * min(vague[k], VAGUEST)
            and flattening[k] > 0.45
            and DIMMEST < ratio < 3.0
            and (ratio > DIM or abs(np.log(shade_of(contrast, level) / usual_shade)) < SHADES)
            and abs(contrast) > LEAST_CONTRAST
            and misfit[k] < 0.2
            and used[k] > 0.55
            and sigma[k, 0] < WORST_SIGMA
            and sigma[k, 1] < WORST_SIGMA
        )
    return good


def _quality(dots: Dots) -> NDArray:
    """How much each counts, (D): a printed dot is located several times as well as a blot that happens to be round."""
    return 1.0 / (1.0 + (dots.sigma.max(axis=1) / SHARP) ** 2) ** 3


def _usual(figure: NDArray, quality: NDArray) -> float:
    """The median: of round blots there may be more than of markers, but they count less."""
    order = np.argsort(figure)
    counted = np.cumsum(quality[order])
    return float(figure[order[np.searchsorted(counted, 0.5 * counted[-1])]])


def _unlike(dots: Dots, usual: Dots) -> NDArray:
    """How they differ from the usual in size, contrast, fit, sigma and blur taken together, in usual differences, (D).

    A blot is a little off in all.
    """
    quality, vague = _quality(usual), np.minimum(dots.vague, VAGUEST)
    unlike = np.log(dots.radius / _usual(usual.radius, quality)) ** 2 / (0.12**2 + vague**2)
    contrast = np.log(dots.contrast / _usual(usual.contrast, quality))
    shade = np.log(dots.shade / _usual(usual.shade, quality))
    # Where less light falls on a dot, it differs more, and keeps back as large a share.
    unlike += np.minimum((contrast / 0.35) ** 2, (contrast / 0.7) ** 2 + (shade / 0.1) ** 2)
    # Where the light is dim there is more noise, and of little noise nobody asks how much it is.
    misfit, residual = _usual(usual.misfit, quality), _usual(usual.residual, quality)
    beyond = np.maximum(np.minimum(dots.misfit - misfit, dots.residual - residual), 0.0)
    unlike += (beyond / np.maximum(max(0.5 * misfit, 0.02), 0.25 * dots.residual)) ** 2
    # A stain has no edge to locate it by; but a marker may be under a glint or farther out of focus than the others.
    sigma, blur = _usual(usual.sigma.max(axis=1), quality), _usual(usual.blur, quality)
    unlike += np.maximum(np.log(dots.sigma.max(axis=1) / max(sigma, 0.01)) / 0.55, 0.0) ** 2
    unlike += np.maximum(np.log(dots.blur / max(blur, 0.5)) / 0.45, 0.0) ** 2
    return np.where(dots.shade < BLACKEST + 2.0 * vague, np.sqrt(unlike), np.inf)


def lines_through(place: NDArray, members: NDArray, most: float = np.inf) -> int:
    """In how many lines with two of the members (M, 2) a place (2) stands, as far apart, between or next to them.

    It may be beside these by `IN_LINE` of their distance, and by so much at most [px].
    """
    way = members - place
    distance = np.linalg.norm(way, axis=1)
    near = np.argsort(distance)[:AROUND]
    beside = np.minimum(IN_LINE * distance[near], most)
    tree = cKDTree(members)
    in_line = [tree.query(end)[0] < beside for end in (place + 2.0 * way[near], place - way[near])]
    return int(in_line[0].sum() + in_line[1].sum() // 2)


@njit(cache=True)
def breadth_of(rest):
    """How far apart the lines of markers (M, 2) are.

    The usual distance to the nearest that is not in line with the nearest.
    """
    count = len(rest)
    breadths = np.empty(count)
    for k in range(count):
        ways = rest - rest[k]
        distance = np.hypot(ways[:, 0], ways[:, 1])
        distance[k] = np.inf
        nearest = np.argmin(distance)
        along = ways[nearest] / max(distance[nearest], 1e-9)
        breadths[k] = np.inf
        for other in range(count):
            sine = abs(along[0] * ways[other, 1] - along[1] * ways[other, 0]) / max(distance[other], 1e-9)
            if other != k and sine > BESIDE:
                breadths[k] = min(breadths[k], distance[other])
        if breadths[k] == np.inf:
            breadths[k] = distance[nearest]
    return np.median(breadths)


def find_family(image: NDArray) -> tuple[Family, Dots] | None:
    """The markers of a picture: the largest set of well-located dots alike in size and contrast."""
    best: tuple[float, Family, Dots, NDArray] | None = None
    for dark in (True, False):
        start = candidates(image, dark)
        dots = dots_at(image, start, dark)
        dots = dots[(dots.misfit < 0.15) & (dots.flattening > 0.5)]
        quality = _quality(dots)
        for seed in range(len(dots)):
            vague = np.minimum(dots.vague + dots.vague[seed], VAGUEST)
            alike = np.abs(np.log(dots.radius / dots.radius[seed])) < np.log(1.2) + 2.0 * vague
            alike &= np.abs(np.log(dots.contrast / dots.contrast[seed])) < np.log(2.2)
            score = float(quality[alike].sum())
            if best is None or score > best[0]:
                members = dots[alike]
                members = members[_unlike(members, members) < UNLIKE]
                best = (score, Family.of(dark, members), members, start)
    return None if best is None else (best[1], _with_relatives(image, *best[1:]))


def _with_relatives(image: NDArray, family: Family, members: Dots, start: NDArray) -> Dots:
    """The members and the candidates (D, 12) that are some after all, fitted anew from what the members look like."""
    gaps = np.linalg.norm(start[:, None, :2] - members.centre, axis=2)
    left = start[gaps.min(axis=1) > SAME_PLACE * family.radius]
    left[:, 2:9] = np.median(members.parameters[:, 2:9], axis=0)
    anew = fit_dots(image, np.concatenate([members.parameters, left]))
    first, more = anew[: len(members)], anew[len(members) :]
    good, more = family.admits(first), more[family.admits(more) & more.within(image)]
    unlike = _unlike(more, members)
    nearest = np.arange(min(AROUND, len(members))) + 1
    near = cKDTree(members.centre).query(more.centre, nearest)[1]
    level = np.median(members.parameters[near, 9], axis=1)
    light = np.maximum(level, level + family.contrast)
    glossy = (unlike < STRANGE) & (level - more.parameters[:, 9] < DARKER * light)
    next_to = NEXT * breadth_of(members.centre)
    kin, before = unlike < UNLIKE, -1
    while kin.sum() > before:  # each that is found lengthens lines
        before = int(kin.sum())
        known = np.concatenate([members.centre, more.centre[kin]])
        lines = np.array([lines_through(place, known) for place in more.centre], int)
        kin |= (lines >= LINES) & (cKDTree(known).query(more.centre)[0] < next_to) & glossy
    return apart(first[good].beside(members[~good]).beside(more[kin]), SAME_PLACE * family.radius)
