"""How well dots were really located, which one picture cannot tell, and what the other dots' motion can mend.

Compression moves whole dots a little, most where the picture changes slowly, and leaves no trace in
the fit. But markers ride on one body: what a marker's path has that the others' do not is error.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Errors of coded pictures: along an axis in which the marker keeps still, against the fit's own, which takes errors of
# neighbouring pixels for independent; and along its way [px], where the encoder lets it lag, of what independent errors
# of one step in each pixel would make, to a power. Measured on 115 films: libx264, crf 12 to 28, medium preset, noise
# of 1.5 to 5 grey levels, dots of 6 to 11 px, contrasts of 35 to 150; of quicker presets the decoding tells larger
# steps.
STILL, LAGGING, POWER = 1.69, 0.346, 0.664
# Of these errors' variance, what all markers have in common against what each has alone: times the step over the noise
# of the first picture, by so much less as the errors are larger than those along an axis in which the marker keeps
# still, and by so many powers of e more before and after frames to which a marker moves less than SLOW of these errors:
# where markers turn round, they wait together until the encoder takes notice. Measured on 260 films of six presets of
# x264 at crf 14 to 30, otherwise as above, of bodies that swing, are let go or move in three modes along any direction.
SHARED, WAITING, SLOW = 0.030, 3.0, 8.0
# The share of markers that move by more than these errors from which on others may move too, unseen by the encoder.
FEW = 0.05
# So many of the variances of errors across its way tell as much of a marker's direction as its path does.
UNDIRECTED = 4.0
# So many of the errors of an encoder in a hurry a marker moves from frame to frame where haste does half its harm.
# Measured on 48 films of x264's presets from superfast to fast.
FAST = 13.0
# So many times these errors may, together, pass for a mode of the body's own motion.
PASSING = 2.0
LEAST_GRAIN, SMOOTHEST = 0.6, 0.5  # see `share_of_noise`; and what share of the former counts at least
# By whose motion places are mended; and errors told, if it has no more modes than may be taken off.
FEWEST_FRAMES, FEWEST_MARKERS = 40, 8
FEW_FRAMES, FEW_MARKERS = 12, 4
MODES = 12  # of the body's motion, at most
SPARE = 8  # further ones, of which those of the other markers may need a little
VANISHED = 1e-6  # share of a mode's square that others than one marker have: it is that marker's alone
TELLING = 0.3  # of a fit's variance: an excess smaller than this may be chance
OUTLYING = 6.0  # medians of a marker's distances from where the others put it: farther ones are few
SURPRISING = 3.0  # standard deviations: farther from where the others put it, a marker moves on its own


def share_of_noise(grain: Array, residual: Array) -> float:
    """Share of the fits' standard deviations that is noise: the rest, as dots that are no discs leave, moves with them.

    Of what neighbouring pixels' residuals do not share, (D), over all of them, (D). Fits of discs in coded pictures
    have 0.6 to 1 of it, of dots drawn by hand but for noise 0.45 to 0.55.
    """
    share = np.divide(grain, residual, out=np.ones_like(grain), where=residual > 0.0)
    return float(np.clip(np.median(share) / LEAST_GRAIN, SMOOTHEST, 1.0)) ** 2


def places_and_errors(
    pixel: Array, fitted: Array, leverage: Array, step: Array, lag: Array, noise: float
) -> tuple[Array, Array]:
    """The markers' places and standard deviations [px], (T, D, 2) each, after all frames have been seen.

    Places change only where the pictures were coded with known steps: there a marker is drawn towards where the
    others' motion puts it, by as much as the coding's errors and the body's own irregular motion call for.

    Args:
        pixel: paths as fitted [px], (T, D, 2), NaN where not seen.
        fitted: standard deviations from the fits [px], (T, D, 2).
        leverage: what a grey level of independent noise in every pixel moves a centre by [px], (T, D, 2), NaN where
            not known.
        step: by which the picture was rounded there [grey levels], (T, D), NaN where not known: as in other frames.
        lag: so many times coarser than these steps each frame is where nothing moves fast, (T).
        noise: share of `fitted` that is noise, see `share_of_noise`.
    """
    known = everywhere(step)
    haste = harm_of_haste(pixel, leverage, known, lag)
    shown = fitted * noise if np.isfinite(step).any() else fitted
    coding = coding_errors(pixel, shown, leverage, haste * known)
    expected = np.maximum(fitted, coding)
    others = Others.of(pixel, np.maximum(shown, PASSING * coding))
    if others is None:
        return pixel, expected
    if not others.are_many:
        return pixel, with_shared_errors(expected, others)
    off, mended = mendable(pixel, shown, coding, others, step_over_noise(shown, leverage, step) * haste)
    if np.isnan(mended).any():
        mended = np.where(np.isnan(mended), with_shared_errors(expected, others), mended)
    return pixel - off, mended


def everywhere(step: Array) -> Array:
    """Steps as told, and where not, as they usually are at that marker, or at all, (T, D)."""
    told = np.isfinite(step)
    square = np.nansum(step**2, axis=0) / np.maximum(told.sum(axis=0), 1)
    usual = np.where(told.any(axis=0), square, np.nansum(step**2) / max(told.sum(), 1)) ** 0.5
    return np.where(told, step, usual)


def square_of_way(pixel: Array) -> Array:
    """Square of the way to this frame or to the next, the longer [px^2], (T, D); 0 where neither is known."""
    x, y = np.moveaxis(np.diff(pixel, axis=0), 2, 0)
    way = np.pad(x**2 + y**2, ((1, 1), (0, 0)), constant_values=np.nan)
    return np.nan_to_num(np.fmax(way[:-1], way[1:]))


def harm_of_haste(pixel: Array, leverage: Array, step: Array, lag: Array) -> Array:
    """How much coarser frames are at each marker than by their steps alone, (T, D).

    An encoder in a hurry lets slow motion lag, most in frames that it makes of those before and after, but not fast
    motion. Arguments as for `places_and_errors`, steps known everywhere.
    """
    if (lag == 1.0).all():
        return np.ones(step.shape)
    rounded = np.nan_to_num(leverage) * (lag[:, None] * step)[..., None]
    slow = FAST**2 * ((LAGGING * rounded**POWER) ** 2).mean(axis=2)
    return 1.0 + (lag[:, None] - 1.0) * slow / np.maximum(slow + square_of_way(pixel), 1e-12)


def coding_errors(pixel: Array, fitted: Array, leverage: Array, step: Array) -> Array:
    """Standard deviations (T, D, 2) that the coding of the pictures leads one to expect [px]; 0 where nothing is known.

    An encoder passes over changes below its step: a dot that moves a little stays where it was, and the picture it
    leaves is clean, so that the fit does not show it. It lags along its way, and less along an axis the less of its way
    lies along that. Arguments as for `places_and_errors`, steps known everywhere and with the harm of haste.
    """
    rounded = np.nan_to_num(leverage * step[..., None])
    still = np.where(rounded > 0.0, STILL * np.nan_to_num(fitted), 0.0)
    count = np.maximum(np.isfinite(pixel).sum(axis=0), 1)
    mean = np.nansum(pixel, axis=0) / count
    spread = np.nansum((pixel - mean) ** 2, axis=0) / count
    lagging = np.maximum(LAGGING * rounded**POWER, still)
    hidden = (still**2).sum(axis=0) / count
    moves = spread > 4.0 * hidden
    moves |= (spread > (lagging**2).sum(axis=0) / count).mean(axis=0) > FEW
    # A marker that hardly seems to move goes the way that the body goes.
    body, unsure = spread.sum(axis=0), UNDIRECTED * hidden.sum(axis=1, keepdims=True) + 1e-12
    along = (spread + unsure * body / max(body.sum(), 1e-12)) / (spread.sum(axis=1, keepdims=True) + unsure)
    lags = np.where(moves.any(axis=1, keepdims=True), along, 0.0)
    return np.sqrt(still**2 + lags * (lagging**2 - still**2))


def step_over_noise(fitted: Array, leverage: Array, step: Array) -> float:
    """The steps over the noise that the first picture shows, the finest coded; 0 where nothing is known.

    Noise keeps an encoder from passing over the same change everywhere. Arguments as for `places_and_errors`.
    """
    told, noise = np.isfinite(step), fitted / leverage
    shows = np.flatnonzero(np.isfinite(noise).any(axis=(1, 2)))
    if not told.any() or not len(shows):
        return 0.0
    return float(np.sqrt(np.mean(step[told] ** 2)) / np.nanmedian(noise[shows[0]]))


@dataclass(frozen=True)
class Others:
    """Where the modes in which the other markers move put each marker, itself left out.

    Attributes:
        frames: in which all of these markers are seen, (F).
        markers: seen in most frames, (M).
        away: of the measured places from there [px], (F, M, 2).
        leverage: share of a place in its own prediction, left out of `away`, (F, M).
        carried: variance of the predictions by the others' errors, beside that of a place, (M, 2).
    """

    frames: NDArray[np.int64]
    markers: NDArray[np.int64]
    away: Array
    leverage: Array
    carried: Array

    @classmethod
    def of(cls, pixel: Array, sigma: Array) -> "Others | None":
        """Of paths and their standard deviations [px], (T, D, 2); None where too few tell the motion."""
        seen = np.isfinite(sigma[..., 0])
        markers = np.flatnonzero(seen.mean(axis=0) > 0.8)
        frames = np.flatnonzero(seen[:, markers].all(axis=1)) if len(markers) else np.zeros(0, int)
        if len(frames) < FEW_FRAMES or len(markers) < FEW_MARKERS:
            return None
        where = _where(frames, markers, pixel)
        path = pixel[where]
        path = (path - path.mean(axis=0)).reshape(len(frames), -1)
        product = path.T @ path
        noise = (sigma[where] ** 2).mean(axis=0).mean(axis=1)
        most = min(MODES, len(frames) // 4, len(markers) // 2)
        square, modes = np.linalg.eigh(product)  # ascending
        if (len(frames) < FEWEST_FRAMES or len(markers) < FEWEST_MARKERS) and _count_modes(square, len(frames)) > most:
            return None
        square, modes = square[-most - SPARE :], modes[:, -most - SPARE :]
        squares, mixes = _without_one(square, modes, product)
        amounts = path @ modes
        # Up to this size independent errors make modes of their own.
        by_chance = (noise.sum() - noise) / (len(noise) - 1) * (np.sqrt(len(frames)) + np.sqrt(len(product) - 2)) ** 2
        away = np.empty((len(frames), len(markers), 2))
        leverage, carried = np.empty(away.shape[:2]), np.empty((len(markers), 2))
        for k in range(len(markers)):
            own = slice(2 * k, 2 * k + 2)
            count = max(min(most, int((squares[k] > by_chance[k]).sum())), 1)
            size = np.sqrt(np.maximum(squares[k, -count:], 1e-12 * max(squares[k, -1], 1e-12)))
            mix = mixes[k][:, -count:] / size
            amount = amounts @ mix - path[:, own] @ (modes[own] @ mix)
            gain = amount.T @ path[:, own]
            leverage[:, k] = np.minimum((amount**2).sum(axis=1) + 1.0 / len(frames), 1.0 - 1e-9)
            away[:, k] = (path[:, own] - amount @ gain) / (1.0 - leverage[:, k, None])
            carried[k] = (gain**2 / size[:, None] ** 2).sum(axis=0)
        return cls(frames, markers, away, leverage, carried)

    @property
    def are_many(self) -> bool:
        """Whether places may be mended by them."""
        return len(self.frames) >= FEWEST_FRAMES and len(self.markers) >= FEWEST_MARKERS

    @property
    def missed(self) -> Array:
        """Mean square of what the others' motion leaves of each path, as if it had not been fitted [px^2], (M, 2)."""
        return (self.away**2 * (1.0 - self.leverage[..., None])).mean(axis=0)


