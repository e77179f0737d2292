"""Whether markers keep their names while they move, hide, leave and come back, and how fast they are followed."""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import pandas as pd
import trackpy
from footage import Row, write_video
from motions import Beam, random_beam
from rafl.tracking.linking.follow import follow
from rafl.tracking.reconstruction.gap_filling import fill_gaps
from rafl.tracking.synthetic import Scene, draw, expose
from rafl.tracking.video.frame import Frame
from rafl.tracking.video.reader import Reading, Video, open_video


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
    tracks = follow(drawn, lambda: None)
    truth, spacing = drawn.beam.centres, drawn.beam.spacing
    hidden = np.zeros(truth.shape[:2], bool) if drawn.hidden is None else drawn.hidden
    apart = np.linalg.norm(truth[0][:, None] - tracks.start[None], axis=2)
    away = np.linalg.norm(tracks.pixel[:, apart.argmin(axis=1)] - truth, axis=2)
    away[:, apart.min(axis=1) > 0.5 * spacing] = np.nan  # dots that no track begins at
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
        ("a third hidden for the first 30 frames", 120),
        ("a bar of 2.4 spacings passes", 100),
    ):
        results = []
        for k in range(count):
            beam = random_beam(random, frames, random.uniform(0.3, 1.0))
            dots = beam.centres.shape[1]
            hidden = np.zeros((frames, dots), bool)
            side = np.argsort(beam.centres[0] @ random.normal(size=2))[: dots // 3]
            across = beam.centres[:, :, 0]
            if case == "a third hidden 100 frames":
                hidden[20:120, side if k % 2 else random.permutation(dots)[: dots // 3]] = True
            elif case == "a third hidden for the first 30 frames":
                hidden[:30, side] = True
            elif case == "all hidden 10 frames":
                hidden[20:30] = True
            elif case == "leaving and entering":
                hidden = across > np.quantile(across, 0.7)
                hidden[0] = False
            else:
                bar = np.linspace(across.min() - 60.0, across.max() + 60.0, frames)[:, None]
                hidden = np.abs(across - bar) < 1.2 * beam.spacing
                hidden[0] = False
            results.append(judge(Drawn(beam, random.uniform(2, 6), k, hidden)))
        yield Row("recordings with a wrong identity", case, sum(item.wrong > 0 for item in results), "0")
        yield Row("dots not back at the end", case, sum(item.late for item in results), "0")
        yield Row("dots in sight not measured [%]", case, 100 * float(np.mean([item.lost for item in results])))


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
                for _ in range(12):  # on a shared machine few are undisturbed
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
