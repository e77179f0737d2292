"""`report.html` of an evaluation: one file that contains all tables and plots."""

from itertools import cycle

import jinja2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from rafl.evaluation.figures import draw_residual_forces, draw_specimens, encode_png
from rafl.evaluation.metrics import BASELINE, Comparison, Transfer
from rafl.evaluation.oscillation import most_active_coordinate

COLOURS = ["#c0392b", "#1f6fb2", "#2e8b57", "#8e44ad", "#d68910"]
MAX_MARKER_PLOTS = 8  # recordings whose marker trajectory is plotted

PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Evaluation</title>
<style>
 body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222}
 table{border-collapse:collapse;margin:1rem 0}
 th,td{padding:.25rem .8rem;text-align:right;border-bottom:1px solid #ddd}
 td:nth-child(-n+2),th:nth-child(-n+2){text-align:left}
 .worse{color:#c0392b}.better{text-decoration:underline}.best{font-weight:bold}
 img{max-width:100%} .note{color:#666}
</style>
<h1>Error of simulated markers</h1>
<p>Mean distance between simulated and recorded markers in mm, &plusmn; the standard deviation over frames.
<code>original</code> is the baseline simulator. Underlined: better than the baseline. Bold: best of the row.</p>
<table><tr><th>dataset</th><th>split</th><th>recordings</th>
{% for m in methods %}<th>{{ m }}</th>{% endfor %}</tr>
{% for row in splits %}<tr><td>{{ row.dataset }}</td><td>{{ row.split }}</td><td>{{ row.recordings }}</td>
{% for cell in row.cells %}<td class="{{ cell.style }}">{{ cell.text }}</td>{% endfor %}</tr>
{% endfor %}</table>
{% if transfer %}<h2>Transfer</h2>
<p class="note">Mean error in mm; one row per model, one column per dataset. Red: worse than the baseline simulator.</p>
<table><tr><th>model</th>{% for name in transfer.datasets %}<th>{{ name }}</th>{% endfor %}
<th>negative transfers</th></tr>
{% for row in transfer.rows %}<tr><td>{{ row.method }}</td>
{% for cell in row.cells %}<td class="{{ cell.style }}">{{ cell.text }}</td>{% endfor %}
<td>{{ row.negative_transfers }}</td></tr>
{% endfor %}</table>{% endif %}
<h2>Error over time</h2>
{% for image in error_plots %}<img alt="error over time" src="data:image/png;base64,{{ image }}">{% endfor %}
<h2>Marker trajectories</h2>
<p class="note">The coordinate with the largest range of motion. Black: recorded.
{% if left_out %}{{ left_out }} further recordings are in errors.csv only.{% endif %}</p>
{% for image in marker_plots %}<img alt="trajectory" src="data:image/png;base64,{{ image }}">{% endfor %}
<h2>First and last frame</h2>
<p class="note">The first recording of each dataset. Red: recorded markers.</p>
{% for image in specimens %}<img alt="specimen in 3-D" src="data:image/png;base64,{{ image }}">{% endfor %}
{% if residual_forces %}<h2>Where the residual forces act</h2>
<p class="note">Mean magnitude at every vertex, over all frames and recordings.</p>
{% for image in residual_forces %}<img alt="residual forces" src="data:image/png;base64,{{ image }}">{% endfor %}
{% endif %}
<h2>Frequency, damping, rest position</h2>
<p class="note">Frequency and damping of the coordinate with the largest range of motion. A dash means that its
motion is not a damped oscillation. Final error: mean distance between the simulated and recorded rest positions of all
markers. A rest position is the mean over the last tenth of the recording.</p>
<table><tr><th>dataset</th><th>recording</th><th>method</th><th>frequency [Hz]</th><th>damping ratio</th>
<th>final error [mm]</th></tr>
{% for row in motions %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>
<h2>Error of each recording</h2>
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
    figure.legend(loc="outside right upper")  # inside, it would hide the first rise of the curves
    return encode_png(figure)


def _marker_plot(item: Comparison) -> str:
    marker, axis = most_active_coordinate(item.recorded)
    figure, axes = plt.subplots(figsize=(9, 2.8), layout="constrained")
    axes.plot(item.time, 1e3 * item.recorded[:, marker, axis], "k.", markersize=4, label="recorded")
    for colour, (method, markers) in zip(cycle(COLOURS), item.simulated.items(), strict=False):
        axes.plot(item.time, 1e3 * markers[:, marker, axis], color=colour, label=method)
    axes.set(xlabel="time [s]", ylabel=f"{'xyz'[axis]} of {item.marker_names[marker]} [mm]")
    axes.set_title(f"{item.dataset} / {item.recording} ({item.split})")
    axes.legend(loc="best")
    return encode_png(figure)


def _error_cells(methods: list[str], means: dict[str, float], stds: dict[str, float]) -> list[dict[str, str]]:
    best = min(means.values())
    return [
        {"text": "N/A", "style": ""}
        if method not in means
        else {
            "text": f"{means[method]:.3f} \N{PLUS-MINUS SIGN} {stds[method]:.3f}",
            "style": " ".join(
                name
                for name, holds in (
                    ("better", method != BASELINE and means[method] < means[BASELINE]),
                    ("best", means[method] == best),
                )
                if holds
            ),
        }
        for method in methods
    ]


def _error_rows(table: pd.DataFrame, keys: list[str]) -> list[dict[str, object]]:
    rows, methods = [], list(dict.fromkeys(table["method"]))
    for values, group in table.groupby(keys, sort=False):
        means = dict(zip(group["method"], group["mean_mm"], strict=True))
        stds = dict(zip(group["method"], group["std_mm"], strict=True))
        rows.append({**dict(zip(keys, values, strict=True)), "cells": _error_cells(methods, means, stds)})
    return rows


def _transfer_rows(transfer: Transfer) -> dict[str, object] | None:
    if transfer.errors.shape[1] < 2:
        return None
    baseline = transfer.errors.loc[BASELINE]
    rows = []
    for method, errors in transfer.errors.iterrows():
        cells = [
            {
                "text": f"{errors[name]:.3f}" if np.isfinite(errors[name]) else "N/A",
                "style": "worse" if errors[name] > baseline[name] else "",
            }
            for name in errors.index
        ]
        rows.append(
            {"method": method, "cells": cells, "negative_transfers": transfer.negative_transfers.get(str(method), "")}
        )
    return {"datasets": list(transfer.errors.columns), "rows": rows}


def _motion_rows(motions: pd.DataFrame) -> list[list[str]]:
    rows = []
    for row in motions[motions["split"] == "test"].to_dict("records") or motions.to_dict("records"):
        numbers = [
            f"{row[key]:.{digits}f}" if np.isfinite(row[key]) else "-"
            for key, digits in (("frequency_hz", 2), ("damping_ratio", 3), ("final_error_mm", 3))
        ]
        final = numbers[2] if row["method"] != "recorded" else ""
        rows.append([str(row["dataset"]), str(row["recording"]), str(row["method"]), *numbers[:2], final])
    return rows


def _specimen_image(item: Comparison) -> str:
    frames = []
    for method, shapes in item.shapes.items():
        for k, name in ((0, "first"), (-1, "last")):
            if k == -1 or method == BASELINE:
                frames.append((f"{item.recording}: {method}, {name} frame", shapes[k], item.recorded[k]))
    return draw_specimens(item.mesh, frames[:4])


def _force_image(items: list[Comparison]) -> str:
    mean = {method: np.mean([item.mean_force[method] for item in items], axis=0) for method in items[0].mean_force}
    return draw_residual_forces(items[0].mesh, mean) if mean else ""


def report_page(
    comparisons: list[Comparison],
    splits: pd.DataFrame,
    recordings: pd.DataFrame,
    motions: pd.DataFrame,
    models: str,
) -> str:
    """The page `report.html`.

    Args:
        comparisons: simulations to plot.
        splits: from `split_table`.
        recordings: from `error_table`.
        motions: from `motion_table`.
        models: one line that describes the fitted models.
    """
    plt.switch_backend("agg")
    by_dataset: dict[str, list[Comparison]] = {}
    for item in comparisons:
        by_dataset.setdefault(item.dataset, []).append(item)
    shown = sorted(comparisons, key=lambda item: item.split != "test")[:MAX_MARKER_PLOTS]
    page = jinja2.Environment(autoescape=True).from_string(PAGE)
    return page.render(
        methods=list(dict.fromkeys(splits["method"])),
        transfer=_transfer_rows(Transfer.of(splits)),
        motions=_motion_rows(motions),
        specimens=[_specimen_image(items[0]) for items in by_dataset.values()],
        residual_forces=[image for items in by_dataset.values() if (image := _force_image(items))],
        splits=_error_rows(splits, ["dataset", "split", "recordings"]),
        recordings=_error_rows(recordings, ["dataset", "recording", "split"]),
        error_plots=[_error_plot(name, items) for name, items in by_dataset.items()],
        marker_plots=[_marker_plot(item) for item in shown],
        left_out=len(comparisons) - len(shown),
        models=models,
    )
