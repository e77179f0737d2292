"""The datasets and the folders of specimens that a plan names."""

import glob
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from rafl.common.errors import InputError
from rafl.common.names import check_names
from rafl.sweep.plan import LABEL, Plan

PARTS = ("specimen.yaml", "recordings.csv", "tracks")  # of a specimen's folder


def find_datasets(plan: Plan, path: Path) -> dict[str, str]:
    """The dataset files of a plan at `path`, by their names without ending.

    Raises:
        InputError: a file or pattern finds nothing, or two files share a name.
    """
    found = _find(plan.datasets, path, "datasets", "a dataset", os.path.isfile)
    return _by_name([Path(name).stem for name in found], found, path, "datasets")


def find_specimens(plan: Plan, path: Path) -> dict[str, str]:
    """The folders of specimens of a plan at `path`, by their names.

    Raises:
        InputError: a folder or pattern finds nothing, a folder lacks a part, or two share a name.
    """
    found = _find(plan.specimens, path, "specimens", "the folder of a specimen", os.path.isdir)
    for folder in found:
        if absent := [part for part in PARTS if not os.path.exists(os.path.join(folder, part))]:
            raise InputError(
                f"{LABEL} {path}: specimens: expected {', '.join(PARTS)} in {folder}, found no {absent[0]}; add it"
            )
    return _by_name([Path(name).name for name in found], found, path, "specimens")


def _find(entries: Sequence[str], path: Path, key: str, label: str, fits: Callable[[str], bool]) -> list[str]:
    """Paths that fit, of entries that are paths or patterns."""
    found: list[str] = []
    for entry in entries:
        pattern = str(path.parent / entry)
        is_pattern = glob.has_magic(entry) and not os.path.exists(pattern)
        matching = sorted(glob.glob(str(Path(glob.escape(str(path.parent))) / entry))) if is_pattern else [pattern]
        chosen = [name for name in matching if fits(name)]
        if not chosen:
            raise InputError(f"{LABEL} {path}: {key}: expected {label} at {pattern}, found nothing; correct it")
        found += [name for name in chosen if name not in found]
    return found


def _by_name(names: Sequence[str], paths: Sequence[str], source: Path, key: str) -> dict[str, str]:
    try:
        check_names(names)
    except ValueError as error:
        raise InputError(f"{LABEL} {source}: {key}: {error}; rename one") from None
    return dict(zip(names, paths, strict=True))
