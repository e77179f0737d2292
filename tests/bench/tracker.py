"""Tracking and calibration measured on footage made fresh, beside trackpy and OpenCV's blob detector.

    python tests/bench/tracker.py [--seed N] [--only localisation,linking,...] [--quick] [--out FILE.csv]

Every row says what is asked and what was found; places are known to 1e-4 px.
"""

import argparse
import csv
import logging
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import ezc3d
import numpy as np
import pandas as pd
import trackpy
from motions import Beam, random_beam
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from calibration.board import BoardFile, View, WorldPose
from calibration.camera import Camera, OrthographicCamera
from calibration.rig import Rig
from calibration.solve import solve_rig
from groundwork import InputError
from tracking.artificial import Scene, draw, expose
from tracking.dots import find_dots
from tracking.family import find_family
from tracking.fill import fill_gaps
from tracking.follow import follow
from tracking.pipeline import TrackingSettings, track_recording
from tracking.video import Frame, Reading, Video, open_video

warnings.filterwarnings("ignore")
logging.getLogger("trackpy").setLevel(logging.ERROR)
trackpy.quiet()


@dataclass(frozen=True)
class Row:
    """One measurement: of what, in which case, the value, and what was asked of it."""

    what: str
    case: str
    value: float
    asked: str = ""


# --- localisation -------------------------------------------------------------------------------------------


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


def write_video(path: Path, pictures: list[np.ndarray], codec: str, options: dict[str, str], repeat: int = 1) -> None:
    encoder, pixels = {"h264": ("libx264", "yuv420p"), "mjpeg": ("mjpeg", "yuvj420p"), "ffv1": ("ffv1", "gray")}[codec]
    with av.open(str(path), "w") as output:
        stream = output.add_stream(encoder, rate=100)
        stream.height, stream.width = pictures[0].shape
        stream.pix_fmt, stream.options = pixels, options
        levels = "MPEG" if pixels == "yuv420p" else "JPEG"
        for number in range(repeat * len(pictures)):
            # There and back again, so that nothing jumps.
            cycle = number % (2 * len(pictures) - 2) if len(pictures) > 1 else 0
            picture = pictures[cycle if cycle < len(pictures) else 2 * len(pictures) - 2 - cycle]
            frame = av.VideoFrame.from_ndarray(picture, format="gray")
            output.mux(stream.encode(frame.reformat(format=pixels, dst_color_range=levels)))
        output.mux(stream.encode())


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
        for _ in range(1 if quick else 3):
            ellipses, smear = scattered(case, random)
            clean = draw(case.scene, ellipses, random, smear)
            pictures.append(expose(clean, case.scene, random))
            truths.append((ellipses, smear))
        for picture, (ellipses, smear) in zip(pictures, truths, strict=True):
            found = find_family(picture)
            dots = found[1] if found is not None else find_dots(picture, True)
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
    """A video of 160 dots that swing together, up to 1 or up to 27 px a frame, compressed and followed."""
    for name, swing in ((f"{case.name}, slow", 2.2), (f"{case.name}, fast", 60.0)):
        ellipses, _ = scattered(replace(case, radius=1.5 * case.radius), random)
        ellipses[:, 2:4] = case.radius
        frames = 48 if quick else 120
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
            write_video(path, pictures, "h264", {"crf": "23"})
            tracks = follow(open_video(path), lambda: None)
        order = np.linalg.norm(truth[0][:, None] - tracks.start[None], axis=2).argmin(axis=1)
        error, sigma = tracks.pixel[:, order] - truth, tracks.sigma[:, order]
        rms, reported = (float(np.sqrt(np.nanmean(values**2))) for values in (error, sigma))
        yield Row("RMS error [px]", name, rms, "<= 0.055")
        yield Row("reported sigma / RMS error", name, reported / rms, "0.75 to 1.25")
        yield Row("within one sigma [%]", name, 100 * float((np.abs(error) < sigma).mean()), "64 to 72")
        silent = (np.abs(error) > 0.25) & (np.abs(error) > 4 * sigma)
        yield Row("off by > 0.25 px in silence", name, int(silent.sum()), "0")


