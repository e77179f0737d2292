"""`report.html` of an evaluation: one file with its tables and plots inside."""

from itertools import cycle
from pathlib import Path

import jinja2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from rafl.common.files import write_text
from rafl.evaluation.figures import bodies, forces, png
from rafl.evaluation.metrics import ORIGINAL, Comparison, Transfer
from rafl.evaluation.oscillation import liveliest

COLOURS = ["#c0392b", "#1f6fb2", "#2e8b57", "#8e44ad", "#d68910"]
MOST_PLOTS = 8

PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Evaluation</title>
<style>
 body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222}
 table{border-collapse:collapse;margin:1rem 0}
 th,td{padding:.25rem .8rem;text-align:right;border-bottom:1px solid #ddd}
 td:nth-child(-n+2),th:nth-child(-n+2){text-align:left}
 .worse{color:#c0392b}.better{text-decoration:underline}.best{font-weight:bold}
 img{max-width:100%} .note{color:#666}
</style>
<h1>Simulated against recorded markers</h1>
<p>Mean distance between simulated and recorded markers in mm, &plusmn; the standard deviation over frames.
Underlined: better than the original simulator. Bold: the best of its row.</p>
<table><tr><th>dataset</th><th>split</th><th>recordings</th>
{% for m in methods %}<th>{{ m }}</th>{% endfor %}</tr>
{% for row in splits %}<tr><td>{{ row.dataset }}</td><td>{{ row.split }}</td><td>{{ row.recordings }}</td>
{% for cell in row.cells %}<td class="{{ cell.style }}">{{ cell.text }}</td>{% endfor %}</tr>
{% endfor %}</table>
{% if transfer %}<h2>Transfer</h2>
<p class="note">Mean error in mm, a row a model, a column a dataset. Red: worse than the untouched simulator.</p>
<table><tr><th>model</th>{% for name in transfer.datasets %}<th>{{ name }}</th>{% endfor %}
<th>negative transfers</th></tr>
{% for row in transfer.rows %}<tr><td>{{ row.method }}</td>
{% for cell in row.cells %}<td class="{{ cell.style }}">{{ cell.text }}</td>{% endfor %}<td>{{ row.negative }}</td></tr>
{% endfor %}</table>{% endif %}
<h2>Error over time</h2>
{% for image in error_plots %}<img alt="error over time" src="data:image/png;base64,{{ image }}">{% endfor %}
<h2>Marker trajectories</h2>
<p class="note">The marker that moves most, along the axis it moves most. Black: recorded.
{% if left_out %}{{ left_out }} further recordings are in errors.csv only.{% endif %}</p>
{% for image in marker_plots %}<img alt="trajectory" src="data:image/png;base64,{{ image }}">{% endfor %}
<h2>First and last frame</h2>
<p class="note">The first recording of each dataset; red: recorded markers.</p>
{% for image in bodies %}<img alt="bodies in 3-D" src="data:image/png;base64,{{ image }}">{% endfor %}
{% if forces %}<h2>Where the residual forces act</h2>
<p class="note">Mean size at every vertex, over all frames and recordings.</p>
{% for image in forces %}<img alt="residual forces" src="data:image/png;base64,{{ image }}">{% endfor %}{% endif %}
<h2>Frequency, damping, resting place</h2>
<p class="note">Of the marker that moves most; a dash where its motion is no damped oscillation. Final error: between
the mean places of all markers in the last tenth of the recording.</p>
<table><tr><th>dataset</th><th>recording</th><th>method</th><th>frequency [Hz]</th><th>damping ratio</th>
<th>final error [mm]</th></tr>
{% for row in motions %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>
<h2>Every recording</h2>
<table><tr><th>dataset</th><th>recording</th><th>split</th>
{% for m in methods %}<th>{{ m }}</th>{% endfor %}</tr>
{% for row in recordings %}<tr><td>{{ row.dataset }}</td><td>{{ row.recording }}</td><td>{{ row.split }}</td>
{% for cell in row.cells %}<td class="{{ cell.style }}">{{ cell.text }}</td>{% endfor %}</tr>
{% endfor %}</table>
<p class="note">{{ models }}</p></html>
"""


def _error_plot(dataset: str, comparisons: list[Comparison]) -> str:
    figure, axes = plt.subplots(figsize=(9, 3.2), layout="constrained")
    held_out = [item for item in comparisons if item.split == "test"] or comparisons
    for colour, method in zip(cycle(COLOURS), held_out[0].errors, strict=False):
        for number, item in enumerate(held_out):
            label = method if number == 0 else None
            axes.plot(item.error_time, 1e3 * item.errors[method], color=colour, label=label, alpha=0.75)
    axes.set(xlabel="time [s]", ylabel="marker error [mm]", ylim=(0, None))
    axes.set_title(f"{dataset}: {held_out[0].split} recordings")
    axes.legend()
    return png(figure)


def _marker_plot(item: Comparison) -> str:
    marker, axis = liveliest(item.recorded)
    figure, axes = plt.subplots(figsize=(9, 2.8), layout="constrained")
    axes.plot(item.time, 1e3 * item.recorded[:, marker, axis], "k.", markersize=4, label="recorded")
    for colour, (method, markers) in zip(cycle(COLOURS), item.simulated.items(), strict=False):
        axes.plot(item.time, 1e3 * markers[:, marker, axis], color=colour, label=method)
    axes.set(xlabel="time [s]", ylabel=f"{'xyz'[axis]} of {item.marker_names[marker]} [mm]")
    axes.set_title(f"{item.dataset} / {item.recording} ({item.split})")
    axes.legend(loc="best")
    return png(figure)


def _cells(methods: list[str], means: dict[str, float], stds: dict[str, float]) -> list[dict[str, str]]:
    best = min(means.values())
    return [
        {"text": "N/A", "style": ""}
        if method not in means
        else {
            "text": f"{means[method]:.3f} \N{PLUS-MINUS SIGN} {stds[method]:.3f}",
            "style": " ".join(
                name
                for name, holds in (
                    ("better", method != ORIGINAL and means[method] < means[ORIGINAL]),
                    ("best", means[method] == best),
                )
                if holds
            ),
        }
        for method in methods
    ]


def _rows(table: pd.DataFrame, keys: list[str]) -> list[dict[str, object]]:
    rows, methods = [], list(dict.fromkeys(table["method"]))
    for values, group in table.groupby(keys, sort=False):
        means = dict(zip(group["method"], group["mean_mm"], strict=True))
        stds = dict(zip(group["method"], group["std_mm"], strict=True))
        rows.append({**dict(zip(keys, values, strict=True)), "cells": _cells(methods, means, stds)})
    return rows


def _transfer(transfer: Transfer) -> dict[str, object] | None:
    if transfer.errors.shape[1] < 2:
        return None
    original = transfer.errors.loc[ORIGINAL]
    rows = []
    for method, errors in transfer.errors.iterrows():
        cells = [
            {
                "text": f"{errors[name]:.3f}" if np.isfinite(errors[name]) else "N/A",
                "style": "worse" if errors[name] > original[name] else "",
            }
            for name in errors.index
        ]
        rows.append({"method": method, "cells": cells, "negative": transfer.negative.get(str(method), "")})
    return {"datasets": list(transfer.errors.columns), "rows": rows}


def _motions(motions: pd.DataFrame) -> list[list[str]]:
    rows = []
    for row in motions[motions["split"] == "test"].to_dict("records") or motions.to_dict("records"):
        numbers = [
            f"{row[key]:.{digits}f}" if np.isfinite(row[key]) else "-"
            for key, digits in (("frequency_hz", 2), ("damping_ratio", 3), ("final_error_mm", 3))
        ]
        final = numbers[2] if row["method"] != "recorded" else ""
        rows.append([str(row["dataset"]), str(row["recording"]), str(row["method"]), *numbers[:2], final])
    return rows


def _bodies(item: Comparison) -> str:
    frames = []
    for method, shapes in item.shapes.items():
        for k, when in ((0, "first"), (-1, "last")):
            if k == -1 or method == ORIGINAL:
                frames.append((f"{item.recording}: {method}, {when} frame", shapes[k], item.recorded[k]))
    return bodies(item.mesh, frames[:4])


def _forces(items: list[Comparison]) -> str:
    sizes = {method: np.mean([item.force[method] for item in items], axis=0) for method in items[0].force}
    return forces(items[0].mesh, sizes) if sizes else ""


def write_report(
    path: Path,
    comparisons: list[Comparison],
    splits: pd.DataFrame,
    recordings: pd.DataFrame,
    motions: pd.DataFrame,
    models: str,
) -> None:
    """Write the report.

    Args:
        path: of the HTML file.
        comparisons: what to plot.
        splits: from `split_table`.
        recordings: from `error_table`.
        motions: from `motion_table`.
        models: one line on the fitted models.
    """
    plt.switch_backend("agg")
    by_dataset: dict[str, list[Comparison]] = {}
    for item in comparisons:
        by_dataset.setdefault(item.dataset, []).append(item)
    shown = sorted(comparisons, key=lambda item: item.split != "test")[:MOST_PLOTS]
    page = jinja2.Environment(autoescape=True).from_string(PAGE)
    text = page.render(
        methods=list(dict.fromkeys(splits["method"])),
        transfer=_transfer(Transfer.of(splits)),
        motions=_motions(motions),
        bodies=[_bodies(items[0]) for items in by_dataset.values()],
        forces=[image for items in by_dataset.values() if (image := _forces(items))],
        splits=_rows(splits, ["dataset", "split", "recordings"]),
        recordings=_rows(recordings, ["dataset", "recording", "split"]),
        error_plots=[_error_plot(name, items) for name, items in by_dataset.items()],
        marker_plots=[_marker_plot(item) for item in shown],
        left_out=len(comparisons) - len(shown),
        models=models,
    )
    write_text(path, text)
