"""The commands `rafl-render`, `rafl-specimen` and `rafl-capture`: options, and checks that need no heavy import."""

import math
import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rafl.batch.options import Batch, ClusterOption, OnOption, PrintOption, StatusOption
from rafl.common.command_line import create_app, report_errors
from rafl.common.errors import InputError
from rafl.common.files import require_file
from rafl.common.units import Unit

SPECIMEN = "a specimen description (specimen.yaml)"

render_app = create_app("Render videos of simulated specimens.")
specimen_app = create_app("Describe specimens.")
capture_app = create_app("Build datasets.")


class Background(StrEnum):
    """What is behind the specimen."""

    plain = "plain"
    clutter = "clutter"


class SideCamera(StrEnum):
    """A camera that faces a side of the specimen."""

    left = "left"
    right = "right"


class Codec(StrEnum):
    """How videos are encoded."""

    h264 = "h264"
    ffv1 = "ffv1"
    mjpeg = "mjpeg"


@render_app.command()
@report_errors
def render(
    specimen: Annotated[Path, typer.Argument(help="Specimen description (specimen.yaml).")],
    out: Annotated[Path, typer.Option(help="Folder to write; new or empty.")],
    loads_g: Annotated[
        str, typer.Option(help="Tip loads to release [g], separated by commas.")
    ] = "60,90,120,70,150,100",
    twists_deg: Annotated[str, typer.Option(help="Tip twists to release [degrees], separated by commas.")] = "",
    frames: Annotated[int, typer.Option(min=2, help="Frames per recording.")] = 100,
    fps: Annotated[float, typer.Option(min=1.0, help="Frames per second.")] = 100.0,
    youngs_modulus: Annotated[float, typer.Option(min=1.0, help="True Young's modulus [Pa].")] = 264e3,
    poissons_ratio: Annotated[float, typer.Option(min=0.0, max=0.4999, help="True Poisson's ratio.")] = 0.499,
    dot_mm: Annotated[float, typer.Option(min=0.1, help="Diameter of the dots [mm].")] = 3.0,
    blur_px: Annotated[float, typer.Option(min=0.0, help="Sigma of the lens blur [px].")] = 0.8,
    exposure: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Exposure time as a fraction of the frame time.")
    ] = 0.2,
    noise: Annotated[float, typer.Option(min=0.0, help="Sigma of the sensor noise [grey levels].")] = 2.0,
    background: Annotated[Background, typer.Option(help="Background behind the specimen.")] = Background.plain,
    camera: Annotated[
        list[SideCamera] | None,
        typer.Option(
            help="Only this camera films; left faces the side of least y. [default: both]", show_default=False
        ),
    ] = None,
    codec: Annotated[Codec, typer.Option(help="Video encoding.")] = Codec.h264,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of noise and camera misalignment.")] = 0,
) -> None:
    """Simulate a specimen of a chosen true material and render videos of it from two cameras, or from one.

    Writes videos/, calibration/ (board images), recordings.csv and truth.h5.

    Example: rafl-render datasets/specimens/canonical.yaml --out demo
    """
    require_file(specimen, SPECIMEN)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"expected a new or empty folder at {out}, found files in it; choose another --out")
    loads, twists = _numbers(loads_g, "--loads-g", 0.0), _numbers(twists_deg, "--twists-deg", -math.inf)
    if not loads and not twists:
        raise InputError("expected at least one recording, found none; give --loads-g or --twists-deg")
    from rafl.capture import commands

    material = commands.TrueMaterial(youngs_modulus, poissons_ratio)
    cameras = sorted({each.value for each in camera or SideCamera})
    appearance = commands.create_appearance(dot_mm, blur_px, exposure, noise, background.value)
    commands.render(specimen, out, loads, twists, frames, fps, material, appearance, cameras, codec.value, seed)


def _numbers(text: str, option: str, low: float) -> list[float]:
    """The finite numbers of a text, of at least `low`."""
    try:
        numbers = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise InputError(f"{option}: expected numbers separated by commas, found {text!r}") from None
    for number in numbers:
        if not math.isfinite(number) or number < low:
            least = f" of at least {low:g}" if math.isfinite(low) else ""
            raise InputError(f"{option}: expected finite numbers{least}, found {number:g}")
    return numbers


class Initial(StrEnum):
    """State of the specimen in the first frame, and how it is fitted."""

    auto = "auto"
    rest = "rest"
    moving = "moving"
    sequence = "sequence"


class Forces(StrEnum):
    """Where the virtual forces act."""

    tip = "tip"
    surface = "surface"


