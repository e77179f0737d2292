"""The commands `rafl-render` and `rafl-capture`."""

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from capture.build import CaptureSettings, build_dataset, read_recording_rows
from capture.film import ENCODINGS, film, side_cameras, write_board_images, write_truth
from capture.motion import Motion, tip_load_release, twist_release
from capture.render import Look, Painter
from capture.specimen import read_specimen
from groundwork import InputError, command_line, progress, user_command, write_text
from rafl.dataset import write_dataset
from rafl.errors import SimulationError

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


@capture_app.command()
@user_command
def capture(
    specimen: Annotated[Path, typer.Argument(help="Specimen description (specimen.yaml).")],
    tracks: Annotated[
        Path, typer.Argument(help="Folder of tracks (.h5), motion capture (.c3d) or q0.npy, q1.npy, ...")
    ],
    recordings: Annotated[Path, typer.Option(help="Table of recordings: recording,load_g,split.")],
    out: Annotated[Path | None, typer.Option(help="Dataset to write [datasets/SPECIMEN.h5].")] = None,
    tolerance_mm: Annotated[float, typer.Option(min=0.0, help="Markers may stand this far off the skin.")] = 2.0,
    fit_tolerance_mm: Annotated[float, typer.Option(min=0.0, help="Registration may be this far off.")] = 3.0,
    rest: Annotated[str | None, typer.Option(help="RECORDING:FRAME in which the specimen is undeformed.")] = None,
    moving_clamp: Annotated[bool, typer.Option(help="Follow the clamp's markers, where there are some.")] = True,
    fps: Annotated[float, typer.Option(min=0.1, help="Frames per second of npy files.")] = 100.0,
) -> None:
    """Register recordings to the specimen, tie the markers to its mesh, and fit each first frame.

    Example: rafl-capture specimen.yaml tracks/ --recordings recordings.csv
    """
    described = read_specimen(specimen)
    rows = read_recording_rows(recordings)
    settings = CaptureSettings(1e-3 * tolerance_mm, 1e-3 * fit_tolerance_mm, fps, _rest_frame(rest), moving_clamp)
    path = out or Path("datasets") / f"{described.name}.h5"
    recipe = f"{described.text}\n# recordings.csv\n{recordings.read_text(encoding='utf-8')}"
    with progress() as bar:
        task = bar.add_task("fitting first frames", total=len(rows))
        try:
            dataset = build_dataset(described, tracks, rows, settings, recipe, lambda: bar.advance(task))
        except SimulationError as error:
            raise InputError(f"{error}; is the first frame a picture of the specimen at rest?") from None
    write_dataset(path, dataset)
    table = Table("recording", "split", "load [g]", "frames", "seen", "registration [mm]", "first frame [mm]")
    for name, item in dataset.trajectories.items():
        values = item.attributes
        table.add_row(
            name, item.split, f"{values['load_g']:g} {values['load']}", str(len(item.time)),
            f"{item.valid.mean():.1%}", f"{values['registration_residual_mm']:.3f}",
            f"{values['fit_residual_mm']:.3f}",
        )  # fmt: skip
    Console(width=110).print(table)
    typer.echo(f"wrote {path}")
    typer.echo(f"next: rafl-fit {path}")


def _rest_frame(text: str | None) -> tuple[str, int] | None:
    if text is None:
        return None
    recording, _, frame = text.rpartition(":")
    if not recording or not frame.isdigit():
        raise InputError(f"--rest: expected RECORDING:FRAME, found {text!r}; for instance straight:12")
    return recording, int(frame)