def _where(frames: NDArray[np.int64], markers: NDArray[np.int64], whole: Array) -> tuple[Any, ...]:
    """Index of these frames and markers of an array (T, D, ...), which copies nothing where they are all there are."""
    if (len(frames), len(markers)) == whole.shape[:2]:
        return slice(None), slice(None)
    return np.ix_(frames, markers)


def _count_modes(square: Array, frames: int) -> int:
    """How many modes of these squares (ascending, (2 M)) stand out, if half of them are noise.

    Squares of noise have Marchenko and Pastur's distribution, whose median is nearly 1 - 0.35 times the matrix's ratio.
    """
    long, short = max(frames - 1, len(square)), min(frames - 1, len(square))
    noise = float(np.median(square[-short:])) / (long - 0.35 * short)
    return int((square > 1.1 * noise * (np.sqrt(long) + np.sqrt(short)) ** 2).sum())


def _without_one(square: Array, modes: Array, product: Array) -> tuple[Array, Array]:
    """The modes of all paths but one marker's, for each of them: squares (M, K), ascending, and mixes (M, K, K).

    They are Rayleigh and Ritz's best within what the largest modes of all paths span, in which a mix of these says
    what one of them is. Solving for each marker anew takes a hundred times as long with 300 of them.

    Args:
        square: of the amounts of the largest modes, (K).
        modes: (2 M, K).
        product: of all paths, (2 M, 2 M).
    """
    own = modes.reshape(-1, 2, len(square))
    turned = own.transpose(0, 2, 1)
    cross = turned @ (own * square)
    mine = np.stack([product[k : k + 2, k : k + 2] for k in range(0, len(product), 2)])
    inner = np.diag(square) - cross - cross.transpose(0, 2, 1) + turned @ mine @ own
    left, axes = np.linalg.eigh(np.eye(len(square)) - turned @ own)
    axes = axes / np.sqrt(np.where(left > VANISHED, left, np.inf))[:, None]
    squares, mixes = np.linalg.eigh(axes.transpose(0, 2, 1) @ inner @ axes)
    return squares, axes @ mixes


