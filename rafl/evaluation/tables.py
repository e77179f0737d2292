"""The tables of the results page: errors by split, transfer, oscillation, and errors by recording."""

from typing import Any

import numpy as np
import pandas as pd

from rafl.evaluation.metrics import BASELINE, Comparison, Transfer, error_table, motion_table, split_table

Cell = dict[str, Any]


def page_tables(comparisons: list[Comparison]) -> list[dict[str, Any]]:
    """Tables for the page, each with title, note, columns and rows.

    A row has `cells`, each with `text` and `style` (words among better, best, worse), and in the table of recordings
    `recording`, its number.
    """
    splits = split_table(comparisons)
    methods = list(dict.fromkeys(splits["method"]))
    return [
        {
            "title": "Error of simulated markers",
            "note": "Mean distance between simulated and recorded markers in mm, \N{PLUS-MINUS SIGN} the standard "
            f"deviation over frames. {BASELINE} is the baseline simulator. Underlined: better than the baseline. "
            "Bold: best of the row.",
            "columns": ["dataset", "split", "recordings", *methods],
            "rows": _error_rows(splits, ["dataset", "split", "recordings"], methods),
        },
        *_transfer_table(Transfer.of(splits)),
        _motion_table(motion_table(comparisons)),
        {
            "title": "Error of each recording",
            "note": "Mean distance between simulated and recorded markers in mm, \N{PLUS-MINUS SIGN} the standard "
            "deviation over frames. A click shows the recording.",
            "columns": ["dataset", "recording", "split", *methods],
            "rows": [
                {**row, "recording": number}
                for number, row in enumerate(
                    _error_rows(error_table(comparisons), ["dataset", "recording", "split"], methods)
                )
            ],
        },
    ]


def _cell(text: object, style: str = "") -> Cell:
    return {"text": str(text), "style": style}


def _error_cells(methods: list[str], means: dict[str, float], stds: dict[str, float]) -> list[Cell]:
    best = min(means.values())
    cells = []
    for method in methods:
        if method not in means:
            cells.append(_cell("N/A"))
            continue
        styles = {
            "better": method != BASELINE and means[method] < means[BASELINE],
            "best": means[method] == best,
        }
        text = f"{means[method]:.3f} \N{PLUS-MINUS SIGN} {stds[method]:.3f}"
        cells.append(_cell(text, " ".join(name for name, holds in styles.items() if holds)))
    return cells


def _error_rows(table: pd.DataFrame, keys: list[str], methods: list[str]) -> list[dict[str, Any]]:
    rows = []
    for values, group in table.groupby(keys, sort=False):
        means = dict(zip(group["method"], group["mean_mm"], strict=True))
        stds = dict(zip(group["method"], group["std_mm"], strict=True))
        rows.append({"cells": [*map(_cell, values), *_error_cells(methods, means, stds)]})
    return rows


def _transfer_table(transfer: Transfer) -> list[dict[str, Any]]:
    """The table of transfer, if there are several datasets."""
    if transfer.errors.shape[1] < 2:
        return []
    baseline = transfer.errors.loc[BASELINE]
    rows = []
    for method, errors in transfer.errors.iterrows():
        cells = [
            _cell(
                f"{errors[name]:.3f}" if np.isfinite(errors[name]) else "N/A",
                "worse" if errors[name] > baseline[name] else "",
            )
            for name in errors.index
        ]
        rows.append({"cells": [_cell(method), *cells, _cell(transfer.negative_transfers.get(str(method), ""))]})
    return [
        {
            "title": "Transfer",
            "note": "Mean error in mm; one row per model, one column per dataset. "
            "Red: worse than the baseline simulator.",
            "columns": ["model", *map(str, transfer.errors.columns), "negative transfers"],
            "rows": rows,
        }
    ]


def _motion_table(motions: pd.DataFrame) -> dict[str, Any]:
    rows = []
    for row in motions[motions["split"] == "test"].to_dict("records") or motions.to_dict("records"):
        numbers = [
            f"{row[key]:.{digits}f}" if np.isfinite(row[key]) else "-"
            for key, digits in (("frequency_hz", 2), ("damping_ratio", 3), ("final_error_mm", 3))
        ]
        final = numbers[2] if row["method"] != "recorded" else ""
        cells = [row["dataset"], row["recording"], row["method"], *numbers[:2], final]
        rows.append({"cells": [*map(_cell, cells)]})
    return {
        "title": "Frequency, damping, rest position",
        "note": "Frequency and damping of the coordinate with the largest range of motion. A dash means that its "
        "motion is not a damped oscillation. Final error: mean distance between the simulated and recorded rest "
        "positions of all markers, in the image for those that a single camera saw. A rest position is the mean over "
        "the last tenth of the recording.",
        "columns": ["dataset", "recording", "method", "frequency [Hz]", "damping ratio", "final error [mm]"],
        "rows": rows,
    }