# --- linking ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drawn:
    """Stands in for a video: a beam drawn frame by frame, some dots hidden."""

    beam: Beam
    noise: float
    seed: int
    hidden: np.ndarray | None = None
    path: Path = Path("drawn")

    def read(self) -> Reading:
        return Reading(self.frames())

    def frames(self) -> Iterator[Frame]:
        random = np.random.default_rng(self.seed)
        scene = Scene(size=self.beam.size, noise=self.noise, slope=0.2, fine=2)
        centres = self.beam.centres
        for t, now in enumerate(centres):
            velocity = 0.5 * (centres[min(t + 1, len(centres) - 1)] - centres[max(t - 1, 0)])
            shown = np.ones(len(now), bool) if self.hidden is None else ~self.hidden[t]
            round_ = np.full((len(now), 2), self.beam.radius)
            ellipses = np.column_stack([now, round_, np.zeros(len(now))])[shown]
            picture = expose(draw(scene, ellipses, random, 0.2 * velocity[shown]), scene, random)
            yield Frame(0.01 * t, picture)


@dataclass(frozen=True)
class Judged:
    """How a recording went: wrong places, visible dots not measured, dots not under their name at the end."""

    wrong: int
    lost: float
    late: int


def judge(drawn: Drawn) -> Judged:
    tracks = follow(drawn, lambda: None)  # type: ignore[arg-type]
    truth, spacing = drawn.beam.centres, drawn.beam.spacing
    hidden = np.zeros(truth.shape[:2], bool) if drawn.hidden is None else drawn.hidden
    order = np.linalg.norm(truth[0][:, None] - tracks.start[None], axis=2).argmin(axis=1)
    away = np.linalg.norm(tracks.pixel[:, order] - truth, axis=2)
    measured = np.isfinite(away)
    wrong = int((away[measured] > 0.4 * spacing).sum())
    lost = (~hidden & ~measured).sum() / (~hidden).sum()
    return Judged(wrong, float(lost), int((~hidden & ~measured)[-1].sum()))


def trackpys_switches(beam: Beam) -> int:
    """Places where trackpy's linker gives a dot's track to another, fed the true places."""
    frames, dots, _ = beam.centres.shape
    table = pd.DataFrame(beam.centres.reshape(-1, 2), columns=["x", "y"])
    table["frame"], table["dot"] = np.repeat(np.arange(frames), dots), np.tile(np.arange(dots), frames)
    try:
        linked = trackpy.link(table, search_range=0.9 * beam.spacing, memory=3)
    except trackpy.SubnetOversizeException:
        linked = trackpy.link(table, search_range=0.45 * beam.spacing, memory=3)
    linked = linked.sort_values(["dot", "frame"])
    return int((linked.groupby("dot").particle.nunique() - 1).sum())


def linking(random: np.random.Generator, quick: bool) -> Iterator[Row]:
    count = 40 if quick else 300
    results, switches = [], 0
    fastest = 0.0
    for k in range(count):
        beam = random_beam(random, 40, random.uniform(0.5, 1.5))
        fastest = max(fastest, beam.fastest)
        results.append(judge(Drawn(beam, random.uniform(2, 6), k)))
        switches += trackpys_switches(beam) if k < 60 else 0
    case = f"{count} recordings, up to {fastest:.2f} spacings a frame"
    yield Row("recordings with a wrong identity", case, sum(item.wrong > 0 for item in results), "0")
    yield Row("dots not measured [%]", case, 100 * float(np.mean([item.lost for item in results])))
    yield Row("  trackpy: identity changes", f"the first {min(count, 60)} of them", switches)


