"""What `rafl-review` can show, told by the path."""

from pathlib import Path

from rafl.common.errors import InputError
from rafl.common.files import require_file, require_folder

CALIBRATION_SUFFIXES = (".yaml", ".yml")
RUN_FILES = ("model.pt", "evaluation.h5")  # by which a run folder is told from a folder of tracks
TRACKS, CALIBRATION, RESULTS = "a folder of tracks", "a calibration (calib.yaml)", "a run folder or a dataset (.h5)"


def kind_of(path: Path) -> str:
    """What is at a path: `TRACKS`, `CALIBRATION` or `RESULTS`.

    Raises:
        InputError: nothing that can be shown.
    """
    if path.suffix.lower() in CALIBRATION_SUFFIXES and not path.is_dir():
        require_file(path, "a calibration (calib.yaml, written by rafl-calibrate)")
        return CALIBRATION
    if path.suffix == ".h5" and not path.is_dir():
        require_file(path, "a dataset (.h5, written by rafl-capture)")
        return RESULTS
    require_folder(path, "a folder of tracks, a run folder, a calibration (calib.yaml) or a dataset (.h5)")
    return RESULTS if any((path / file).exists() for file in RUN_FILES) else TRACKS


def check_options(path: Path, given: dict[str, tuple[object, str]]) -> str:
    """The kind of a path, for which all options that are given must be meant.

    given: by option, its value, None if it was left out, and the kind that it is meant for.

    Raises:
        InputError: an option is meant for another kind, or there is nothing that can be shown.
    """
    kind = kind_of(path)
    for option, (value, own) in given.items():
        if value is not None and kind != own:
            raise InputError(f"{option}: expected {own} beside it, found {path}, {kind}; leave the option out")
    return kind
