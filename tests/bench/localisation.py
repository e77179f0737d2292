"""How near the dots' measured places are to the true ones, beside the Cramer-Rao bound and other detectors."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trackpy
from footage import Row, write_video
from rafl.tracking.detection.appearance import find_family
from rafl.tracking.detection.detect import Dots
from rafl.tracking.linking.follow import follow
from rafl.tracking.synthetic import Scene, draw, expose
from rafl.tracking.video.reader import open_video
from scipy.optimize import linear_sum_assignment


@dataclass(frozen=True)
class Case:
    """One kind of picture: the scene, and how its dots are."""

    name: str
    scene: Scene
    radius: float
    exposure: float = 0.2
    ratio: float = 1.0
    hard: bool = False
    codec: str = ""


def cases() -> Iterator[Case]:
    for radius in (6.0, 8.0, 12.0):
        for noise in (2.0, 4.0, 8.0):
            yield Case(f"R {radius:.0f}, noise {noise:.0f}", Scene(noise=noise, slope=0.25), radius)
    plain = Scene(noise=4.0, slope=0.25)
    yield Case("60 % exposure", plain, 8.0, exposure=0.6, hard=True)
    yield Case("defocus 2.5 px", replace(plain, blur=2.5), 8.0, hard=True)
    yield Case("ellipses 0.7", plain, 8.0, ratio=0.7, hard=True)
    yield Case("glare", replace(plain, glare=0.5), 8.0, hard=True)
    yield Case("glare on grey skin", replace(plain, skin=100.0, glare=0.5), 8.0, hard=True)
    box = (90.0, 80.0, 1190.0, 640.0)
    yield Case("beam's edge", replace(plain, skin_box=box), 8.0, hard=True)
    yield Case("clutter", replace(plain, skin_box=box, clutter=30.0), 8.0, hard=True)
    yield Case("H.264 crf 23", replace(plain, noise=3.0), 8.0, hard=True, codec="h264")


def scattered(case: Case, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Ellipses (D, 5) in loose rows, and their smears (D, 2) from up to 12 px a frame."""
    pitch = 6.0 * case.radius
    x, y = np.meshgrid(np.arange(130, 1150, pitch), np.arange(120, 600, pitch))
    if case.name == "beam's edge":  # the outermost rows so near the edge that it cuts the dots' surroundings
        y[0], y[-1] = 80.0 + 1.35 * case.radius, 640.0 - 1.35 * case.radius
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    jitter = random.uniform(-3, 3, centres.shape)
    if case.name == "beam's edge":
        jitter = random.uniform(-0.5, 0.5, centres.shape)
    centres += jitter
    angle = random.uniform(0, np.pi, len(centres))
    ellipses = np.column_stack(
        [centres, np.full(len(centres), case.radius), np.full(len(centres), case.ratio * case.radius), angle]
    )
    way = random.uniform(0, 2 * np.pi, len(centres))
    speed = random.uniform(0, 12.0, len(centres))
    smear = case.exposure * speed[:, None] * np.stack([np.cos(way), np.sin(way)], axis=1)
    return ellipses, smear


def bound(case: Case, ellipse: np.ndarray, smear: np.ndarray, light: float) -> np.ndarray:
    """The Cramer-Rao bound of one dot's place where all else is known, along x and y [px]."""
    side = int(2 * (case.radius + 8) + np.abs(smear).max())
    scene = replace(case.scene, size=(side, side), slope=0.0, skin_box=None, glare=0.0, fine=4)
    own = np.array([0.5 * side, 0.5 * side, *ellipse[2:]])
    h = 0.05
    result = np.empty(2)
    for axis in range(2):
        moved = [own.copy(), own.copy()]
        for sign, item in zip((1, -1), moved, strict=True):
            item[axis] += sign * h
        up, down = (draw(scene, item[None], np.random.default_rng(0), smear[None]) for item in moved)
        slope = light * (up - down) / (2 * h)
        result[axis] = np.sqrt(case.scene.noise**2 + 1.0 / 12.0) / np.sqrt((slope**2).sum())
    return result