def hiding(random: np.random.Generator, quick: bool) -> Iterator[Row]:
    count = 10 if quick else 60
    for case, frames in (
        ("a third hidden 100 frames", 150),
        ("all hidden 10 frames", 50),
        ("leaving and entering", 120),
    ):
        results = []
        for k in range(count):
            beam = random_beam(random, frames, random.uniform(0.3, 1.0))
            dots = beam.centres.shape[1]
            hidden = np.zeros((frames, dots), bool)
            if case.startswith("a third"):
                side = beam.centres[0] @ random.normal(size=2)
                order = np.argsort(side) if k % 2 else random.permutation(dots)
                hidden[20:120, order[: dots // 3]] = True
            elif case.startswith("all"):
                hidden[20:30] = True
            else:
                across = beam.centres[:, :, 0]
                hidden = across > np.quantile(across, 0.7)
                hidden[0] = False
            results.append(judge(Drawn(beam, random.uniform(2, 6), k, hidden)))
        yield Row("recordings with a wrong identity", case, sum(item.wrong > 0 for item in results), "0")
        yield Row("dots not back at the end", case, sum(item.late for item in results), "0")


def filling(random: np.random.Generator, quick: bool) -> Iterator[Row]:
    worst, scores = [], []
    for _ in range(20 if quick else 100):
        beam = random_beam(random, 150, random.uniform(0.3, 1.0))
        place = np.concatenate([beam.centres, np.zeros((*beam.centres.shape[:2], 1))], axis=2)
        seen = place + random.normal(0, 0.015, place.shape)
        sigma = np.full(place.shape, 0.015)
        gone = np.zeros(place.shape[:2], bool)
        for _ in range(10):
            start, marker = random.integers(20, 140), random.integers(0, place.shape[1])
            gone[start : start + random.integers(1, 6), marker] = True
        seen[gone] = np.nan
        filled, grown, state = fill_gaps(seen, sigma, 0.01 * np.arange(150), 5)
        error = (filled - place)[state == 2][:, :2]
        worst.append(np.abs(error).max())
        scores.append((np.abs(error) < grown[state == 2][:, :2]).mean())
    yield Row("largest error of a filled place [px]", "gaps of 1 to 5 frames", float(np.max(worst)), "<= 0.15")
    yield Row("within one sigma [%]", "gaps of 1 to 5 frames", 100 * float(np.mean(scores)))


# --- speed --------------------------------------------------------------------------------------------------


def speed(random: np.random.Generator, quick: bool) -> Iterator[Row]:
    frames = 300 if quick else 900
    with tempfile.TemporaryDirectory() as folder:
        for size in ((1280, 720), (1920, 1080)):
            pictures = list(beam_pictures(size, random))
            for codec, options in (("h264", {"crf": "18"}), ("mjpeg", {"qmin": "3", "qmax": "3"})):
                path = Path(folder) / f"{size[1]}.{'mp4' if codec == 'h264' else 'avi'}"
                write_video(path, pictures, codec, options, repeat=frames // len(pictures))
                video = open_video(path)
                follow(video, lambda: None)  # compiles
                case = f"{size[1]}p {codec}, {frames} frames"
                times: dict[str, list[float]] = {"decode": [], "all cores": [], "track": []}
                for _ in range(3):
                    for kind, work in (("decode", decode_only), ("all cores", decode_threads), ("track", track_only)):
                        begun = time.perf_counter()
                        work(video)
                        times[kind].append(time.perf_counter() - begun)
                best = {kind: min(values) for kind, values in times.items()}
                rate = len(pictures) * (frames // len(pictures)) / best["track"]
                yield Row("tracking / decoding speed", case, best["decode"] / best["track"], ">= 0.85")
                yield Row("  against decoding with all cores", case, best["all cores"] / best["track"])
                yield Row("  frames/s", case, rate)


def beam_pictures(size: tuple[int, int], random: np.random.Generator) -> Iterator[np.ndarray]:
    """Half a swing of a beam with 32 dots, 28 px a frame at its fastest."""
    scene = Scene(size=size, noise=2.0, slope=0.15, fine=4)
    column, row = np.repeat(np.arange(8), 4), np.tile(np.arange(4), 8)
    x = 0.08 * size[0] + column * 0.115 * size[0]
    share = (x / size[0]) ** 2
    for t in range(60):
        angle = np.pi * t / 59
        y = 0.3 * size[1] + 45 * row + 220 * share * np.sin(angle - np.pi / 2)
        round_ = np.full((32, 2), 8.0)
        smear = np.stack([np.zeros(32), 0.2 * 220 * share * np.cos(angle - np.pi / 2) * np.pi / 59], axis=1)
        ellipses = np.column_stack([x, y, round_, np.zeros(32)])
        yield expose(draw(scene, ellipses, random, smear), scene, random)


def decode_only(video: Video) -> None:
    """PyAV's luma plane in one thread, which is what sees damage."""
    _decode(video, "NONE", 1)


def decode_threads(video: Video) -> None:
    """The same with as many threads as FFmpeg likes."""
    _decode(video, "AUTO", 0)


def _decode(video: Video, kind: str, threads: int) -> None:
    with av.open(str(video.path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = kind
        if threads:
            stream.codec_context.thread_count = threads
        for frame in container.decode(stream):
            np.frombuffer(frame.planes[0], np.uint8).reshape(frame.height, -1)[:, : frame.width].copy()


def track_only(video: Video) -> None:
    follow(video, lambda: None)


# --- calibration --------------------------------------------------------------------------------------------

SIZE = (1280, 720)
BOARD = 0.01 * np.stack(np.meshgrid(np.arange(10), np.arange(6)), axis=-1).reshape(-1, 2)
PLAIN = BoardFile.model_validate(
    {"format": "rafl-board/1", "pattern": {"kind": "dot-grid", "dots": [10, 6], "spacing_mm": 10}}
)
SQUARE = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def random_views(camera: Camera, name: str, poses: tuple[WorldPose, ...], random: np.random.Generator) -> list[View]:
    def view(pose: WorldPose, number: int, known: bool) -> View:
        world = pose.origin + BOARD @ pose.rotation[:, :2].T
        pixels = camera.project(world) + random.normal(0, 0.05, BOARD.shape)
        key = f"{name}/{number}"
        return View(key, key, BOARD, pixels, pose if known else None)

    views = [view(pose, number, True) for number, pose in enumerate(poses)]
    for number in range(12 - len(poses)):
        axis = random.normal(size=3)
        axis -= axis @ camera.viewing_direction * camera.viewing_direction
        axis /= np.linalg.norm(axis)
        turn = Rotation.from_rotvec(np.radians(random.uniform(10, 40)) * axis).as_matrix() @ poses[0].rotation
        pose = WorldPose.model_construct(
            origin_mm=(20.0, 0.0, 25.0), x_axis=tuple(turn[:, 0]), y_axis=tuple(turn[:, 1])
        )
        views.append(view(pose, number + 9, False))
    return views


def calibrating(random: np.random.Generator, quick: bool) -> Iterator[Row]:
    count = 60 if quick else 1000
    flat = WorldPose(origin_mm=(5.0, 0.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
    nearer = WorldPose(origin_mm=(5.0, -20.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
    flips = refused = 0
    scales, scores = [], []
    for k in range(count):
        tilt = Rotation.from_rotvec(np.radians(random.uniform(-15, 15, 3))).as_matrix()
        scale = random.uniform(6e3, 12e3)
        camera = OrthographicCamera(
            image_size=SIZE, scale=(scale, scale * random.uniform(0.998, 1.002)), skew=random.normal(0, 10),
            rotation_vector=tuple(Rotation.from_matrix(tilt @ SQUARE).as_rotvec()), offset=(150.0, 400.0),
            distortion=(random.normal(0, 2e-3), 0.0),
        )  # fmt: skip
        views = random_views(camera, "left", (flat, nearer) if k % 2 else (flat,), random)
        try:
            found = solve_rig({"left": views}, {"left": SIZE}, PLAIN, {}).rig.cameras["left"]
        except InputError:
            refused += 1
            continue
        assert isinstance(found, OrthographicCamera)
        flips += bool((Rotation.from_matrix(found.rotation @ camera.rotation.T)).magnitude() > np.radians(1.0))
        scales.append(found.scale[0] / camera.scale[0] - 1)
        sigma = 1e3 * np.sqrt(np.array(found.covariance)[0, 0])
        scores.append((found.scale[0] - camera.scale[0]) / sigma)
    yield Row("silent flips", f"{count} random rigs, half with one known board", flips, "0")
    yield Row("  refused", "the same", refused)
    yield Row("scale error, RMS", "12 views at 0.05 px", float(np.sqrt(np.mean(np.square(scales)))), "<= 3e-4")
    yield Row("error / predicted sigma", "scale", float(np.sqrt(np.mean(np.square(scores)))), "0.75 to 1.25")


# --- reconstruction -----------------------------------------------------------------------------------------


def two_cameras(scale: float) -> Rig:
    """At 90 degrees, both at 45 degrees to the faces, so that both see the same dots."""
    cameras: dict[str, Camera] = {}
    for name, angle in (("a", 45.0), ("b", -45.0)):
        rotation = SQUARE @ Rotation.from_rotvec([np.radians(angle), 0, 0]).as_matrix()
        cameras[name] = OrthographicCamera(
            image_size=SIZE, scale=(scale, scale), rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec())
        )
    return Rig(cameras)


def filmed(rig: Rig, places: np.ndarray, folder: Path, random: np.random.Generator) -> dict[str, Video]:
    """Raw videos of dots at places (T, M, 3), seen from every camera."""
    videos = {}
    for name, camera in rig.cameras.items():
        scene = Scene(size=SIZE, noise=2.0, slope=0.2)
        pixels = camera.project(places)
        pictures = []
        for t, now in enumerate(pixels):
            velocity = 0.5 * (pixels[min(t + 1, len(pixels) - 1)] - pixels[max(t - 1, 0)])
            ellipses = np.column_stack([now, np.full((len(now), 2), 9.0), np.zeros(len(now))])
            pictures.append(expose(draw(scene, ellipses, random, 0.2 * velocity), scene, random))
        path = folder / f"{name}.mkv"
        write_video(path, pictures, "ffv1", {})
        videos[name] = open_video(path)
    return videos


def in_the_middle(rig: Rig, places: np.ndarray) -> Rig:
    """The same rig, its pictures centred on the motion."""
    cameras: dict[str, Camera] = {}
    for name, camera in rig.cameras.items():
        assert isinstance(camera, OrthographicCamera)
        pixels = camera.project(places).reshape(-1, 2)
        middle = 0.5 * (pixels.min(0) + pixels.max(0))
        cameras[name] = replace(camera, offset=tuple(0.5 * (np.array(SIZE) - 1) - middle))
    return Rig(cameras)


def reconstructing(random: np.random.Generator, quick: bool, real: Path | None) -> Iterator[Row]:
    frames = 40 if quick else 100
    time_ = 0.01 * np.arange(frames)
    x, y = np.meshgrid(0.01 + 0.012 * np.arange(8), [0.005, 0.017, 0.029])
    rest = np.stack([x.ravel(), y.ravel(), np.full(24, 0.03)], axis=1)
    swing = 0.012 * np.sin(2 * np.pi * 7.7 * time_) * np.exp(-3 * time_)
    places = np.repeat(rest[None], frames, axis=0)
    places[..., 2] += swing[:, None] * (rest[:, 0] / 0.1) ** 2
    places[..., 1] += 0.3 * swing[:, None] * (rest[:, 0] / 0.1) ** 2
    yield from recovered("two cameras at 90 degrees, 6 px/mm", places, 6e3, random, "<= 5")
    if real is None:
        return
    for path in sorted(real.glob("*.c3d")):
        points = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
        places = points[:frames] - np.nanmean(points[:frames], axis=(0, 1))
        scale = 0.8 * min(SIZE) / float(np.ptp(places.reshape(-1, 3), axis=0).max())
        yield from recovered(path.stem, places, min(scale, 6e3), random, "<= 10")


def recovered(case: str, places: np.ndarray, scale: float, random: np.random.Generator, asked: str) -> Iterator[Row]:
    rig = in_the_middle(two_cameras(scale), places)
    layout = layout_of(places[0])
    with tempfile.TemporaryDirectory() as folder:
        videos = filmed(rig, places, Path(folder), random)
        tracks = track_recording(videos, rig, TrackingSettings(layout, None, 5), lambda: None)
    order = [tracks.names.index(name) for name in layout.names]
    error = 1e6 * (tracks.position[:, order] - places)
    rms = np.sqrt(np.nanmean(error**2, axis=(0, 1)))
    yield Row("RMS per axis, the worst [um]", case, float(rms.max()), asked)
    yield Row("within one sigma [%]", case, 100 * float((np.abs(error) < 1e6 * tracks.sigma[:, order]).mean()))


def layout_of(places: np.ndarray):  # type: ignore[no-untyped-def]
    from tracking.layout import MarkerLayout

    return MarkerLayout(tuple(f"m{k}" for k in range(len(places))), places)


SECTIONS: dict[str, Callable[..., Iterator[Row]]] = {
    "localisation": localisation,
    "linking": linking,
    "hiding": hiding,
    "filling": filling,
    "speed": speed,
    "calibrating": calibrating,
    "reconstructing": reconstructing,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--only", default=",".join(SECTIONS))
    parser.add_argument("--quick", action="store_true", help="fewer recordings and rigs")
    parser.add_argument("--real", type=Path, help="folder of real C3D recordings to film again")
    parser.add_argument("--out", type=Path, default=Path("build/bench-tracking.csv"))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"seed {options.seed}")
    rows: list[tuple[str, Row]] = []
    for section in options.only.split(","):
        random = np.random.default_rng([options.seed, list(SECTIONS).index(section)])
        more = {"real": options.real} if section == "reconstructing" else {}
        table = Table("what", "case", "value", "asked", title=section)
        for row in SECTIONS[section](random, options.quick, **more):
            rows.append((section, row))
            table.add_row(escape(row.what), row.case, f"{row.value:.4g}", row.asked)
        Console(width=120).print(table)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["section", "what", "case", "value", "asked"])
        writer.writerows([section, row.what.strip(), row.case, f"{row.value:.6g}", row.asked] for section, row in rows)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
