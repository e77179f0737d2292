"""Tracking benchmark: accuracy of detected dots, compared with the Cramer-Rao bound and other detectors."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trackpy
from footage import Measurement, write_video
from scipy.optimize import linear_sum_assignment
from synthetic import Scene, draw, expose

from rafl.tracking.detection.appearance import find_markers
from rafl.tracking.detection.detect import Dots
from rafl.tracking.linking.follow import follow
from rafl.tracking.video.reader import open_video

MAX_MATCH_DISTANCE = 3.0  # between a detection and its dot [px]
MIN_COUNTED_ERROR = 0.25  # smallest error that counts as too large for its sigma [px]
TOO_LARGE = f"errors > {MIN_COUNTED_ERROR} px and > 4 sigma"


@dataclass(frozen=True)
class Case:
    """One kind of image.

    Attributes:
        name: in the results.
        scene: appearance of the dots and their surroundings.
        radius: of the dots [px].
        exposure: fraction of the time between two frames.
        axis_ratio: short over long semi-axis of the dots.
        hard: whether the image has disturbances; the target is then a looser one, for the median error.
        codec: `h264` for a compressed video; empty for single images.
    """

    name: str
    scene: Scene
    radius: float
    exposure: float = 0.2
    axis_ratio: float = 1.0
    hard: bool = False
    codec: str = ""


def cases() -> Iterator[Case]:
    for radius in (6.0, 8.0, 12.0):
        for noise in (2.0, 4.0, 8.0):
            yield Case(f"radius {radius:.0f} px, noise {noise:.0f}", Scene(noise=noise, light_falloff=0.25), radius)
    plain = Scene(noise=4.0, light_falloff=0.25)
    yield Case("60 % exposure", plain, 8.0, exposure=0.6, hard=True)
    yield Case("defocus 2.5 px", replace(plain, blur=2.5), 8.0, hard=True)
    yield Case("ellipses, axis ratio 0.7", plain, 8.0, axis_ratio=0.7, hard=True)
    yield Case("specular highlights", replace(plain, highlight_fraction=0.5), 8.0, hard=True)
    yield Case("highlights on grey skin", replace(plain, skin=100.0, highlight_fraction=0.5), 8.0, hard=True)
    box = (90.0, 80.0, 1190.0, 640.0)
    yield Case("edge of the beam", replace(plain, skin_box=box), 8.0, hard=True)
    yield Case("cluttered background", replace(plain, skin_box=box, clutter=30.0), 8.0, hard=True)
    yield Case("H.264 crf 23", replace(plain, noise=3.0), 8.0, hard=True, codec="h264")


def random_dots(case: Case, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Ellipses (D, 5) in irregular rows, and their motions during the exposure (D, 2), from up to 12 px a frame."""
    spacing = 6.0 * case.radius
    x, y = np.meshgrid(np.arange(130, 1150, spacing), np.arange(120, 600, spacing))
    if case.name == "edge of the beam":  # the edge crosses the surroundings of the dots in the outermost rows
        y[0], y[-1] = 80.0 + 1.35 * case.radius, 640.0 - 1.35 * case.radius
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    jitter = random.uniform(-3, 3, centres.shape)
    if case.name == "edge of the beam":
        jitter = random.uniform(-0.5, 0.5, centres.shape)
    centres += jitter
    angle = random.uniform(0, np.pi, len(centres))
    long_axis = np.full(len(centres), case.radius)
    short_axis = np.full(len(centres), case.axis_ratio * case.radius)
    ellipses = np.column_stack([centres, long_axis, short_axis, angle])
    direction = random.uniform(0, 2 * np.pi, len(centres))
    speed = random.uniform(0, 12.0, len(centres))
    motion = case.exposure * speed[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    return ellipses, motion


def cramer_rao_bound(case: Case, ellipse: np.ndarray, motion: np.ndarray, light: float) -> np.ndarray:
    """The Cramer-Rao bound of a dot's position if all else is known, along x and y [px]."""
    side = int(2 * (case.radius + 8) + np.abs(motion).max())
    scene = replace(
        case.scene, size=(side, side), light_falloff=0.0, skin_box=None, highlight_fraction=0.0, supersampling=4
    )
    centred = np.array([0.5 * side, 0.5 * side, *ellipse[2:]])
    h = 0.05
    result = np.empty(2)
    for axis in range(2):
        shifted = [centred.copy(), centred.copy()]
        for sign, item in zip((1, -1), shifted, strict=True):
            item[axis] += sign * h
        plus, minus = (draw(scene, item[None], np.random.default_rng(0), motion[None]) for item in shifted)
        slope = light * (plus - minus) / (2 * h)
        result[axis] = np.sqrt(case.scene.noise**2 + 1.0 / 12.0) / np.sqrt((slope**2).sum())
    return result


def match_positions(found: np.ndarray, truth: np.ndarray, max_distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the matched pairs in `found` (F, 2) and `truth` (D, 2)."""
    if not len(found):
        return np.zeros(0, int), np.zeros(0, int)
    distance = np.linalg.norm(found[:, None] - truth[None], axis=2)
    row, column = linear_sum_assignment(np.minimum(distance, max_distance))
    good = distance[row, column] < max_distance
    return row[good], column[good]


def position_errors(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors of the matched positions [px], (P, 2)."""
    row, column = match_positions(found, truth, MAX_MATCH_DISTANCE)
    return found[row] - truth[column]


def detect_with_trackpy(image: np.ndarray, radius: float) -> np.ndarray:
    diameter = int(2 * radius) | 1
    return trackpy.locate(image, diameter + 4, invert=True, minmass=20 * radius**2)[["x", "y"]].to_numpy()


def detect_with_opencv(image: np.ndarray, radius: float) -> np.ndarray:
    settings = cv2.SimpleBlobDetector_Params()
    settings.minArea, settings.maxArea = float(radius**2), float(8 * radius**2)
    settings.filterByColor, settings.blobColor = True, 0
    found = cv2.SimpleBlobDetector_create(settings).detect(image)
    return np.array([point.pt for point in found]).reshape(-1, 2)


def root_mean_square(errors: list[np.ndarray]) -> float:
    return float(np.sqrt((np.concatenate(errors) ** 2).mean()))


def measure_localisation(random: np.random.Generator, quick: bool) -> Iterator[Measurement]:
    for case in cases():
        if case.codec:
            yield from measure_compression(case, random, quick)
            continue
        errors, sigmas, bounds, trackpy_errors, opencv_errors = [], [], [], [], []
        false_detections = missed = 0
        images, truths = [], []
        for _ in range(1 if quick else 8):
            ellipses, motion = random_dots(case, random)
            clean = draw(case.scene, ellipses, random, motion)
            images.append(expose(clean, case.scene, random))
            truths.append((ellipses, motion))
        for image, (ellipses, motion) in zip(images, truths, strict=True):
            found = find_markers(image)
            dots = found[1] if found is not None else Dots.missing(0)
            centres = ellipses[:, :2]
            row, column = match_positions(dots.centre, centres, MAX_MATCH_DISTANCE)
            errors.append(dots.centre[row] - centres[column])
            sigmas.append(dots.sigma[row])
            false_detections += len(dots) - len(row)
            missed += len(ellipses) - len(row)
            (x, y), (width, height) = centres.T, case.scene.size
            light = 1.0 - case.scene.light_falloff * (0.6 * x / width + 0.4 * (y / height) ** 2)
            bounds.append(np.array([cramer_rao_bound(case, ellipses[k], motion[k], light[k]) for k in column]))
            trackpy_errors.append(position_errors(detect_with_trackpy(image, case.radius), centres))
            opencv_errors.append(position_errors(detect_with_opencv(image, case.radius), centres))
        error, sigma, bound = np.concatenate(errors), np.concatenate(sigmas), np.concatenate(bounds)
        rms = float(np.sqrt((error**2).mean()))
        yield Measurement("RMS error [px]", case.name, rms)
        yield Measurement("  trackpy", case.name, root_mean_square(trackpy_errors))
        yield Measurement("  OpenCV SimpleBlobDetector", case.name, root_mean_square(opencv_errors))
        if case.hard:
            ratio = float(np.median(np.linalg.norm(error, axis=1) / np.linalg.norm(bound, axis=1)))
            # The median length of a two-dimensional error is 1.177 standard deviations of a coordinate.
            yield Measurement("median error / Cramer-Rao bound", case.name, ratio * np.sqrt(2) / 1.1774, "<= 1.4")
        else:
            ratio = rms / float(np.sqrt((bound**2).mean()))
            yield Measurement("RMS error / Cramer-Rao bound", case.name, ratio, "<= 1.15")
        covered = 100 * float((np.abs(error) < sigma).mean())
        yield Measurement("errors within one sigma [%]", case.name, covered, "64 to 72")
        yield Measurement(TOO_LARGE, case.name, count_too_large(error, sigma), "0")
        yield Measurement("false detections", case.name, false_detections, "0")
        yield Measurement("missed dots", case.name, missed)


def count_too_large(error: np.ndarray, sigma: np.ndarray) -> int:
    return int(((np.abs(error) > MIN_COUNTED_ERROR) & (np.abs(error) > 4 * sigma)).sum())


def measure_compression(case: Case, random: np.random.Generator, quick: bool) -> Iterator[Measurement]:
    """Errors in compressed videos of 105 dots that oscillate in phase, by at most 1 or at most 27 px a frame.

    Each video is encoded with the preset `medium`, which the targets are meant for, and with `veryfast`. The errors of
    the dots in one video are correlated, so that the fraction within one sigma varies from video to video.
    """
    videos = 1 if quick else 4
    for preset in ("medium", "veryfast"):
        for speed, amplitude in (("slow", 2.2), ("fast", 60.0)):
            name = f"{case.name}, {preset}, {speed}"
            results = [track_compressed(case, preset, amplitude, 48 if quick else 120, random) for _ in range(videos)]
            error, sigma = (np.stack(values) for values in zip(*results, strict=True))
            rms, reported = (float(np.sqrt(np.nanmean(values**2))) for values in (error, sigma))
            yield Measurement("RMS error [px]", name, rms, "<= 0.07")
            yield Measurement("reported sigma / RMS error", name, reported / rms, "0.5 to 1.7")
            covered = 100 * (np.abs(error) < sigma).mean(axis=(1, 2, 3))
            yield Measurement("errors within one sigma [%]", name, float(covered.mean()), "60 to 80")
            yield Measurement("  smallest in a video", name, float(covered.min()))
            yield Measurement("  largest in a video", name, float(covered.max()))
            yield Measurement(TOO_LARGE, name, count_too_large(error, sigma), "0")


def track_compressed(
    case: Case, preset: str, amplitude: float, frames: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Errors and sigma of the dots in a compressed video [px], (T, D, 2) each."""
    ellipses, _ = random_dots(replace(case, radius=1.5 * case.radius), random)
    ellipses[:, 2:4] = case.radius
    amplitudes = amplitude * (ellipses[:, 0] / 1280.0) ** 2
    phase = random.uniform(0, 6) + 0.45 * np.arange(frames)
    truth = np.repeat(ellipses[None, :, :2], frames, axis=0)
    truth[..., 1] += 30.0 + amplitudes * np.sin(phase)[:, None]
    images = []
    for t in range(frames):
        motion = np.zeros((len(ellipses), 2))
        motion[:, 1] = case.exposure * amplitudes * 0.45 * np.cos(phase[t])
        moved = np.column_stack([truth[t], ellipses[:, 2:]])
        images.append(expose(draw(replace(case.scene, supersampling=4), moved, random, motion), case.scene, random))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        write_video(path, images, "h264", {"crf": "23", "preset": preset})
        tracks = follow(open_video(path), lambda: None)
    order = np.linalg.norm(truth[0][:, None] - tracks.start[None], axis=2).argmin(axis=1)
    return tracks.pixel[:, order] - truth, tracks.sigma[:, order]
