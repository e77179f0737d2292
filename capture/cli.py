"""The commands `rafl-render` and `rafl-capture`."""

import re
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rafl.capture.dataset.build import CaptureSettings, build_dataset
from rafl.capture.dataset.summary import print_page, recordings_table, warnings
from rafl.capture.dataset.table import read_recording_rows
from rafl.capture.registration.registration import RestPose
from rafl.capture.rendering.film import ENCODINGS, film, side_cameras, write_board_images, write_truth
from rafl.capture.rendering.motion import Motion, tip_load_release, twist_release
from rafl.capture.rendering.render import Look, Painter
from rafl.capture.report import write_dataset_report
from rafl.capture.specimen.specimen import read_specimen
from rich.console import Console

from rafl.common.command_line import command_line, progress, user_command
from rafl.common.errors import InputError, SimulationError
from rafl.common.files import write_text
from rafl.data.dataset_file import damaged_parts, update_dataset, write_dataset

DRAWN_MM = 2.0  # how far off the skin a marker may stand to be drawn there

render_app = command_line("Film simulated specimens.")
capture_app = command_line("Build datasets.")


class Background(StrEnum):
    """What is behind the specimen."""

    plain = "plain"
    clutter = "clutter"


class Codec(StrEnum):
    """How videos are encoded."""

    h264 = "h264"
    ffv1 = "ffv1"
    mjpeg = "mjpeg"