@specimen_app.command()
@report_errors
def specimen(
    still: Annotated[
        Path | None,
        typer.Argument(help="Tracks (.h5), motion capture (.c3d, .trc, .tsv, .csv) or points of the specimen at rest."),
    ] = None,
    box: Annotated[str, typer.Option(help="Size of a box along x, y and z [mm], for instance 100x30x30.")] = "",
    surface: Annotated[
        Path | None, typer.Option(help="Instead: closed surface (.stl, .obj, .ply) in mm, in the specimen frame.")
    ] = None,
    like: Annotated[
        Path | None,
        typer.Option(help="Instead: a specimen.yaml whose body and material are taken, without its markers."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File to write [specimen.yaml; with --stencil, stencil.pdf].")
    ] = None,
    youngs_modulus: Annotated[
        float | None,
        typer.Option(min=1.0, help="Young's modulus [Pa], if measured to about 10 % [assumed]."),
    ] = None,
    density: Annotated[
        float | None, typer.Option(min=1.0, help="Density [kg/m3], if measured: mass by volume [assumed].")
    ] = None,
    lying: Annotated[
        bool, typer.Option("--lying", help="The specimen lies flat, so that gravity does not bend it.")
    ] = False,
    element_mm: Annotated[
        float | None, typer.Option(min=0.01, help="Edge of the elements [mm] [10, or less for a thin body].")
    ] = None,
    unit: Annotated[Unit | None, typer.Option(help="Unit of positions in a table that does not name it.")] = None,
    stencil: Annotated[
        bool, typer.Option("--stencil", help="Instead: draw a layout of dots for a box, to print and cut (PDF).")
    ] = False,
    dot_mm: Annotated[float, typer.Option(min=0.1, help="With --stencil: diameter of the dots [mm].")] = 3.0,
) -> None:
    """Describe a specimen from a recording of it at rest: name its dots and find their places on the undeformed body.

    Writes specimen.yaml and a picture beside it. Nothing but its own weight may bend the specimen.

    Example: rafl-specimen tracks/still.h5 --box 100x30x30 --out specimen.yaml

    Example before there is a specimen: rafl-specimen --stencil --box 100x30x30 --out stencil.pdf
    """
    if sum((bool(box), surface is not None, like is not None)) != 1:
        raise InputError("expected one of --box, --surface and --like, which describe the body; give one of them")
    if stencil == (still is not None):
        raise InputError("expected a recording of the specimen at rest, or --stencil; give one of them")
    size = _box(box) if box else None
    out = out or Path("stencil.pdf" if stencil else "specimen.yaml")
    suffixes = (".pdf",) if stencil else (".yaml", ".yml")
    if out.suffix.lower() not in suffixes:
        raise InputError(f"--out: expected a file that ends with {' or '.join(suffixes)}, found {out}")
    for path in (out, out.with_suffix(".yaml" if stencil else ".png")):
        if path.exists():
            raise InputError(f"expected no file yet at {path}, found one; choose another --out")
    if stencil:
        if size is None:
            raise InputError("--stencil: expected --box, found another body; draw its dots in the program of its shape")
        from rafl.capture import commands

        commands.stencil(size, dot_mm, out)
        return
    assert still is not None
    require_file(still, "a recording of the specimen at rest (.h5, .c3d, .csv, .trc, .tsv, .npy)")
    if surface is not None:
        require_file(surface, "a surface (.stl, .obj or .ply)")
    if like is not None:
        require_file(like, SPECIMEN)
        if element_mm is not None:
            raise InputError(
                "--element-mm: expected --box or --surface, found --like, which has elements; leave it out"
            )
    from rafl.capture import commands

    body = commands.SpecimenBody(size, surface, like, element_mm, youngs_modulus, density)
    commands.describe_specimen(still, body, lying, unit and unit.value, out)


def _box(text: str) -> tuple[float, float, float]:
    """The sides of `--box` [mm]."""
    try:
        x, y, z = (float(part) for part in text.lower().split("x"))
    except ValueError:
        raise InputError(f"--box: expected three lengths in mm such as 100x30x30, found {text!r}") from None
    if not all(0.0 < side < float("inf") for side in (x, y, z)):
        raise InputError(f"--box: expected lengths above 0 mm, found {text!r}")
    return x, y, z


@capture_app.command()
@report_errors
def capture(
    specimen: Annotated[Path | None, typer.Argument(help="Specimen description (specimen.yaml).")] = None,
    tracks: Annotated[
        Path | None,
        typer.Argument(help="Folder of tracks (.h5), motion capture (.c3d, .trc, .tsv, .csv) or q0.npy, q1.npy, ..."),
    ] = None,
    recordings: Annotated[Path | None, typer.Option(help="Table of recordings: recording,load_g,split.")] = None,
    out: Annotated[Path | None, typer.Option(help="Dataset to write [datasets/SPECIMEN.h5].")] = None,
    update: Annotated[
        bool, typer.Option("--update", help="Add recordings to the dataset there, or replace them.")
    ] = False,
    tolerance_mm: Annotated[
        float, typer.Option(min=0.0, help="Largest distance of a marker from the skin of the mesh [mm].")
    ] = 2.0,
    fit_tolerance_mm: Annotated[float, typer.Option(min=0.0, help="Largest residual of the registration [mm].")] = 3.0,
    rest: Annotated[
        str | None,
        typer.Option(help="Recording of the undeformed specimen: RECORDING, or RECORDING:FIRST-LAST (frames)."),
    ] = None,
    refine_cameras: Annotated[
        bool,
        typer.Option(
            "--refine-cameras", help="Find how cameras moved, and how late their clocks are, since their calibration."
        ),
    ] = False,
    moving_clamp: Annotated[bool, typer.Option(help="Follow the clamp's markers, if there are any.")] = True,
    start: Annotated[
        int | None, typer.Option(min=0, help="First frame of the motion [found from the motion of each recording].")
    ] = None,
    initial: Annotated[
        Initial,
        typer.Option(
            help="First frame: at rest or moving, as each recording shows (auto); at rest; moving; or at rest, fitted "
            "by the slower method of earlier work (sequence)."
        ),
    ] = Initial.auto,
    forces: Annotated[Forces, typer.Option(help="Where the virtual forces of the first frame act.")] = Forces.tip,
    fps: Annotated[
        float, typer.Option(min=0.1, help="Frames per second of files that do not name it (npy, DLTdv, ...).")
    ] = 100.0,
    unit: Annotated[
        Unit | None, typer.Option(help="Unit of positions in tables that do not name it (DLTdv, anipose, DeepLabCut).")
    ] = None,
    names: Annotated[
        Path | None, typer.Option(help="Table file,specimen of marker names in the files and in the specimen.")
    ] = None,
    inspect: Annotated[Path | None, typer.Option(help="Only print the contents of a dataset.")] = None,
    verify: Annotated[Path | None, typer.Option(help="Only compare a dataset with its stored hashes.")] = None,
    on: OnOption = None,
    cluster: ClusterOption = None,
    print_commands: PrintOption = False,
    status: StatusOption = False,
) -> None:
    """Register recordings to the specimen, embed the markers in its mesh, and fit the first frame of each recording.

    Example: rafl-capture specimen.yaml tracks/ --recordings recordings.csv
    """
    given = dict(locals())
    if inspect is not None or verify is not None:
        for path in (inspect, verify):
            if path is not None:
                require_file(path, "a dataset (.h5, written by rafl-capture)")
        from rafl.capture import commands

        commands.inspect(inspect, verify)
        return
    if specimen is None or tracks is None or recordings is None:
        raise InputError(
            "expected a specimen, a folder of tracks and --recordings, found fewer; for instance "
            "rafl-capture specimen.yaml tracks/ --recordings recordings.csv"
        )
    require_file(specimen, SPECIMEN)
    require_file(recordings, "a table of recordings (recordings.csv)")
    if out is not None and out.suffix != ".h5":
        raise InputError(f"--out: expected the name of a dataset that ends with .h5, found {out}")
    rest_frames = None if rest is None else _rest_frames(rest)
    how = Batch.of(on, None, cluster, print_commands, status)
    if how.apart:
        from rafl.capture import unit_commands

        unit_commands.capture(given, how)
        return
    from rafl.capture import commands

    settings = commands.CaptureSettings(
        1e-3 * tolerance_mm,
        1e-3 * fit_tolerance_mm,
        fps,
        rest_frames and commands.RestPose(*rest_frames),
        moving_clamp,
        start,
        initial.value,
        forces.value,
        unit and unit.value,
        refine_cameras,
        {} if names is None else commands.read_marker_names(names),
    )
    commands.capture(specimen, tracks, recordings, out, update, settings)


def _rest_frames(text: str) -> tuple[str, int | None, int | None]:
    """Recording, first and last frame of `--rest`; no frames for the whole recording."""
    found = re.fullmatch(r"(?P<recording>[^:]+)(:(?P<first>\d+)(-(?P<last>\d+))?)?", text)
    if found is None:
        raise InputError(
            f"--rest: expected RECORDING, RECORDING:FRAME or RECORDING:FIRST-LAST, found {text!r}; for instance "
            "straight:12-40"
        )
    first, last = (None if found[key] is None else int(found[key]) for key in ("first", "last"))
    return found["recording"], first, first if last is None else last
