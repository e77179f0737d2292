"""Errors of marker positions that a single frame does not show, and their correction from the other markers' motion.

Compression shifts whole dots slightly, most where the image changes slowly. The fit of a dot does not show this error.
But all markers ride on one body: what a marker's path has that the other markers' paths do not predict is error.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Compression error. Along an axis in which the marker does not move, its sigma is STATIC_FACTOR times that
# of the fit, which assumes that the errors of neighbouring pixels are independent. Along the marker's path, where the
# encoder lets it lag, it is LAG_COEFFICIENT * e**LAG_EXPONENT [px]; e [px] is the error that independent errors of one
# quantisation step in each pixel would cause. Measured on 115 videos: libx264, crf 12 to 28, medium preset, noise of
# 1.5 to 5 grey levels, dots of 6 to 11 px, contrasts of 35 to 150. Faster presets give larger steps.
STATIC_FACTOR, LAG_COEFFICIENT, LAG_EXPONENT = 1.69, 0.346, 0.664
# Part of this error that all markers share, as a ratio of variances, shared to own:
# SHARED_RATIO * r * c * exp(TURNING_EXPONENT * w). r is the quantisation step over the noise of the first frame. c is
# the error along a static axis over the whole error. w is 1 for a marker that keeps still before and after the frame,
# and falls to 1/2 at a displacement of about SLOW_ERRORS such errors: where markers turn round, all wait until the
# encoder updates them. Measured on 260 videos of six presets of x264 at crf 14 to 30, otherwise as above, of bodies
# that swing, are released or move in three modes along any direction.
SHARED_RATIO, TURNING_EXPONENT, SLOW_ERRORS = 0.030, 3.0, 8.0
# If more than this share of the markers move by more than their errors, the others may move too, unseen by the encoder.
MIN_MOVING_SHARE = 0.05
# Weight of the body's direction of motion in a marker's [variances of the marker's error along a static axis].
BODY_DIRECTION_WEIGHT = 4.0
# Displacement per frame at which the extra error of a fast encoder preset is halved [lag errors]. Measured on 48 videos
# of x264's presets from superfast to fast.
FAST_ERRORS = 13.0
# A mode counts as the body's own motion if it exceeds what independent errors, this many times the compression error,
# would produce.
MODE_ERRORS = 2.0
MIN_UNCORRELATED_SHARE, MIN_NOISE_FRACTION = 0.6, 0.5  # see `noise_fraction`
# Fewest frames and markers to correct positions; and to estimate errors, if the motion has no more modes than allowed.
MIN_FRAMES_TO_CORRECT, MIN_MARKERS_TO_CORRECT = 40, 8
MIN_FRAMES, MIN_MARKERS = 12, 4
MAX_MODES = 12  # of the body's motion
SPARE_MODES = 8  # smaller modes kept too, because the modes without one marker may contain some of them
MIN_REMAINING_SHARE = 1e-6  # of a mode's square, outside one marker: if less remains, the mode is that marker's alone
MIN_EXCESS = 0.3  # of a fit's variance: a smaller excess may be chance
OUTLIER_MEDIANS = 6.0  # residuals are clipped where their square exceeds the square of this times the median square
MAX_SIGMAS = 3.0  # from the predicted position: a marker farther off moves on its own, or its position is wrong


def noise_fraction(uncorrelated_residual: Array, residual: Array) -> float:
    """The share of the fits' sigmas that is noise. The rest moves along with the dots.

    A dot that is no perfect disc leaves residuals that neighbouring pixels share. In compressed frames, the part of the
    residual that they do not share is 0.6 to 1 of the whole for discs, and 0.45 to 0.55 for hand-drawn dots almost
    without noise.

    Args:
        uncorrelated_residual: root mean square of the part that neighbouring pixels do not share, (D).
        residual: root mean square of the whole, (D).
    """
    share = np.divide(uncorrelated_residual, residual, out=np.ones_like(uncorrelated_residual), where=residual > 0.0)
    return float(np.clip(np.median(share) / MIN_UNCORRELATED_SHARE, MIN_NOISE_FRACTION, 1.0)) ** 2


def filtered_positions(
    pixel: Array, fit_sigma: Array, noise_gain: Array, step: Array, lag_factor: Array, noise: float
) -> tuple[Array, Array]:
    """The markers' positions and sigmas [px], (T, D, 2) each, after all frames have been seen.

    Positions change only if the quantisation steps are known. Each marker is then moved towards the position that the
    other markers' motion predicts. The weight follows from the compression error and the marker's own irregular motion.

    Args:
        pixel: paths as fitted [px], (T, D, 2), NaN where not seen.
        fit_sigma: from the fits [px], (T, D, 2).
        noise_gain: sigma of a fitted centre for independent noise of one grey level in each pixel
            [px / grey level], (T, D, 2), NaN where not known.
        step: quantisation step at the marker [grey levels], (T, D). NaN where not known: as in other frames.
        lag_factor: by which the encoder preset makes slow motion coarser than the step says, in each frame, (T).
        noise: share of `fit_sigma` that is noise, see `noise_fraction`.
    """
    known_step = fill_unknown_steps(step)
    preset_factor = preset_factors(pixel, noise_gain, known_step, lag_factor)
    noise_sigma = fit_sigma * noise if np.isfinite(step).any() else fit_sigma
    compression = compression_errors(pixel, noise_sigma, noise_gain, preset_factor * known_step)
    sigma = np.maximum(fit_sigma, compression)
    prediction = LowRankPrediction.of(pixel, np.maximum(noise_sigma, MODE_ERRORS * compression))
    if prediction is None:
        return pixel, sigma
    if not prediction.can_correct:
        return pixel, add_unmodelled_error(sigma, prediction)
    coarseness = step_to_noise_ratio(noise_sigma, noise_gain, step) * preset_factor
    correction, corrected_sigma = compression_correction(pixel, noise_sigma, compression, prediction, coarseness)
    if np.isnan(corrected_sigma).any():
        uncorrected = np.isnan(corrected_sigma)
        corrected_sigma = np.where(uncorrected, add_unmodelled_error(sigma, prediction), corrected_sigma)
    return pixel - correction, corrected_sigma


def fill_unknown_steps(step: Array) -> Array:
    """Quantisation steps (T, D); an unknown one is the marker's root mean square, or that of all markers."""
    known = np.isfinite(step)
    square = np.nansum(step**2, axis=0) / np.maximum(known.sum(axis=0), 1)
    usual = np.where(known.any(axis=0), square, np.nansum(step**2) / max(known.sum(), 1)) ** 0.5
    return np.where(known, step, usual)


