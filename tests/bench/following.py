"""Tracking benchmark: identities of markers that move, are occluded, appear late or return; gap filling; speed."""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import pandas as pd
import trackpy
from footage import Measurement, write_video
from motions import Beam, random_beam
from synthetic import Scene, draw, expose

from rafl.tracking.linking.follow import follow
from rafl.tracking.reconstruction.gap_filling import fill_gaps
from rafl.tracking.video.frame import Frame
from rafl.tracking.video.reader import Reading, Video, open_video

EXPOSURE = 0.2  # fraction of the time between two frames
BLOBS_FROM = 5  # frame that first shows the static dots beside the body


@dataclass(frozen=True)
class SyntheticVideo:
    """Replaces a video: frames of a beam, drawn when they are read.

    Attributes:
        beam: whose dots are drawn.
        noise: standard deviation of the sensor's noise [grey levels].
        seed: of the noise.
        occluded: dots that are not drawn, (T, D); None for none.
        blobs: static dots beside the body, drawn from frame 5 on [px], (B, 2); None for none.
        path: for messages.
    """

    beam: Beam
    noise: float
    seed: int
    occluded: np.ndarray | None = None
    blobs: np.ndarray | None = None
    path: Path = Path("drawn")
    predicted_frames: bool = False

    def read(self) -> Reading:
        return Reading(self.frames())

    def frames(self) -> Iterator[Frame]:
        random = np.random.default_rng(self.seed)
        scene = Scene(size=self.beam.size, noise=self.noise, light_falloff=0.2, supersampling=2)
        centres = self.beam.centres
        for t, current in enumerate(centres):
            velocity = 0.5 * (centres[min(t + 1, len(centres) - 1)] - centres[max(t - 1, 0)])
            visible = np.ones(len(current), bool) if self.occluded is None else ~self.occluded[t]
            shown, motion = current[visible], EXPOSURE * velocity[visible]
            if self.blobs is not None and t >= BLOBS_FROM:
                shown, motion = np.concatenate([shown, self.blobs]), np.pad(motion, ((0, len(self.blobs)), (0, 0)))
            ellipses = np.column_stack([shown, np.full((len(shown), 2), self.beam.radius), np.zeros(len(shown))])
            image = expose(draw(scene, ellipses, random, motion), scene, random)
            yield Frame(0.01 * t, image)


@dataclass(frozen=True)
class LinkingErrors:
    """Errors in the tracks of one recording.

    Attributes:
        wrong: number of positions more than 0.4 spacings from the true position of their dot.
        unmeasured: fraction of the visible dots that were not measured, over all frames.
        unmeasured_at_end: number of dots visible in the last frame that were not measured there.
    """

    wrong: int
    unmeasured: float
    unmeasured_at_end: int


def linking_errors(video: SyntheticVideo) -> LinkingErrors:
    tracks = follow(video, lambda: None)
    truth, spacing = video.beam.centres, video.beam.spacing
    occluded = np.zeros(truth.shape[:2], bool) if video.occluded is None else video.occluded
    start_distance = np.linalg.norm(truth[0][:, None] - tracks.start[None], axis=2)
    error = np.linalg.norm(tracks.pixel[:, start_distance.argmin(axis=1)] - truth, axis=2)
    error[:, start_distance.min(axis=1) > 0.5 * spacing] = np.nan  # dots without a track
    measured = np.isfinite(error)
    wrong = int((error[measured] > 0.4 * spacing).sum())
    unmeasured = (~occluded & ~measured).sum() / (~occluded).sum()
    return LinkingErrors(wrong, float(unmeasured), int((~occluded & ~measured)[-1].sum()))


def trackpy_identity_changes(beam: Beam) -> int:
    """Number of times that trackpy's linker changes a dot's identity, given the true positions."""
    frames, dots, _ = beam.centres.shape
    table = pd.DataFrame(beam.centres.reshape(-1, 2), columns=["x", "y"])
    table["frame"], table["dot"] = np.repeat(np.arange(frames), dots), np.tile(np.arange(dots), frames)
    try:
        linked = trackpy.link(table, search_range=0.9 * beam.spacing, memory=3)
    except trackpy.SubnetOversizeException:
        linked = trackpy.link(table, search_range=0.45 * beam.spacing, memory=3)
    linked = linked.sort_values(["dot", "frame"])
    return int((linked.groupby("dot").particle.nunique() - 1).sum())


