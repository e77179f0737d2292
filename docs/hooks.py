"""What mkdocs does besides converting pages: equations, and tables and figures from the results of the benchmarks."""

import re
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

matplotlib.use("Agg")
import matplotlib.pyplot as plt

DOCS = Path(__file__).parent
RESULTS = DOCS.parent / "datasets" / "results"
FIGURES = DOCS / "figures"
SMALLEST_ERROR_SHOWN = 0.01  # [mm]
matplotlib.rcParams["svg.hashsalt"] = "rafl"  # the same file from the same data


def on_pre_build(**kwargs: Any) -> None:
    """Draw the figures of the benchmarks."""
    FIGURES.mkdir(exist_ok=True)
    for study in ("vibration", "twist"):
        _save(_bars(pd.read_csv(RESULTS / f"{study}.csv", comment="#")), study)
    _save(_transfer(), "transfer")


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Fill in tables, and turn TeX into MathML, which browsers draw without a script."""
    markdown = re.sub(r"<!-- table: (\S+) -->", lambda m: _table(m[1]), markdown)
    parts = re.split(r"(```.*?```|`[^`]*`)", markdown, flags=re.DOTALL)
    return "".join(part if part.startswith("`") else _with_equations(part) for part in parts)


def on_page_content(html: str, page: Any, **kwargs: Any) -> str:
    """Refuse a page in which a snippet was not filled in.

    Raises:
        PluginError: its marker is still there.
    """
    if "--8" in html:
        raise PluginError(f"{page.file.src_path}: expected snippets to be filled in, found a marker")
    return html


def _with_equations(text: str) -> str:
    text = re.sub(r"\$\$(.+?)\$\$", lambda m: convert(m[1].strip(), display="block"), text, flags=re.DOTALL)
    return re.sub(r"\$([^$\n]+)\$", lambda m: f"<span>{convert(m[1])}</span>".replace("|", "&#124;"), text)


def _table(name: str) -> str:
    """A results file as a table with one column per method."""
    table = pd.read_csv(RESULTS / name, comment="#")
    if "trained_on" in table:
        return str(table.drop(columns="method").round(3).to_markdown(index=False))
    rows = "recording" if "recording" in table else "shape" if "shape" in table else "dataset"
    keys = [rows] if "study" not in table else ["study", rows]
    wide = table.pivot_table(index=keys, columns="method", values="mean_mm", sort=False)
    if "paper_mean_mm" in table:
        paper = table.pivot_table(index=keys, columns="method", values="paper_mean_mm", sort=False)
        wide = wide.join(paper.add_suffix(" (paper)"))
    if rows == "recording":
        wide.loc["mean"] = wide.mean()
    return str(wide.round(3).reset_index().astype(object).fillna("").to_markdown(index=False))


def _bars(table: pd.DataFrame) -> plt.Figure:
    """Errors by shape and method on a logarithmic scale; crosses are the paper's."""
    shapes, methods = list(dict.fromkeys(table["shape"])), list(dict.fromkeys(table["method"]))
    figure, axes = plt.subplots(figsize=(9, 3.6), layout="constrained")
    width = 0.8 / len(methods)
    for k, method in enumerate(methods):
        own = table[table["method"] == method].set_index("shape").reindex(shapes)
        at = np.arange(len(shapes)) + (k - 0.5 * (len(methods) - 1)) * width
        axes.bar(at, own["mean_mm"], width, label=method)
        axes.plot(at, own["paper_mean_mm"], "kx", markersize=5, label="paper" if k == 0 else None)
    axes.set_yscale("log")
    axes.set_ylim(bottom=SMALLEST_ERROR_SHOWN)
    axes.set_xticks(range(len(shapes)), shapes, rotation=30, ha="right")
    axes.set_ylabel("error [mm]")
    axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return figure


def _transfer() -> plt.Figure:
    """Errors on every shape relative to the baseline simulator, for models of every shape."""
    matrix = pd.read_csv(RESULTS / "sim2real-transfer.csv", comment="#")
    own = pd.read_csv(RESULTS / "sim2real.csv", comment="#")
    baseline = own[own["method"] == "original"].set_index("dataset")["mean_mm"]
    methods = list(dict.fromkeys(matrix["method"]))
    figure, all_axes = plt.subplots(
        1, len(methods), figsize=(3.0 * len(methods), 3.8), layout="constrained", squeeze=False, sharey=True
    )
    for axes, method in zip(all_axes[0], methods, strict=True):
        part = matrix[matrix["method"] == method].set_index("trained_on").drop(columns="method")
        ratio = np.log2(part / baseline[part.columns])
        image = axes.imshow(ratio, cmap="RdBu_r", vmin=-3, vmax=3)
        axes.set_xticks(range(len(part.columns)), part.columns, rotation=90)
        axes.set_yticks(range(len(part)), part.index)
        axes.set_title(method, fontsize=10)
    bar = figure.colorbar(image, ax=all_axes, ticks=range(-3, 4), shrink=0.8)
    bar.ax.set_yticklabels(["1/8", "1/4", "1/2", "1", "2", "4", "8"])
    return figure


def _save(figure: plt.Figure, name: str) -> None:
    figure.savefig(FIGURES / f"{name}.svg", metadata={"Date": None})
    plt.close(figure)