def matched(found: np.ndarray, truth: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    if not len(found):
        return np.zeros(0, int), np.zeros(0, int)
    distance = np.linalg.norm(found[:, None] - truth[None], axis=2)
    row, column = linear_sum_assignment(np.minimum(distance, near))
    good = distance[row, column] < near
    return row[good], column[good]


def blob_detector(picture: np.ndarray, radius: float) -> np.ndarray:
    settings = cv2.SimpleBlobDetector_Params()
    settings.minArea, settings.maxArea = float(radius**2), float(8 * radius**2)
    settings.filterByColor, settings.blobColor = True, 0
    found = cv2.SimpleBlobDetector_create(settings).detect(picture)
    return np.array([point.pt for point in found]).reshape(-1, 2)


def localisation(random: np.random.Generator, quick: bool) -> Iterator[Row]:
    for case in cases():
        if case.codec:
            yield from compression(case, random, quick)
            continue
        errors, sigmas, bounds, theirs, blobs = [], [], [], [], []
        false = total = 0
        pictures, truths = [], []
        for _ in range(1 if quick else 8):
            ellipses, smear = scattered(case, random)
            clean = draw(case.scene, ellipses, random, smear)
            pictures.append(expose(clean, case.scene, random))
            truths.append((ellipses, smear))
        for picture, (ellipses, smear) in zip(pictures, truths, strict=True):
            found = find_family(picture)
            dots = found[1] if found is not None else Dots.none(0)
            row, column = matched(dots.centre, ellipses[:, :2], 3.0)
            errors.append(dots.centre[row] - ellipses[column, :2])
            sigmas.append(dots.sigma[row])
            false += len(dots) - len(row)
            total += len(ellipses) - len(row)
            skin = 1.0 - case.scene.slope * (
                0.6 * ellipses[:, 0] / case.scene.size[0] + 0.4 * (ellipses[:, 1] / case.scene.size[1]) ** 2
            )
            bounds.append(np.array([bound(case, ellipses[k], smear[k], skin[k]) for k in column]))
            diameter = int(2 * case.radius) | 1
            table = trackpy.locate(picture, diameter + 4, invert=True, minmass=20 * case.radius**2)
            other = table[["x", "y"]].to_numpy()
            a, b = matched(other, ellipses[:, :2], 3.0)
            theirs.append(other[a] - ellipses[b, :2])
            other = blob_detector(picture, case.radius)
            a, b = matched(other, ellipses[:, :2], 3.0)
            blobs.append(other[a] - ellipses[b, :2])
        error, sigma = np.concatenate(errors), np.concatenate(sigmas)
        rms = float(np.sqrt((error**2).mean()))
        yield Row("RMS error [px]", case.name, rms)
        yield Row("  trackpy", case.name, float(np.sqrt((np.concatenate(theirs) ** 2).mean())))
        yield Row("  SimpleBlobDetector", case.name, float(np.sqrt((np.concatenate(blobs) ** 2).mean())))
        if case.hard:
            lower = np.concatenate(bounds)
            share = np.linalg.norm(error, axis=1) / np.linalg.norm(lower, axis=1)
            # The median of a two-dimensional error's length is 1.177 standard deviations of a coordinate.
            yield Row("median error / bound", case.name, float(np.median(share)) * np.sqrt(2) / 1.1774, "<= 1.4")
        else:
            lower = np.concatenate(bounds)
            yield Row("RMS / Cramer-Rao", case.name, rms / float(np.sqrt((lower**2).mean())), "<= 1.15")
        yield Row("within one sigma [%]", case.name, 100 * float((np.abs(error) < sigma).mean()), "64 to 72")
        silent = (np.abs(error) > 0.25) & (np.abs(error) > 4 * sigma)
        yield Row("off by > 0.25 px in silence", case.name, int(silent.sum()), "0")
        yield Row("false markers", case.name, false, "0")
        yield Row("missed dots", case.name, total)


def compression(case: Case, random: np.random.Generator, quick: bool) -> Iterator[Row]:
    """Videos of 105 dots that swing together, up to 1 or up to 27 px a frame, compressed and followed.

    By an encoder that searches well, which is what is asked for, and by one that is in a hurry. All dots of a video
    share much of their errors, so one alone says little of how many are covered.
    """
    films = 1 if quick else 4
    for preset in ("medium", "veryfast"):
        for speed, swing in (("slow", 2.2), ("fast", 60.0)):
            name = f"{case.name}, {preset}, {speed}"
            filmed = [compressed(case, preset, swing, 48 if quick else 120, random) for _ in range(films)]
            error, sigma = (np.stack(values) for values in zip(*filmed, strict=True))
            rms, reported = (float(np.sqrt(np.nanmean(values**2))) for values in (error, sigma))
            yield Row("RMS error [px]", name, rms, "<= 0.055")
            yield Row("reported sigma / RMS error", name, reported / rms, "0.75 to 1.25")
            covered = 100 * (np.abs(error) < sigma).mean(axis=(1, 2, 3))
            yield Row("within one sigma [%]", name, float(covered.mean()), "64 to 72")
            yield Row("  least in a video", name, float(covered.min()))
            yield Row("  most in a video", name, float(covered.max()))
            silent = (np.abs(error) > 0.25) & (np.abs(error) > 4 * sigma)
            yield Row("off by > 0.25 px in silence", name, int(silent.sum()), "0")


def compressed(
    case: Case, preset: str, swing: float, frames: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Errors and sigma of the dots of a compressed video [px], (T, D, 2) each."""
    ellipses, _ = scattered(replace(case, radius=1.5 * case.radius), random)
    ellipses[:, 2:4] = case.radius
    amount = swing * (ellipses[:, 0] / 1280.0) ** 2
    phase = random.uniform(0, 6) + 0.45 * np.arange(frames)
    truth = np.repeat(ellipses[None, :, :2], frames, axis=0)
    truth[..., 1] += 30.0 + amount * np.sin(phase)[:, None]
    pictures = []
    for t in range(frames):
        smear = np.zeros((len(ellipses), 2))
        smear[:, 1] = case.exposure * amount * 0.45 * np.cos(phase[t])
        here = np.column_stack([truth[t], ellipses[:, 2:]])
        pictures.append(expose(draw(replace(case.scene, fine=4), here, random, smear), case.scene, random))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        write_video(path, pictures, "h264", {"crf": "23", "preset": preset})
        tracks = follow(open_video(path), lambda: None)
    order = np.linalg.norm(truth[0][:, None] - tracks.start[None], axis=2).argmin(axis=1)
    return tracks.pixel[:, order] - truth, tracks.sigma[:, order]