def squared_displacement(pixel: Array) -> Array:
    """Squared displacement from the last or to the next frame, the larger [px^2], (T, D); 0 where neither is known."""
    x, y = np.moveaxis(np.diff(pixel, axis=0), 2, 0)
    square = np.pad(x**2 + y**2, ((1, 1), (0, 0)), constant_values=np.nan)
    largest: Array = np.nan_to_num(np.fmax(square[:-1], square[1:]))
    return largest


def preset_factors(pixel: Array, noise_gain: Array, step: Array, lag_factor: Array) -> Array:
    """Factor on the quantisation step that accounts for the encoder preset, in each frame and at each marker, (T, D).

    A fast preset lets slow motion lag, most in frames predicted from those before and after (B frames). Fast motion
    does not lag. Arguments as in `filtered_positions`, with all steps known.
    """
    if (lag_factor == 1.0).all():
        return np.ones(step.shape)
    noise_error = np.nan_to_num(noise_gain) * (lag_factor[:, None] * step)[..., None]
    slow = FAST_ERRORS**2 * ((LAG_COEFFICIENT * noise_error**LAG_EXPONENT) ** 2).mean(axis=2)
    factors: Array = 1.0 + (lag_factor[:, None] - 1.0) * slow / np.maximum(slow + squared_displacement(pixel), 1e-12)
    return factors


