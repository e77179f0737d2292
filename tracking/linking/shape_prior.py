"""The shapes a body was seen in, by which its markers out of sight are placed.

A body swings through the same shapes again and again. What of it is in sight says which of them it is in, and so where
the rest of it is; a shape never seen before is at least smooth. In numbers: the markers' places are drawn from a normal
distribution about the mean of the shapes that are nearest to what is in sight, in which those differ as these do and,
the less the more shapes there were, as bodies that move, turn, bend and stretch smoothly; the markers in sight
condition it.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.spatial import cKDTree

Array = NDArray[Any]

MOST = 128  # shapes kept; of longer recordings every second, fourth, ... frame's
NEAREST = 8  # of them, about which another may lie
WIDER = 4.0  # times their differences: so much is nothing surprising
SMOOTH, SMOOTHEST = 32, 1e-8  # ways of bending smoothly: how many, and their least share of the largest one's variance
AROUND = 4  # nearest markers, the farthest of which tells how far apart markers are on the whole: the unit below
MOVING, BENDS = 5.0, 6  # standard deviation of moving and turning, much less of bending; of how many degrees
STRETCHING, LENGTH = 0.4, 5.0  # standard deviation of stretching and shearing, and over what it is smooth
FADED = 5.0, 10.0  # shapes after which moving and turning, and all else, are half as likely
NEW = 0.1  # from the last shape kept that any marker must have moved, for another
EXACT = 0.01  # standard deviation of what neither holds
ABOUT = 8.0  # side of the square in which a dot may be anywhere


class Belief(NamedTuple):
    """Where markers are thought to be.

    Attributes:
        place: [px], (M, 2).
        sigma: standard deviation of that along x and along y [px], (M); infinite where nothing is known.
    """

    place: Array
    sigma: Array


class Memory:
    """Shapes from the recording so far, evenly spread over it."""

    def __init__(self, rest: Array) -> None:
        """Of markers at rest at these places [px], (M, 2)."""
        self._rest = rest
        distance = cKDTree(rest).query(rest, min(AROUND + 1, len(rest)))[0]
        self._unit = float(np.median(distance[:, -1]))
        self._error = EXACT * self._unit
        turning, stretching = self._turning(), self._stretching()
        self._any = np.concatenate([turning, stretching], axis=1)
        self._fading = np.repeat([FADED[0], FADED[1]], [4, self._any.shape[1] - 4])
        self._shapes = np.empty((0, 2 * len(rest)))  # ways from rest
        self._every, self._added = 1, 0
        self._known = np.zeros(len(rest))  # shapes in which each was seen

    def __len__(self) -> int:
        """How many shapes."""
        return len(self._shapes)

    def _turning(self) -> Array:
        """Ways to move, turn, grow and bend that leave rows square to columns, as likely as they are [px], (2 M, K).

        Complex Chebyshev polynomials along the body's length: the real part of their values is the way along it, the
        imaginary part that across it.
        """
        arm = self._rest - self._rest.mean(axis=0)
        axis = complex(*np.linalg.eigh(arm.T @ arm)[1][:, -1])
        place = (arm[:, 0] + 1j * arm[:, 1]) * np.conj(axis)
        half = max(float(np.abs(place.real).max()), self._unit)
        ways = []
        for degree in range(BENDS):
            likely = MOVING * self._unit * max(1.0, half / (3.0 * self._unit)) ** (degree == 1) / max(degree, 1) ** 4
            bent = np.polynomial.chebyshev.chebval(place / half, np.eye(BENDS)[degree])
            ways += [likely * axis * bent, likely * axis * 1j * bent]
        return np.stack([np.stack([way.real, way.imag], axis=1).ravel() for way in ways], axis=1)

    def _stretching(self) -> Array:
        """Ways to stretch and shear smoothly, as likely as they are [px], (2 M, K)."""
        square = ((self._rest[:, None] - self._rest[None]) ** 2).sum(axis=2)
        variance, ways = np.linalg.eigh(np.exp(-0.5 * square / (LENGTH * self._unit) ** 2))
        variance, ways = variance[-SMOOTH:], ways[:, -SMOOTH:]
        large = variance > SMOOTHEST * variance[-1]
        return np.kron(STRETCHING * self._unit * ways[:, large] * np.sqrt(variance[large]), np.eye(2))

    def add(self, place: Array, seen: NDArray[np.bool_]) -> None:
        """The markers' places [px], (M, 2), in the next frame, seen (M) or believed."""
        away = place - self._rest
        if len(self._shapes) and np.abs(away.ravel() - self._shapes[-1]).max() < NEW * self._unit:
            return
        self._added += 1
        self._known += seen
        if self._added % self._every:
            return
        if len(self._shapes) == MOST:
            self._shapes = self._shapes[1::2]
            self._every *= 2
        self._shapes = np.concatenate([self._shapes, away.reshape(1, -1)])

    def join(self, rest: Array) -> "Memory":
        """The same with one more marker, by its place at rest [px], (2)."""
        joined = Memory(np.concatenate([self._rest, rest[None]]))
        known = np.arange(len(joined._rest)) < len(self._rest)
        for shape in self._shapes:
            place = joined._rest.copy()
            place[:-1] += shape.reshape(-1, 2)
            away = joined.carried(place, known).place - joined._rest
            joined._shapes = np.concatenate([joined._shapes, away.reshape(1, -1)])
        joined._every, joined._added, joined._known = self._every, self._added, np.append(self._known, 0.0)
        return joined

    def carried(self, position: Array, known: NDArray[np.bool_], guess: Belief | None = None) -> Belief:
        """Where the markers are.

        Args:
            position: of the known markers [px], (M, 2).
            known: which these are, (M).
            guess: of the others, by their own motion. What it misses of one it may miss of all.

        Returns:
            The known ones at their position, with a sigma of 0.
        """
        if known.all():
            return Belief(position.copy(), np.zeros(len(known)))
        place, weight = np.where(known[:, None], position, self._rest), known.astype(float)
        if guess is not None:
            unsure = (~known).sum() * guess.sigma**2
            weight = np.where(known, 1.0, self._error**2 / (self._error**2 + unsure))  # as if of a known one's error
            place = np.where(known[:, None] | (weight == 0.0)[:, None], place, guess.place)
        told, hidden = np.repeat(weight, 2), np.repeat(~known, 2)
        middle, ways = self._about(place, told, ~known)
        own = place.ravel() - middle
        factor, amounts = self._fitted(own, told, ways)
        left = own - ways @ amounts
        surprise = ((told * left**2).sum() / self._error**2 + (amounts**2).sum()) / max(told.sum(), 1.0)
        cone = self._error * solve_triangular(factor, ways[hidden].T, lower=True)
        square = 0.5 * (cone**2).sum(axis=0).reshape(-1, 2).sum(axis=1)
        place[~known] = (middle + ways @ amounts).reshape(-1, 2)[~known]
        sigma = np.zeros(len(known))
        sigma[~known] = np.sqrt(max(surprise, 1.0) * square + self._error**2)
        return Belief(place, sigma)

    def smoothed(self, position: Array, known: NDArray[np.bool_]) -> Array:
        """Where markers are likely (M, 2), known ones (M) too, by the known ones' positions [px], (M, 2)."""
        told = np.repeat(known.astype(float), 2)
        middle, ways = self._about(position, told, known)
        return (middle + ways @ self._fitted(position.ravel() - middle, told, ways)[1]).reshape(-1, 2)

    def evidence(self, position: Array, known: NDArray[np.bool_]) -> tuple[float, float]:
        """How likely places [px], (M, 2), of the known markers (M) are, and how surprising.

        Returns:
            The logarithm of their density beside that of dots anywhere about the body, and the mean square of what
            should be standard normal numbers: 1, or less where they are explained with amounts to spare.
        """
        told = np.repeat(known.astype(float), 2)
        middle, ways = self._about(position, told, known)
        own = position.ravel() - middle
        factor, amounts = self._fitted(own, told, ways)
        square = (told * (own - ways @ amounts) ** 2).sum() / self._error**2 + (amounts**2).sum()
        count = told.sum()
        volume = np.log(np.diag(factor) / self._error).sum() + count * np.log(self._error)
        return float(count * np.log(ABOUT * self._unit) - 0.5 * square - volume), float(square / max(count, 1.0))

    def shapes(self, most: int) -> list[Array]:
        """Up to so many of the shapes, evenly spread: places [px], (M, 2)."""
        chosen = np.unique(np.linspace(0, len(self._shapes) - 1, min(most, len(self._shapes))).astype(int))
        return [self._rest + self._shapes[k].reshape(-1, 2) for k in chosen]

    def _about(self, place: Array, told: Array, asked: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Where the body may be, (2 M), and its ways from there, as long as they are likely, (2 M, K) [px].

        Args:
            place: of the markers [px], (M, 2).
            told: how much the coordinates of these count, (2 M).
            asked: the markers of whom it is to be known, (M).
        """
        known = self._known[asked].min(initial=self._added)
        any_ways = self._any * (self._fading / (self._fading + known))
        if not len(self._shapes):
            return self._rest.ravel(), any_ways
        away = (self._shapes - (place - self._rest).ravel()) ** 2 @ told
        near = self._shapes[np.argsort(away)[:NEAREST]]
        middle = near.mean(axis=0)
        seen_ways = WIDER / np.sqrt(len(near)) * (near - middle).T
        return self._rest.ravel() + middle, np.concatenate([any_ways, seen_ways], axis=1)

    def _fitted(self, own: Array, told: Array, ways: Array) -> tuple[Array, Array]:
        """The Cholesky factor of the normal equations, (K, K), and the amounts of the ways that give the own, (K)."""
        heavy = ways * told[:, None]
        moment = ways.T @ heavy + self._error**2 * np.eye(ways.shape[1])
        factor = np.linalg.cholesky(moment)
        return factor, cho_solve((factor, True), heavy.T @ own)
