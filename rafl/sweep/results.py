"""One table from the evaluations of a sweep."""

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from rafl.common.errors import InputError
from rafl.common.text_tables import cell_text
from rafl.sweep.cells import Cell

BASELINE = "original"
CELL_COLUMNS = ["trained_on", "method", "seed", "dataset", "split", "recordings", "error_mm"]
GROUP = ["trained_on", "method", "dataset", "split"]


def gather(cells: Iterable[Cell]) -> pd.DataFrame:
    """Errors of all models, one row for every cell and split; those of the baseline simulator once for a dataset.

    Columns: trained_on, method, seed, dataset, split, recordings, and error_mm, the mean over recordings of the mean
    marker error [mm]. The baseline's method is `original`; its trained_on and seed are empty, and so is the seed of a
    method without one.

    Raises:
        InputError: a table is missing or is none that rafl-eval wrote.
    """
    rows: dict[tuple[str, ...], list[object]] = {}
    for cell in cells:
        for (method, split), errors in _read_errors(cell.folder / "errors.csv").groupby(
            ["method", "split"], sort=False
        ):
            own = method != BASELINE
            trained_on, seed = (cell.trained_on, "" if cell.seed is None else str(cell.seed)) if own else ("", "")
            label = cell.method if own else BASELINE
            key = (trained_on, label, seed, cell.dataset, str(split))
            rows.setdefault(key, [*key, len(errors), float(errors["mean_mm"].mean())])
    return pd.DataFrame(list(rows.values()), columns=CELL_COLUMNS)


def _read_errors(path: Path) -> pd.DataFrame:
    """`errors.csv` of one evaluation."""
    try:
        table = pd.read_csv(path, keep_default_na=False)
        table["mean_mm"] = table["mean_mm"].astype(float)
        table["method"], table["split"] = (table[key].astype(str).map(cell_text) for key in ("method", "split"))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"expected a table of errors (written by rafl-eval) in {path}, found: {error!s:.120}; remove it, and run "
            "the sweep again"
        ) from None
    return table


def summarise(errors: pd.DataFrame) -> pd.DataFrame:
    """Mean over seeds of the errors that `gather` returns.

    Columns: trained_on, method, dataset, split, recordings, seeds, mean_mm, and std_mm, the standard deviation over
    seeds, NaN for one.
    """
    grouped = errors.groupby(GROUP, sort=False)
    return grouped.agg(
        recordings=("recordings", "first"),
        seeds=("error_mm", "size"),
        mean_mm=("error_mm", "mean"),
        std_mm=("error_mm", "std"),
    ).reset_index()


def by_method(summary: pd.DataFrame) -> pd.DataFrame:
    """Mean over training sets and datasets of a summary: columns method, split, cells, mean_mm."""
    grouped = summary.groupby(["method", "split"], sort=False)
    return grouped.agg(cells=("mean_mm", "size"), mean_mm=("mean_mm", "mean")).reset_index()