def compression_errors(pixel: Array, noise_sigma: Array, noise_gain: Array, step: Array) -> Array:
    """Expected sigmas of the compression error [px], (T, D, 2); 0 where nothing is known.

    An encoder skips changes smaller than its quantisation step. A dot that moves a little then stays where it was,
    with a clean image, so that the fit does not show the error. The dot lags along its path, and along each axis in
    proportion to the share of its motion.

    Args:
        pixel: as in `filtered_positions`.
        noise_sigma: part of the fits' sigmas that is noise [px], (T, D, 2).
        noise_gain: as in `filtered_positions`.
        step: quantisation steps times `preset_factors`, all known [grey levels], (T, D).
    """
    noise_error = np.nan_to_num(noise_gain * step[..., None])
    static = np.where(noise_error > 0.0, STATIC_FACTOR * np.nan_to_num(noise_sigma), 0.0)
    count = np.maximum(np.isfinite(pixel).sum(axis=0), 1)
    mean = np.nansum(pixel, axis=0) / count
    spread = np.nansum((pixel - mean) ** 2, axis=0) / count
    lag = np.maximum(LAG_COEFFICIENT * noise_error**LAG_EXPONENT, static)
    static_variance = (static**2).sum(axis=0) / count
    moves = spread > 4.0 * static_variance
    moves |= (spread > (lag**2).sum(axis=0) / count).mean(axis=0) > MIN_MOVING_SHARE
    # The direction of a marker that hardly moves is taken from the body.
    body, weight = spread.sum(axis=0), BODY_DIRECTION_WEIGHT * static_variance.sum(axis=1, keepdims=True) + 1e-12
    share = (spread + weight * body / max(body.sum(), 1e-12)) / (spread.sum(axis=1, keepdims=True) + weight)
    lag_share = np.where(moves.any(axis=1, keepdims=True), share, 0.0)
    errors: Array = np.sqrt(static**2 + lag_share * (lag**2 - static**2))
    return errors


def step_to_noise_ratio(noise_sigma: Array, noise_gain: Array, step: Array) -> float:
    """Ratio of the quantisation steps to the noise in the first, most finely coded, frame; 0 if nothing is known.

    Noise keeps an encoder from skipping the same change everywhere. Arguments as in `filtered_positions` and
    `compression_errors`; unknown steps are NaN.
    """
    known, noise = np.isfinite(step), noise_sigma / noise_gain
    frames = np.flatnonzero(np.isfinite(noise).any(axis=(1, 2)))
    if not known.any() or not len(frames):
        return 0.0
    return float(np.sqrt(np.mean(step[known] ** 2)) / np.nanmedian(noise[frames[0]]))


