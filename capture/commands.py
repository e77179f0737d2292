"""What `rafl-render` and `rafl-capture` do once their options are checked: call the library, print and write."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import typer
from rich.console import Console

from rafl.capture.dataset.build import CaptureSettings as CaptureSettings
from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.naming import read_marker_names as read_marker_names
from rafl.capture.dataset.summary import print_contents, recordings_table, warnings
from rafl.capture.dataset.table import RecordingRow, read_recording_rows
from rafl.capture.registration.registration import RestPose as RestPose
from rafl.capture.rendering.film import ENCODINGS, render_video, side_cameras, write_board_images, write_truth
from rafl.capture.rendering.motion import SimulatedMotion, tip_load_release, twist_release
from rafl.capture.rendering.render import Appearance, Renderer
from rafl.capture.report import dataset_page
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.command_line import progress
from rafl.common.errors import InputError, SimulationError
from rafl.common.files import new_content, require_writable, write_text, written_texts
from rafl.common.kernels import announce_compilation
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import damaged_parts, read_dataset, update_dataset, write_dataset
from rafl.data.markers import Markers
from rafl.fem.material import modulus_hint

DRAWN_MM = 2.0  # largest distance from the skin of the mesh at which a marker is drawn [mm]


@dataclass(frozen=True)
class TrueMaterial:
    """The material that rendered recordings have.

    Attributes:
        youngs_modulus: [Pa].
        poissons_ratio: dimensionless.
    """

    youngs_modulus: float
    poissons_ratio: float


def create_appearance(dot_mm: float, blur_px: float, exposure: float, noise: float, background: str) -> Appearance:
    """Appearance from dot diameter [mm], sigma of the blur [px], exposure [frame times] and noise [grey levels]."""
    return Appearance(0.5e-3 * dot_mm, blur_px, exposure, noise, background)


def render(
    specimen: Path,
    out: Path,
    loads_g: list[float],
    twists_deg: list[float],
    frames: int,
    fps: float,
    true: TrueMaterial,
    appearance: Appearance,
    codec: str,
    seed: int,
) -> None:
    """Simulate the releases and write videos, board images, recordings.csv and truth.h5.

    Raises:
        InputError: the specimen cannot be read, its markers cannot be drawn, or a motion cannot be simulated.
    """
    announce_compilation()
    require_writable(out)
    described = read_specimen(specimen)
    described.markers(1e-3 * DRAWN_MM, "or choose smaller elements: dots are drawn on the skin of the elements")
    for modulus in (described.material.youngs_modulus, true.youngs_modulus):
        if hint := modulus_hint(modulus):
            typer.echo(hint, err=True)
    material = replace(described.material, youngs_modulus=true.youngs_modulus, poissons_ratio=true.poissons_ratio)
    with progress() as bar, new_content(out):
        task = bar.add_task("simulating", total=len(loads_g) + len(twists_deg))
        motions: list[SimulatedMotion] = []
        try:
            for load in loads_g:
                motions.append(tip_load_release(described, material, 1e-3 * load, frames, fps))
                bar.advance(task)
            for twist in twists_deg:
                motions.append(twist_release(described, material, np.radians(twist), frames, fps))
                bar.advance(task)
        except SimulationError as error:
            raise InputError(f"the motion cannot be simulated: {error}") from None
        motions = _with_distinct_names(motions)
        random = np.random.default_rng(seed)
        rig = side_cameras(described, motions, random)
        write_board_images(out / "calibration", rig, appearance, random)
        renderers = {name: Renderer.of(described, camera, appearance, random) for name, camera in rig.cameras.items()}
        task = bar.add_task("rendering", total=frames * len(motions) * len(renderers))
        for number, motion in enumerate(motions):
            for view, (name, renderer) in enumerate(renderers.items()):
                path = out / "videos" / motion.name / f"{name}.{ENCODINGS[codec].suffix}"
                render_video(path, motion, renderer, fps, codec, seed + 97 * number + view, lambda: bar.advance(task))
        truth = f"E = {true.youngs_modulus} Pa, nu = {true.poissons_ratio}, density = {material.density} kg/m^3"
        write_truth(out / "truth.h5", described, motions, rig, truth)
        write_text(out / "recordings.csv", _recordings_csv(motions))
    typer.echo(f"wrote {out}/ (videos/, calibration/, recordings.csv, truth.h5)")
    typer.echo(f"next: rafl-calibrate {out}/calibration --out {out}/calib.yaml")


def _with_distinct_names(motions: list[SimulatedMotion]) -> list[SimulatedMotion]:
    """The motions; from the second of a name on, with a number behind it."""
    count: Counter[str] = Counter()
    named = []
    for motion in motions:
        count[motion.name] += 1
        number = count[motion.name]
        named.append(motion if number == 1 else replace(motion, name=f"{motion.name}-{number}"))
    return named


def _recordings_csv(motions: list[SimulatedMotion]) -> str:
    """The table of recordings: about 60 % train, the rest val and test."""
    pattern = ("train", "test", "train", "val", "train", "test")
    rows = [f"{m.name},{1e3 * m.load:g},{pattern[i % len(pattern)]}" for i, m in enumerate(motions)]
    return "\n".join(["recording,load_g,split", *rows, ""])


def capture(
    specimen: Path, tracks: Path, recordings: Path, out: Path | None, update: bool, settings: CaptureSettings
) -> None:
    """Build a dataset from tracks and a table of recordings; print a table and write a report beside it.

    Raises:
        InputError: a file cannot be read, or a recording does not fit the specimen.
    """
    torch.set_num_threads(1)  # the element kernels have the other cores
    announce_compilation()
    described = read_specimen(specimen)
    rows = read_recording_rows(recordings)
    path = out or Path("datasets") / f"{described.name}.h5"
    require_writable(path)
    known = read_dataset(path).markers if update else None
    dataset = _built(described, tracks, rows, settings, recordings, known)
    report = path.with_suffix(".html")
    with written_texts({report: dataset_page(described, dataset)}):
        (update_dataset if update else write_dataset)(path, dataset)
    Console(width=130).print(recordings_table(dataset))
    for line in warnings(dataset):
        typer.echo(line, err=True)
    typer.echo(f"wrote {path} and {report}")
    typer.echo(f"next: rafl-fit {path}")


def _built(
    specimen: Specimen,
    tracks: Path,
    rows: list[RecordingRow],
    settings: CaptureSettings,
    recordings: Path,
    known: Markers | None,
) -> Dataset:
    recipe = f"{specimen.text}\n# recordings.csv\n{recordings.read_text(encoding='utf-8')}"
    with progress() as bar:
        task = bar.add_task("fitting first frames", total=len(rows))
        try:
            return build_dataset(specimen, tracks, rows, settings, recipe, lambda: bar.advance(task), known)
        except SimulationError as error:
            raise InputError(f"{error}; does the first frame show the specimen at rest?") from None


def inspect(contents: Path | None, verify: Path | None) -> None:
    """Print the contents of one dataset, and compare another with its hashes.

    Raises:
        InputError: a dataset cannot be read, or differs from its hashes.
    """
    if contents is not None:
        print_contents(contents, Console(width=130, soft_wrap=True))
    if verify is not None:
        damaged = damaged_parts(verify)
        if damaged:
            raise InputError(
                f"expected {verify} as it was written, found {', '.join(damaged)} changed; build it again, or fetch "
                "another copy"
            )
        typer.echo(f"{verify}: all parts are as they were written")