def with_shared_errors(sigma: Array, others: Others) -> Array:
    """Standard deviations (T, D, 2) that also hold what a marker's path has beyond the errors `sigma` so far [px].

    A few places that are far off tell of themselves only.
    """
    where = _where(others.frames, others.markers, sigma)
    own = (sigma[where] ** 2).mean(axis=0)
    square = others.away**2 * (1.0 - others.leverage[..., None])
    near = np.minimum(square, OUTLYING**2 * np.median(square, axis=0))
    beyond = near.mean(axis=0) / (1.0 + others.carried) - own
    excess = np.where(beyond > TELLING * own, beyond, 0.0)
    added = np.zeros((sigma.shape[1], 2))
    added[:] = np.median(excess, axis=0)
    added[others.markers] = excess
    whole = np.sqrt(sigma**2 + added)
    whole[where] = np.maximum(whole[where], np.sqrt(square) / SURPRISING)
    return whole


def mendable(pixel: Array, fitted: Array, coding: Array, others: Others, coarse: Array) -> tuple[Array, Array]:
    """What of the places is coding's error, by the others' motion, and standard deviations without it [px], (T, D, 2).

    The best mean of two places of known variances, the measured one and the others'. Zero and NaN where nothing is
    known of the coding. What all markers have in common cannot be seen, and stays.

    Args:
        pixel: paths as fitted [px], (T, D, 2).
        fitted: standard deviations from the fits [px], (T, D, 2).
        coding: those by coding [px], (T, D, 2).
        others: motion of these paths.
        coarse: as `step_over_noise` has it, times the harm of haste, (T, D).
    """
    where = _where(others.frames, others.markers, pixel)
    square, shown = coding[where] ** 2, fitted[where] ** 2
    usual = np.maximum(square.mean(axis=0), 1e-12).sum(axis=1, keepdims=True)
    way = square_of_way(pixel)[where][..., None]
    waiting = usual / (usual + np.maximum(way - usual, 0.0) / SLOW**2)  # 1 where a marker keeps still, 0 where it flies
    calm = STILL * np.sqrt(shown / np.maximum(square, 1e-12))
    alone = 1.0 / (1.0 + SHARED * coarse[where][..., None] * calm * np.exp(WAITING * waiting))
    # What the others do not tell of the body's motion, and what their errors make of their prediction.
    carried = others.carried + (others.leverage / (1.0 - others.leverage))[..., None]

    # Variances of a marker's own errors, of those it shares, and of the others' prediction.
    hidden = np.maximum(square - shown, 0.0)
    own, shared = np.where(square > 0.0, shown + alone * hidden, 0.0), (1.0 - alone) * hidden
    least = carried * (shown + hidden).mean(axis=0)
    beyond = np.maximum(others.missed - own.mean(axis=0), 0.0)
    part = own / np.maximum(own + np.maximum(beyond, least), (others.away / SURPRISING) ** 2)
    # Where the others leave less of all paths together than these errors would be, the errors are smaller; but for
    # markers that keep still, whose errors keep still with them and are not seen.
    left = (others.missed / (1.0 + others.carried)).mean(axis=0)
    smaller = np.minimum(left / np.maximum(own.mean(axis=0).mean(axis=0), 1e-12), 1.0)
    smaller = waiting + (1.0 - waiting) * smaller
    # What a path has beyond them may be its own motion, where it was drawn away from it, or error, where it was not.
    kept = (1.0 - part) ** 2 * (smaller * own + beyond)
    rest = smaller * shared + kept + part**2 * np.maximum(beyond, smaller * least)
    # A place that stays farther from where the others put it may be error as well.
    rest = np.maximum(rest, ((1.0 - part) * others.away / SURPRISING) ** 2)
    off, mended = np.zeros(pixel.shape), np.full(pixel.shape, np.nan)
    off[where], mended[where] = part * others.away, np.where(square > 0.0, np.sqrt(rest), np.nan)
    return off, mended