@dataclass(frozen=True)
class LowRankPrediction:
    """Prediction of each marker's path from the few modes in which the other markers move.

    Attributes:
        frames: in which all of these markers are seen, (F).
        markers: seen in most frames, (M).
        residual: measured minus predicted positions [px], (F, M, 2).
        leverage: weight of a position in its own fitted value (diagonal of the regression's hat matrix), (F, M). The
            `residual` is that of a fit without the position itself.
        prediction_variance: of the predictions, caused by the other markers' errors [variances of a position], (M, 2).
    """

    frames: NDArray[np.int64]
    markers: NDArray[np.int64]
    residual: Array
    leverage: Array
    prediction_variance: Array

    @classmethod
    def of(cls, pixel: Array, sigma: Array) -> "LowRankPrediction | None":
        """From paths and their sigmas [px], (T, D, 2); None if there are too few frames or markers."""
        seen = np.isfinite(sigma[..., 0])
        markers = np.flatnonzero(seen.mean(axis=0) > 0.8)
        frames = np.flatnonzero(seen[:, markers].all(axis=1)) if len(markers) else np.zeros(0, int)
        if len(frames) < MIN_FRAMES or len(markers) < MIN_MARKERS:
            return None
        index = _index(frames, markers, pixel)
        path = pixel[index]
        path = (path - path.mean(axis=0)).reshape(len(frames), -1)
        product = path.T @ path
        noise = (sigma[index] ** 2).mean(axis=0).mean(axis=1)
        most = min(MAX_MODES, len(frames) // 4, len(markers) // 2)
        square, modes = np.linalg.eigh(product)  # ascending
        few = len(frames) < MIN_FRAMES_TO_CORRECT or len(markers) < MIN_MARKERS_TO_CORRECT
        if few and _count_modes(square, len(frames)) > most:
            return None
        square, modes = square[-most - SPARE_MODES :], modes[:, -most - SPARE_MODES :]
        squares, mixes = _leave_one_out_modes(square, modes, product)
        amplitudes = path @ modes
        # Largest square of a mode of independent errors (Marchenko and Pastur).
        largest_noise = (np.sqrt(len(frames)) + np.sqrt(len(product) - 2)) ** 2
        threshold = (noise.sum() - noise) / (len(noise) - 1) * largest_noise
        residual = np.empty((len(frames), len(markers), 2))
        leverage, prediction_variance = np.empty(residual.shape[:2]), np.empty((len(markers), 2))
        for k in range(len(markers)):
            own = slice(2 * k, 2 * k + 2)
            count = max(min(most, int((squares[k] > threshold[k]).sum())), 1)
            size = np.sqrt(np.maximum(squares[k, -count:], 1e-12 * max(squares[k, -1], 1e-12)))
            mix = mixes[k][:, -count:] / size
            amplitude = amplitudes @ mix - path[:, own] @ (modes[own] @ mix)
            gain = amplitude.T @ path[:, own]
            leverage[:, k] = np.minimum((amplitude**2).sum(axis=1) + 1.0 / len(frames), 1.0 - 1e-9)
            residual[:, k] = (path[:, own] - amplitude @ gain) / (1.0 - leverage[:, k, None])
            prediction_variance[k] = (gain**2 / size[:, None] ** 2).sum(axis=0)
        return cls(frames, markers, residual, leverage, prediction_variance)

    @property
    def can_correct(self) -> bool:
        """Whether there are enough frames and markers to correct positions."""
        return len(self.frames) >= MIN_FRAMES_TO_CORRECT and len(self.markers) >= MIN_MARKERS_TO_CORRECT

    @property
    def mean_square(self) -> Array:
        """Mean square of the residuals, without the effect of the fit itself [px^2], (M, 2)."""
        mean_square: Array = (self.residual**2 * (1.0 - self.leverage[..., None])).mean(axis=0)
        return mean_square


def _index(frames: NDArray[np.int64], markers: NDArray[np.int64], whole: Array) -> tuple[Any, ...]:
    """Index of these frames and markers in an array (T, D, ...). It makes no copy if they are all there are."""
    if (len(frames), len(markers)) == whole.shape[:2]:
        return slice(None), slice(None)
    return np.ix_(frames, markers)


def _count_modes(square: Array, frames: int) -> int:
    """Number of modes above the noise, from their squares (ascending, (2 M)), if at least half of them are noise.

    The squares of noise follow the distribution of Marchenko and Pastur. Its median is about 1 - 0.35 times the
    matrix's aspect ratio.
    """
    long, short = max(frames - 1, len(square)), min(frames - 1, len(square))
    noise = float(np.median(square[-short:])) / (long - 0.35 * short)
    return int((square > 1.1 * noise * (np.sqrt(long) + np.sqrt(short)) ** 2).sum())


def _leave_one_out_modes(square: Array, modes: Array, product: Array) -> tuple[Array, Array]:
    """For each marker, the modes of all the other markers' paths.

    They are the Rayleigh-Ritz approximation within the span of the largest modes of all paths. Solving anew for each
    marker takes a hundred times as long with 300 markers.

    Args:
        square: sum of squares of the amplitudes of the largest modes of all paths, (K).
        modes: these modes, (2 M, K).
        product: paths' matrix of inner products, (2 M, 2 M).

    Returns:
        The modes' squares (M, K), ascending, and their coefficients (M, K, K) in terms of `modes`.
    """
    own = modes.reshape(-1, 2, len(square))
    transposed = own.transpose(0, 2, 1)
    cross = transposed @ (own * square)
    own_product = np.stack([product[k : k + 2, k : k + 2] for k in range(0, len(product), 2)])
    inner = np.diag(square) - cross - cross.transpose(0, 2, 1) + transposed @ own_product @ own
    remaining, axes = np.linalg.eigh(np.eye(len(square)) - transposed @ own)
    axes = axes / np.sqrt(np.where(remaining > MIN_REMAINING_SHARE, remaining, np.inf))[:, None]
    squares, mixes = np.linalg.eigh(axes.transpose(0, 2, 1) @ inner @ axes)
    return squares, axes @ mixes


def add_unmodelled_error(sigma: Array, prediction: LowRankPrediction) -> Array:
    """Sigmas [px], (T, D, 2), that include the part of the prediction's residuals that `sigma` lacks.

    A few positions with large residuals change only their own sigmas.
    """
    index = _index(prediction.frames, prediction.markers, sigma)
    own = (sigma[index] ** 2).mean(axis=0)
    square = prediction.residual**2 * (1.0 - prediction.leverage[..., None])
    clipped = np.minimum(square, OUTLIER_MEDIANS**2 * np.median(square, axis=0))
    beyond = clipped.mean(axis=0) / (1.0 + prediction.prediction_variance) - own
    excess = np.where(beyond > MIN_EXCESS * own, beyond, 0.0)
    added = np.zeros((sigma.shape[1], 2))
    added[:] = np.median(excess, axis=0)
    added[prediction.markers] = excess
    total: Array = np.sqrt(sigma**2 + added)
    total[index] = np.maximum(total[index], np.sqrt(square) / MAX_SIGMAS)
    return total


def compression_correction(
    pixel: Array, noise_sigma: Array, compression: Array, prediction: LowRankPrediction, coarseness: Array
) -> tuple[Array, Array]:
    """The part of the positions that is compression error, and sigmas without it [px], (T, D, 2) each.

    The corrected position is the weighted mean of the measured and the predicted one, by their variances. The error
    that all markers share cannot be seen, and stays. Where nothing is known of the compression, the correction is zero
    and the sigma NaN.

    Args:
        pixel: paths as fitted [px], (T, D, 2).
        noise_sigma: part of the fits' sigmas that is noise [px], (T, D, 2).
        compression: sigmas of the compression error [px], (T, D, 2).
        prediction: of these paths.
        coarseness: `step_to_noise_ratio` times `preset_factors`, (T, D).
    """
    index = _index(prediction.frames, prediction.markers, pixel)
    square, noise = compression[index] ** 2, noise_sigma[index] ** 2
    usual = np.maximum(square.mean(axis=0), 1e-12).sum(axis=1, keepdims=True)
    displacement = squared_displacement(pixel)[index][..., None]
    stillness = usual / (usual + np.maximum(displacement - usual, 0.0) / SLOW_ERRORS**2)  # 1 still, 0 fast
    static_share = STATIC_FACTOR * np.sqrt(noise / np.maximum(square, 1e-12))
    shared_ratio = SHARED_RATIO * coarseness[index][..., None] * static_share * np.exp(TURNING_EXPONENT * stillness)
    own_share = 1.0 / (1.0 + shared_ratio)
    leverage = prediction.leverage
    prediction_variance = prediction.prediction_variance + (leverage / (1.0 - leverage))[..., None]

    # Variances: of a marker's own errors, of those that all share, and the least of the prediction.
    unseen = np.maximum(square - noise, 0.0)
    own, shared = np.where(square > 0.0, noise + own_share * unseen, 0.0), (1.0 - own_share) * unseen
    least = prediction_variance * (noise + unseen).mean(axis=0)
    beyond = np.maximum(prediction.mean_square - own.mean(axis=0), 0.0)  # of the marker's own motion
    weight = own / np.maximum(own + np.maximum(beyond, least), (prediction.residual / MAX_SIGMAS) ** 2)
    # If the residuals of all paths together are smaller than the expected errors, the errors are smaller too. This does
    # not hold for markers that keep still: their errors are constant, and leave no residuals.
    left = (prediction.mean_square / (1.0 + prediction.prediction_variance)).mean(axis=0)
    reduction = np.minimum(left / np.maximum(own.mean(axis=0).mean(axis=0), 1e-12), 1.0)
    reduction = stillness + (1.0 - stillness) * reduction
    # The residual may be the marker's own motion, from which the correction moved it away, or error that remains.
    kept = (1.0 - weight) ** 2 * (reduction * own + beyond)
    variance = reduction * shared + kept + weight**2 * np.maximum(beyond, reduction * least)
    # A corrected position that is still far from the predicted one may be wrong as well.
    variance = np.maximum(variance, ((1.0 - weight) * prediction.residual / MAX_SIGMAS) ** 2)
    correction, corrected_sigma = np.zeros(pixel.shape), np.full(pixel.shape, np.nan)
    correction[index] = weight * prediction.residual
    corrected_sigma[index] = np.where(square > 0.0, np.sqrt(variance), np.nan)
    return correction, corrected_sigma