def _numbers(text: str, option: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise InputError(f"{option}: expected numbers with commas between, found {text!r}") from None


@render_app.command()
@user_command
def render(
    specimen: Annotated[Path, typer.Argument(help="Specimen description (specimen.yaml).")],
    out: Annotated[Path, typer.Option(help="Folder to write; must not hold files yet.")],
    loads_g: Annotated[str, typer.Option(help="Tip loads released [g].")] = "60,90,120,70,150,100",
    twists_deg: Annotated[str, typer.Option(help="Tip twists released [degrees].")] = "",
    frames: Annotated[int, typer.Option(min=2, help="Frames of each recording.")] = 100,
    fps: Annotated[float, typer.Option(min=1.0, help="Frames per second.")] = 100.0,
    youngs_modulus: Annotated[float, typer.Option(min=1.0, help="The true one [Pa].")] = 264e3,
    poissons_ratio: Annotated[float, typer.Option(min=0.0, max=0.4999, help="The true one.")] = 0.499,
    dot_mm: Annotated[float, typer.Option(min=0.1, help="Diameter of the dots.")] = 3.0,
    blur_px: Annotated[float, typer.Option(min=0.0, help="Lens blur, standard deviation.")] = 0.8,
    exposure: Annotated[float, typer.Option(min=0.0, max=1.0, help="Share of the frame time.")] = 0.2,
    noise: Annotated[float, typer.Option(min=0.0, help="Sensor noise [grey levels].")] = 2.0,
    background: Annotated[Background, typer.Option(help="Behind the specimen.")] = Background.plain,
    codec: Annotated[Codec, typer.Option(help="Of the videos.")] = Codec.h264,
    seed: Annotated[int, typer.Option(min=0, help="Of noise and camera misalignment.")] = 0,
) -> None:
    """Simulate a specimen of a chosen true material and film it with two cameras.

    Writes videos/, calibration/ (board pictures), recordings.csv and truth.h5.

    Example: rafl-render datasets/specimens/canonical.yaml --out demo
    """
    described = read_specimen(specimen)
    described.markers(1e-3 * DRAWN_MM, "or choose smaller elements: dots are drawn on the skin of the elements")
    if out.exists() and any(out.iterdir()):
        raise InputError(f"expected a new or empty folder at {out}, found files in it; choose another --out")
    loads, twists = _numbers(loads_g, "--loads-g"), _numbers(twists_deg, "--twists-deg")
    if not loads and not twists:
        raise InputError("expected at least one recording, found none; give --loads-g or --twists-deg")
    truth = replace(described.material, youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio)
    look = Look(0.5e-3 * dot_mm, blur_px, exposure, noise, background.value)
    with progress() as bar:
        task = bar.add_task("simulating", total=len(loads) + len(twists))
        motions: list[Motion] = []
        try:
            for load in loads:
                motions.append(tip_load_release(described, truth, 1e-3 * load, frames, fps))
                bar.advance(task)
            for twist in twists:
                motions.append(twist_release(described, truth, np.radians(twist), frames, fps))
                bar.advance(task)
        except SimulationError as error:
            raise InputError(f"the motion cannot be simulated: {error}") from None
        random = np.random.default_rng(seed)
        rig = side_cameras(described, motions, random)
        write_board_images(out / "calibration", rig, look, random)
        painters = {name: Painter.of(described, camera, look, random) for name, camera in rig.cameras.items()}
        task = bar.add_task("filming", total=frames * len(motions) * len(painters))
        for number, motion in enumerate(motions):
            for view, (name, painter) in enumerate(painters.items()):
                path = out / "videos" / motion.name / f"{name}.{ENCODINGS[codec.value].suffix}"
                film(
                    path,
                    motion,
                    painter,
                    fps,
                    codec.value,
                    seed + 97 * number + view,
                    lambda: bar.advance(task),
                )
    described_truth = f"E = {youngs_modulus} Pa, nu = {poissons_ratio}, density = {truth.density} kg/m^3"
    write_truth(out / "truth.h5", described, motions, rig, described_truth)
    write_text(out / "recordings.csv", _splits(motions))
    typer.echo(f"wrote {out}/ (videos/, calibration/, recordings.csv, truth.h5)")
    typer.echo(f"next: rafl-calibrate {out}/calibration --out {out}/calib.yaml")


def _splits(motions: list[Motion]) -> str:
    """recordings.csv: about 60 % to train, the rest to validate and to test."""
    pattern = ("train", "test", "train", "val", "train", "test")
    rows = [f"{m.name},{1e3 * m.load:g},{pattern[i % len(pattern)]}" for i, m in enumerate(motions)]
    return "\n".join(["recording,load_g,split", *rows, ""])


class Initial(StrEnum):
    """How the first frame is understood, and found."""

    rest = "rest"
    moving = "moving"
    sequence = "sequence"


class Forces(StrEnum):
    """Where virtual forces act."""

    tip = "tip"
    surface = "surface"


@capture_app.command()
@user_command
def capture(
    specimen: Annotated[Path | None, typer.Argument(help="Specimen description (specimen.yaml).")] = None,
    tracks: Annotated[
        Path | None, typer.Argument(help="Folder of tracks (.h5), motion capture (.c3d) or q0.npy, q1.npy, ...")
    ] = None,
    recordings: Annotated[Path | None, typer.Option(help="Table of recordings: recording,load_g,split.")] = None,
    out: Annotated[Path | None, typer.Option(help="Dataset to write [datasets/SPECIMEN.h5].")] = None,
    update: Annotated[bool, typer.Option("--update", help="Add to, or replace in, the dataset there.")] = False,
    tolerance_mm: Annotated[float, typer.Option(min=0.0, help="Markers may stand this far off the skin.")] = 2.0,
    fit_tolerance_mm: Annotated[float, typer.Option(min=0.0, help="Registration may be this far off.")] = 3.0,
    rest: Annotated[
        str | None, typer.Option(help="Where the specimen is undeformed: RECORDING, or RECORDING:FIRST-LAST frames.")
    ] = None,
    moving_clamp: Annotated[bool, typer.Option(help="Follow the clamp's markers, where there are some.")] = True,
    start: Annotated[
        int | None, typer.Option(min=0, help="First frame of the motion [by recording, from the motion].")
    ] = None,
    initial: Annotated[
        Initial,
        typer.Option(help="First frame at rest; moving; or at rest, found the slow way of earlier work (sequence)."),
    ] = Initial.rest,
    forces: Annotated[Forces, typer.Option(help="Where virtual forces hold the first frame.")] = Forces.tip,
    fps: Annotated[float, typer.Option(min=0.1, help="Frames per second of npy files.")] = 100.0,
    inspect: Annotated[Path | None, typer.Option(help="Only print what a dataset holds.")] = None,
    verify: Annotated[Path | None, typer.Option(help="Only compare a dataset with its hashes.")] = None,
) -> None:
    """Register recordings to the specimen, tie the markers to its mesh, and fit each first frame.

    Example: rafl-capture specimen.yaml tracks/ --recordings recordings.csv
    """
    torch.set_num_threads(1)  # the element kernels have the other cores
    if inspect is not None or verify is not None:
        _look(inspect, verify)
        return
    if specimen is None or tracks is None or recordings is None:
        raise InputError(
            "expected a specimen, a folder of tracks and --recordings, found fewer; for instance "
            "rafl-capture specimen.yaml tracks/ --recordings recordings.csv"
        )
    described = read_specimen(specimen)
    rows = read_recording_rows(recordings, complete=not update)
    settings = CaptureSettings(
        1e-3 * tolerance_mm,
        1e-3 * fit_tolerance_mm,
        fps,
        _rest_pose(rest),
        moving_clamp,
        start,
        initial.value,
        forces.value,
    )
    path = out or Path("datasets") / f"{described.name}.h5"
    recipe = f"{described.text}\n# recordings.csv\n{recordings.read_text(encoding='utf-8')}"
    with progress() as bar:
        task = bar.add_task("fitting first frames", total=len(rows))
        try:
            dataset = build_dataset(described, tracks, rows, settings, recipe, lambda: bar.advance(task))
        except SimulationError as error:
            raise InputError(f"{error}; is the first frame a picture of the specimen at rest?") from None
    (update_dataset if update else write_dataset)(path, dataset)
    report = path.with_suffix(".html")
    write_dataset_report(report, described, dataset)
    Console(width=130).print(recordings_table(dataset))
    for line in warnings(dataset):
        typer.echo(line, err=True)
    typer.echo(f"wrote {path} and {report}")
    typer.echo(f"next: rafl-fit {path}")


def _look(inspect: Path | None, verify: Path | None) -> None:
    if inspect is not None:
        print_page(inspect, Console(width=130, soft_wrap=True))
    if verify is not None:
        damaged = damaged_parts(verify)
        if damaged:
            raise InputError(
                f"expected {verify} as it was written, found {', '.join(damaged)} changed; build it again, or fetch "
                "another copy"
            )
        typer.echo(f"{verify}: all parts are as they were written")


def _rest_pose(text: str | None) -> RestPose | None:
    if text is None:
        return None
    found = re.fullmatch(r"(?P<recording>[^:]+)(:(?P<first>\d+)(-(?P<last>\d+))?)?", text)
    if found is None:
        raise InputError(
            f"--rest: expected RECORDING, RECORDING:FRAME or RECORDING:FIRST-LAST, found {text!r}; for instance "
            "straight:12-40"
        )
    first, last = (None if found[key] is None else int(found[key]) for key in ("first", "last"))
    return RestPose(found["recording"], first, first if last is None else last)