def measure_linking(random: np.random.Generator, quick: bool) -> Iterator[Measurement]:
    count = 40 if quick else 300
    results, identity_changes = [], 0
    max_displacement = 0.0
    for k in range(count):
        beam = random_beam(random, 40, random.uniform(0.5, 1.5))
        max_displacement = max(max_displacement, beam.max_displacement)
        results.append(linking_errors(SyntheticVideo(beam, random.uniform(2, 6), k)))
        identity_changes += trackpy_identity_changes(beam) if k < 60 else 0
    case = f"{count} recordings, up to {max_displacement:.2f} spacings per frame"
    yield Measurement("recordings with a wrong identity", case, sum(item.wrong > 0 for item in results), "0")
    yield Measurement("dots not measured [%]", case, 100 * float(np.mean([item.unmeasured for item in results])))
    yield Measurement("  trackpy: identity changes", f"first {min(count, 60)} recordings", identity_changes)


def measure_occlusion(random: np.random.Generator, quick: bool) -> Iterator[Measurement]:
    count = 10 if quick else 60
    for case, frames in (
        ("a third occluded for 100 frames", 150),
        ("all occluded for 10 frames", 50),
        ("dots leave and enter the image", 120),
        ("a third occluded in the first 30 frames", 120),
        ("an occluding bar of 2.4 spacings passes", 100),
    ):
        results = []
        for k in range(count):
            beam = random_beam(random, frames, random.uniform(0.3, 1.0))
            dots = beam.centres.shape[1]
            occluded = np.zeros((frames, dots), bool)
            side = np.argsort(beam.centres[0] @ random.normal(size=2))[: dots // 3]
            across = beam.centres[:, :, 0]
            if case == "a third occluded for 100 frames":
                occluded[20:120, side if k % 2 else random.permutation(dots)[: dots // 3]] = True
            elif case == "a third occluded in the first 30 frames":
                occluded[:30, side] = True
            elif case == "all occluded for 10 frames":
                occluded[20:30] = True
            elif case == "dots leave and enter the image":
                occluded = across > np.quantile(across, 0.7)
                occluded[0] = False
            else:
                bar = np.linspace(across.min() - 60.0, across.max() + 60.0, frames)[:, None]
                occluded = np.abs(across - bar) < 1.2 * beam.spacing
                occluded[0] = False
            results.append(linking_errors(SyntheticVideo(beam, random.uniform(2, 6), k, occluded)))
        unmeasured = 100 * float(np.mean([item.unmeasured for item in results]))
        yield Measurement("recordings with a wrong identity", case, sum(item.wrong > 0 for item in results), "0")
        yield Measurement("dots not measured in the last frame", case, sum(r.unmeasured_at_end for r in results), "0")
        yield Measurement("visible dots not measured [%]", case, unmeasured)


def measure_late_markers(random: np.random.Generator, quick: bool) -> Iterator[Measurement]:
    count, frames = 20 if quick else 100, 120
    complete = wrong = 0
    for k in range(count):
        beam = random_beam(random, frames, random.uniform(0.3, 1.0))
        dots = beam.centres.shape[1]
        side = np.argsort(beam.centres[0] @ random.normal(size=2))
        occluded = np.zeros((frames, dots), bool)
        occluded[: random.integers(10, 41), (side if k % 2 else random.permutation(dots))[: dots // 3]] = True
        errors = linking_errors(SyntheticVideo(beam, random.uniform(2, 6), k, occluded))
        complete += errors.unmeasured_at_end == 0
        wrong += errors.wrong > 0
    case = f"{count} bodies, a third of the dots appears late"
    yield Measurement("bodies with all late markers found [%]", case, 100 * complete / count, ">= 95")
    yield Measurement("recordings with a wrong identity", case, wrong, "0")
    taken = 0
    for k in range(count):
        beam = random_beam(random, frames, random.uniform(0.1, 1.0))
        video = SyntheticVideo(beam, random.uniform(2, 6), k, blobs=_blobs_beside(beam, random, 8))
        taken += follow(video, lambda: None).late_count > 0
    case = f"{count} bodies beside 8 static dots"
    yield Measurement("recordings with a static dot taken for a marker", case, taken, "0")


def _blobs_beside(beam: Beam, random: np.random.Generator, count: int) -> np.ndarray:
    """Up to `count` random places in the image that no dot touches in any frame [px], (B, 2)."""
    kept = beam.centres.reshape(-1, 2)
    found: list[np.ndarray] = []
    for _ in range(50 * count):
        place = random.uniform(2.0 * beam.radius, np.array(beam.size) - 2.0 * beam.radius)
        if len(found) < count and np.linalg.norm(kept - place, axis=1).min() > 2.6 * beam.radius:
            kept = np.concatenate([kept, place[None]])
            found.append(place)
    return np.array(found).reshape(-1, 2)


def measure_gap_filling(random: np.random.Generator, quick: bool) -> Iterator[Measurement]:
    largest, covered = [], []
    for _ in range(20 if quick else 100):
        beam = random_beam(random, 150, random.uniform(0.3, 1.0))
        truth = np.concatenate([beam.centres, np.zeros((*beam.centres.shape[:2], 1))], axis=2)
        observed = truth + random.normal(0, 0.015, truth.shape)
        sigma = np.full(truth.shape, 0.015)
        missing = np.zeros(truth.shape[:2], bool)
        for _ in range(10):
            start, marker = random.integers(20, 140), random.integers(0, truth.shape[1])
            missing[start : start + random.integers(1, 6), marker] = True
        observed[missing] = np.nan
        filled, filled_sigma, state = fill_gaps(observed, sigma, 0.01 * np.arange(150), 5)
        error = (filled - truth)[state == 2][:, :2]
        largest.append(np.abs(error).max())
        covered.append((np.abs(error) < filled_sigma[state == 2][:, :2]).mean())
    case = "gaps of 1 to 5 frames"
    yield Measurement("largest error of a filled position [px]", case, float(np.max(largest)), "<= 0.15")
    yield Measurement("errors within one sigma [%]", case, 100 * float(np.mean(covered)))


def measure_speed(random: np.random.Generator, quick: bool) -> Iterator[Measurement]:
    count = 300 if quick else 900
    with tempfile.TemporaryDirectory() as folder:
        for size in ((1280, 720), (1920, 1080)):
            frames = list(beam_frames(size, random))
            for codec, options in (("h264", {"crf": "18"}), ("mjpeg", {"qmin": "3", "qmax": "3"})):
                path = Path(folder) / f"{size[1]}.{'mp4' if codec == 'h264' else 'avi'}"
                write_video(path, frames, codec, options, repeat=count // len(frames))
                video = open_video(path)
                track(video)  # compiles the kernels
                case = f"{size[1]}p {codec}, {count} frames"
                tasks = {"one thread": decode_one_thread, "all cores": decode_all_cores, "track": track}
                times: dict[str, list[float]] = {name: [] for name in tasks}
                for _ in range(12):  # on a shared machine few runs are undisturbed
                    for name, task in tasks.items():
                        start = time.perf_counter()
                        task(video)
                        times[name].append(time.perf_counter() - start)
                best = {name: min(values) for name, values in times.items()}
                rate = len(frames) * (count // len(frames)) / best["track"]
                ratio = best["one thread"] / best["track"]
                yield Measurement("tracking speed / decoding speed, one thread", case, ratio, ">= 0.85")
                yield Measurement("  / decoding speed, all cores", case, best["all cores"] / best["track"])
                yield Measurement("  frames per second", case, rate)


def beam_frames(size: tuple[int, int], random: np.random.Generator) -> Iterator[np.ndarray]:
    """Half a period of a beam with 32 dots that move by at most 28 px per frame."""
    scene = Scene(size=size, noise=2.0, light_falloff=0.15, supersampling=4)
    column, row = np.repeat(np.arange(8), 4), np.tile(np.arange(4), 8)
    x = 0.08 * size[0] + column * 0.115 * size[0]
    mode = (x / size[0]) ** 2
    for t in range(60):
        phase = np.pi * t / 59
        y = 0.3 * size[1] + 45 * row + 220 * mode * np.sin(phase - np.pi / 2)
        semi_axes = np.full((32, 2), 8.0)
        motion = np.stack([np.zeros(32), EXPOSURE * 220 * mode * np.cos(phase - np.pi / 2) * np.pi / 59], axis=1)
        ellipses = np.column_stack([x, y, semi_axes, np.zeros(32)])
        yield expose(draw(scene, ellipses, random, motion), scene, random)


def decode_one_thread(video: Video) -> None:
    """Decode the luma plane with PyAV in one thread, the only way that reports damage."""
    _decode(video, "NONE", 1)


def decode_all_cores(video: Video) -> None:
    """Decode the luma plane with the number of threads that FFmpeg chooses."""
    _decode(video, "AUTO", 0)


def _decode(video: Video, thread_type: str, threads: int) -> None:
    with av.open(str(video.path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = thread_type
        if threads:
            stream.codec_context.thread_count = threads
        for frame in container.decode(stream):
            np.frombuffer(frame.planes[0], np.uint8).reshape(frame.height, -1)[:, : frame.width].copy()


def track(video: Video) -> None:
    follow(video, lambda: None)
