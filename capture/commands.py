"""What `rafl-render`, `rafl-specimen` and `rafl-capture` do once their options are checked: call, print and write."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import typer
from rich.console import Console

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.naming import read_marker_names as read_marker_names
from rafl.capture.dataset.settings import CaptureSettings as CaptureSettings
from rafl.capture.dataset.sources import read_recording
from rafl.capture.dataset.summary import (
    cameras_table,
    missing_pixels,
    print_contents,
    recordings_table,
    warnings,
)
from rafl.capture.dataset.table import RecordingRow, read_recording_rows
from rafl.capture.description.describe import MEASURED_SIGMA, describe
from rafl.capture.description.specimen_files import (
    description_summary,
    description_warnings,
    specimen_files,
    uncertain_sag,
)
from rafl.capture.description.specimen_text import (
    body_like,
    body_of_box,
    body_of_surface,
    specimen_name,
    specimen_text,
)
from rafl.capture.description.stencil import design_stencil, stencil_pdf
from rafl.capture.registration.material_change import MODULUS_SIGMA
from rafl.capture.registration.registration import RestPose as RestPose
from rafl.capture.rendering.film import ENCODINGS, render_video, side_cameras, write_board_images, write_truth
from rafl.capture.rendering.motion import SimulatedMotion, tip_load_release, twist_release
from rafl.capture.rendering.render import Appearance, Renderer
from rafl.capture.report import dataset_page
from rafl.capture.specimen.specimen import Body, Specimen, read_specimen
from rafl.common.command_line import next_command, progress
from rafl.common.errors import InputError, SimulationError
from rafl.common.files import new_content, require_writable, write_text, written_files
from rafl.common.kernels import announce_compilation
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import damaged_parts, read_dataset, update_dataset, write_dataset
from rafl.data.markers import Markers
from rafl.fem.material import unit_hints

UNUSED_FPS = 100.0  # of a recording at rest without times
CHECK_FIRST_FRAME = (
    "Check youngs_modulus (in Pa), the size, the clamp and at_mm in the specimen file, and that the first frame shows "
    "the specimen at rest"
)
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
    cameras: list[str],
    codec: str,
    seed: int,
) -> None:
    """Simulate the releases and write videos, board images, recordings.csv and truth.h5.

    cameras: names of those that film, of `film.CAMERA_AXES`. The other options are those of the command.

    Raises:
        InputError: the specimen cannot be read, its markers cannot be drawn, or a motion cannot be simulated.
    """
    announce_compilation()
    require_writable(out)
    described = read_specimen(specimen)
    described.markers(1e-3 * DRAWN_MM, "or choose smaller elements: dots are drawn on the skin of the elements")
    moduli, density = (described.material.youngs_modulus, true.youngs_modulus), described.material.density
    for hint in dict.fromkeys(hint for modulus in moduli for hint in unit_hints(modulus, density)):
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
        both = side_cameras(described, motions, random)
        rig = replace(both, cameras={name: both.cameras[name] for name in cameras})
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
    typer.echo(next_command("rafl-calibrate", out / "calibration", "--out", out / "calib.yaml"))


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


@dataclass(frozen=True)
class SpecimenBody:
    """The body of a specimen, as the options of `rafl-specimen` describe it.

    Attributes:
        size_mm, surface, like: of a box, a surface, or another specimen file; one of them is not None.
        element_mm: edge of the elements; None to choose it.
        youngs_modulus, density: measured [Pa, kg/m^3]; None for those of the material.
    """

    size_mm: tuple[float, float, float] | None
    surface: Path | None
    like: Path | None
    element_mm: float | None
    youngs_modulus: float | None
    density: float | None

    def read(self, name: str, folder: Path) -> Body:
        """The description of a specimen of this name, for a file in `folder`."""
        if self.like is not None:
            body = body_like(name, self.like, folder)
        elif self.surface is not None:
            body = body_of_surface(name, self.surface, self.element_mm, folder)
        else:
            assert self.size_mm is not None
            body = body_of_box(name, self.size_mm, self.element_mm)
        given = {"youngs_modulus": self.youngs_modulus, "density": self.density}
        return body.with_material(**{key: value for key, value in given.items() if value is not None})


def describe_specimen(still: Path, given: SpecimenBody, lying: bool, unit: str | None, out: Path) -> None:
    """Describe a specimen from a recording of it at rest; write specimen.yaml and a picture.

    Args:
        still: the recording.
        given: the body.
        lying: whether the specimen lies flat.
        unit: of positions in a table that does not name it.
        out: specimen.yaml to write.

    Raises:
        InputError: a file cannot be read, or the dots are not on the body.
    """
    torch.set_num_threads(1)
    announce_compilation()
    body = given.read(specimen_name(out), out.parent)
    for hint in unit_hints(body.material.youngs_modulus, body.material.density):
        typer.echo(f"warning: {hint}", err=True)
    recording = read_recording(still, UNUSED_FPS, unit)
    try:
        sigma = MODULUS_SIGMA if given.youngs_modulus is None else MEASURED_SIGMA
        found = describe(recording, body, out.parent, lying, str(still), sigma)
    except SimulationError as error:
        raise InputError(f"the body cannot bear its own weight: {error}; check its size and --youngs-modulus") from None
    with written_files(specimen_files(found, body, still.name, out, bool(given.density))):
        pass
    for line in description_warnings(found):
        typer.echo(f"warning: {line}", err=True)
    typer.echo(description_summary(found))
    if note := uncertain_sag(found, lying):
        typer.echo(f"note: {note} (--lying, --youngs-modulus)")
    typer.echo(f"wrote {out} and {out.with_suffix('.png')}")
    typer.echo(next_command("rafl-track", "videos/", "--calib", "calib.yaml", "--specimen", out))


def stencil(size_mm: tuple[float, float, float], dot_mm: float, out: Path) -> None:
    """Draw a layout of dots for a box to scale (PDF), and write the specimen file that fits it.

    Raises:
        InputError: the box is too small for dots of this diameter [mm].
    """
    layout = design_stencil(size_mm, dot_mm)
    description = out.with_suffix(".yaml")
    body = body_of_box(specimen_name(out), size_mm, None)
    remarks = {
        "": f"Dots of {out.name}, drawn by rafl-specimen.",
        "material": "To check: all of it is assumed.",
        "clamp": "To check: the face that is held, and the face on which loads hang.",
    }
    entries = [item.model_dump(exclude_unset=True, mode="json") for item in layout.markers]
    with written_files({out: stencil_pdf(layout), description: specimen_text(body, entries, remarks)}):
        pass
    count = sum(len(item.markers()) for item in layout.markers)
    typer.echo(f"wrote {out} ({count} dots of {dot_mm:g} mm) and {description}")
    typer.echo("next: print at 100 %, measure the scale bar, put the dots on the specimen, and film it")


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
    with written_files({report: dataset_page(described, dataset)}):
        (update_dataset if update else write_dataset)(path, dataset)
    console = Console(width=130)
    console.print(recordings_table(dataset))
    if cameras := cameras_table(dataset):
        console.print(cameras)
    whole = read_dataset(path) if update else dataset
    for line in dict.fromkeys([*warnings(dataset), *missing_pixels(whole)]):
        typer.echo(f"warning: {line}", err=True)
    typer.echo(f"wrote {path} and {report}")
    typer.echo(next_command("rafl-fit", path))


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
            material = specimen.material
            advice = "; ".join(unit_hints(material.youngs_modulus, material.density)) or CHECK_FIRST_FRAME
            raise InputError(f"no first frame of the body as described could be simulated: {error}. {advice}") from None


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
