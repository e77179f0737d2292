"""The commands `rafl-calibrate` and `rafl-track`: their options, and the checks that need no heavy import."""

import os
from pathlib import Path
from typing import Annotated

import typer

from rafl.batch.options import Batch, ClusterOption, OnOption, PrintOption, StatusOption, Where
from rafl.common.command_line import create_app, report_errors
from rafl.common.errors import InputError
from rafl.common.files import require_file, require_folder
from rafl.common.units import Unit

CAMERA_MODELS = ("orthographic", "pinhole")
EXPORT_FORMATS = ("csv", "c3d", "trc", "npy")
CALIBRATION_LABEL = "a calibration (calib.yaml, written by rafl-calibrate, or one of another program)"
SPECIMEN_LABEL = "a specimen description (specimen.yaml)"

CalibUnit = Annotated[
    Unit | None, typer.Option(help="Unit of the lengths in a calibration of another program that does not state it.")
]

calibrate_app = create_app("Calibrate cameras.")
track_app = create_app("Track markers in videos.")


@calibrate_app.command()
@report_errors
def calibrate(
    images: Annotated[Path | None, typer.Argument(help="Folder with one subfolder of board images per camera.")] = None,
    board: Annotated[Path | None, typer.Option(help="Board description [IMAGES/board.yaml].")] = None,
    from_rest: Annotated[
        Path | None,
        typer.Option(help="Instead of IMAGES: folder with one video per camera of the specimen at rest."),
    ] = None,
    specimen: Annotated[
        Path | None, typer.Option(help="With --from-rest: specimen.yaml with the marker positions.")
    ] = None,
    face: Annotated[
        list[str] | None,
        typer.Option(help="With --from-rest: the face of the specimen that a camera films, for instance left=y-min."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Calibration to write.")] = Path("calib.yaml"),
    model: Annotated[str, typer.Option(help="Camera model: orthographic or pinhole.")] = "orthographic",
    tilt_sign: Annotated[
        list[str] | None,
        typer.Option(
            help="Only if asked for: CAMERA=+ if the right (or lower) edge of its reference board is farther away, "
            "else CAMERA=-."
        ),
    ] = None,
    depth_mm: Annotated[
        float, typer.Option(min=0.0, help="Depth of the specimen [mm], for the perspective warning.")
    ] = 30.0,
    check: Annotated[
        Path | None, typer.Option(help="Check this calibration against the images instead of calibrating.")
    ] = None,
    calib: Annotated[
        Path | None,
        typer.Option(help="With --from-rest: place this calibration on the specimen, instead of calibrating."),
    ] = None,
    calib_unit: CalibUnit = None,
) -> None:
    """Calibrate the cameras from images of a ChArUco board, a chessboard or a dot grid, or of a specimen at rest.

    Example: rafl-calibrate calibration-images/ --out calib.yaml

    Example without a board: rafl-calibrate --from-rest rest/ --specimen specimen.yaml --face left=y-min

    With --calib CALIB as well, a calibration of another program is placed in the specimen frame.

    With --check CALIB, nothing is calibrated. The command tests CALIB on images that it was not made from.
    """
    if model not in CAMERA_MODELS:
        raise InputError(f"--model: expected {' or '.join(CAMERA_MODELS)}, found {model!r}")
    if (images is None) == (from_rest is None):
        raise InputError("expected a folder of board images, or --from-rest and a folder of videos; give one of them")
    if from_rest is not None:
        if board or check or model != "orthographic":
            raise InputError("--from-rest: expected neither --board, --check nor --model pinhole; leave them out")
        if specimen is None:
            raise InputError("--from-rest: expected --specimen specimen.yaml, which gives the marker positions")
        require_folder(from_rest, "a folder with one video per camera")
        require_file(specimen, SPECIMEN_LABEL)
        if calib is not None:
            if tilt_sign:
                raise InputError("--calib: expected no --tilt-sign, which perspective tells; leave it out")
            _check_calibration(calib)
        elif calib_unit:
            raise InputError("expected --calib-unit with --calib or --check only; leave it out")
        from rafl.tracking import calibration_commands

        if calib is not None:
            calibration_commands.place_calibration(calib, calib_unit, from_rest, specimen, face or [], out)
        else:
            calibration_commands.calibrate_from_rest(from_rest, specimen, face or [], tilt_sign or [], out)
        return
    assert images is not None
    if specimen or face or calib:
        raise InputError("expected --specimen, --face and --calib with --from-rest only; leave them out")
    require_folder(images, "a folder of board images")
    board = require_file(board or images / "board.yaml", "a board description (board.yaml)")
    if check is not None:
        _check_calibration(check)
    elif calib_unit:
        raise InputError("expected --calib-unit with --calib or --check only; leave it out")
    from rafl.tracking import calibration_commands

    if check is not None:
        calibration_commands.check_calibration(check, calib_unit, images, board)
    else:
        calibration_commands.calibrate(images, board, model, tilt_sign or [], 1e-3 * depth_mm, out)


def _check_calibration(path: Path) -> None:
    """Refuse a calibration that is not there."""
    if not path.is_dir():  # a folder holds one camera a file
        require_file(path, CALIBRATION_LABEL)


@track_app.command()
@report_errors
def track(
    videos: Annotated[Path, typer.Argument(help="Folder of videos (or of image folders), or one video.")],
    calib: Annotated[
        Path,
        typer.Option(
            help="Calibration: calib.yaml, or one of OpenCV, aniposelib, Caliscope, MATLAB or DLT coefficients."
        ),
    ],
    calib_unit: CalibUnit = None,
    specimen: Annotated[
        Path | None, typer.Option(help="specimen.yaml, which names the markers [row and column].")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the tracks.")] = Path("tracks"),
    fps: Annotated[float | None, typer.Option(min=0.1, help="True frame rate [1/s] [as in the video file].")] = None,
    fill: Annotated[int, typer.Option(min=0, help="Longest gap to fill [frames].")] = 5,
    sync: Annotated[bool, typer.Option("--sync", help="Find the time offsets of the cameras from the motion.")] = False,
    export: Annotated[str, typer.Option(help="Also export the tracks: csv, c3d, trc, npy, separated by commas.")] = "",
    overlay: Annotated[
        bool, typer.Option("--overlay", help="Also write videos with the markers and their names drawn in.")
    ] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Recordings tracked at the same time [number of cores].")
    ] = None,
    recording: Annotated[
        list[str] | None, typer.Option(help="Only this recording, without a report; can be given several times.")
    ] = None,
    on: OnOption = None,
    cluster: ClusterOption = None,
    print_commands: PrintOption = False,
    status: StatusOption = False,
) -> None:
    """Track the markers of every recording: find, follow and name them, and reconstruct their 3-D positions.

    A recording is not tracked again if its videos, calibration and settings are unchanged. Without --specimen, the
    tracks of a recording at rest are what `rafl-specimen` describes the specimen from.

    Example: rafl-track videos/ --calib calib.yaml --specimen specimen.yaml
    """
    given = dict(locals())
    exports = [kind.strip().lower() for kind in export.split(",") if kind.strip()]
    for kind in exports:
        if kind not in EXPORT_FORMATS:
            raise InputError(f"--export: expected some of {', '.join(EXPORT_FORMATS)}, found {kind!r}")
    if not videos.exists():
        raise InputError(f"expected videos at {videos}, found nothing there; check the path")
    _check_calibration(calib)
    if specimen is not None:
        require_file(specimen, SPECIMEN_LABEL)
    how = Batch.of(on, (jobs or os.cpu_count()) if on == Where.local else jobs, cluster, print_commands, status)
    if how.apart:
        from rafl.tracking import unit_commands

        unit_commands.track(given, how)
        return
    from rafl.tracking import commands

    only = recording or []
    commands.track(videos, calib, calib_unit, specimen, out, fps, fill, sync, exports, overlay, jobs, only)
