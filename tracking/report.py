"""`report.html` of tracks: measured, filled and missing markers, residuals, and the frames to check, in one file."""

import base64
import io
from pathlib import Path
from typing import Any

import cv2
import jinja2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rafl.calibration.rig import Rig
from rafl.common.files import write_text
from rafl.tracking.overlay import annotate, display_pixels
from rafl.tracking.reconstruction.gap_filling import FILLED, MEASURED, MISSING
from rafl.tracking.reconstruction.tracks import Tracks

Array = NDArray[Any]

plt.rcParams["text.parse_math"] = False  # a name with $ is a name

SUSPECT_SIGMAS = 2.0  # a frame is worth a look if its largest sigma is this multiple of the usual one
MAX_WIDTH_PX = 900  # of a frame in the report
STATE_COLOURS = ["#c0392b", "#4c9f70", "#e6a23c"]  # missing, measured, filled

PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Tracks</title>
<style>
 body{font:16px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:#222}
 table{border-collapse:collapse;margin:1rem 0}
 th,td{padding:.25rem .8rem;text-align:right;border-bottom:1px solid #ddd}
 td:first-child,th:first-child{text-align:left}
 img{max-width:100%} figure{margin:0 0 1rem 0} .note{color:#666} .strip figure{display:inline-block;width:48%}
</style>
<h1>Tracks</h1>
<table><tr><th>recording</th><th>frames</th><th>markers</th><th>measured</th><th>filled</th><th>missing</th>
<th>sigma [px]</th><th>residual [px]</th></tr>
{% for r in recordings %}<tr><td><a href="#{{ r.name }}">{{ r.name }}</a></td>
{% for cell in r.cells %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>
{% for r in recordings %}
<h2 id="{{ r.name }}">{{ r.name }}</h2>
{% for note in r.notes %}<p class="note">{{ note }}</p>{% endfor %}
<figure><img alt="timeline" src="data:image/png;base64,{{ r.timeline }}"><figcaption class="note">Green: measured.
Orange: filled. Red: missing.</figcaption></figure>
{% for c in r.cameras %}
<h3>Camera {{ c.name }}</h3>
<figure><img alt="first frame" src="data:image/jpeg;base64,{{ c.first }}"><figcaption class="note">Frame
{{ c.first_number }}, the first, with the marker names.</figcaption></figure>
<img alt="residuals" src="data:image/png;base64,{{ c.histogram }}">
{% if c.worst %}<p class="note">The frames with the most missing or least certain markers:</p>
<div class="strip">{% for w in c.worst %}<figure><img alt="frame" src="data:image/jpeg;base64,{{ w.image }}">
<figcaption class="note">frame {{ w.number }}: {{ w.seen }} of the {{ w.all }} markers that this camera sees, largest
sigma {{ w.sigma }} px</figcaption></figure>{% endfor %}</div>{% endif %}
{% endfor %}{% endfor %}
<p class="note">Sigma is one standard deviation of a coordinate, estimated from the fit of each dot.</p></html>
"""


def summary_cells(tracks: Tracks) -> list[str]:
    """Numbers of frames and markers, shares measured, filled and missing, median sigma and RMS residual, as text."""
    state = tracks.state
    sigma = np.concatenate([values[np.isfinite(values)] for values in tracks.pixel_sigma.values()])
    residual = np.concatenate([_shared_residuals(tracks, camera) for camera in tracks.residual])
    return [
        str(len(tracks.time)),
        str(len(tracks.names)),
        *(f"{(state == kind).mean():.1%}" for kind in (MEASURED, FILLED, MISSING)),
        f"{np.median(sigma):.3f}" if len(sigma) else "-",
        f"{np.sqrt((residual**2).mean()):.3f}" if len(residual) else "-",
    ]


def _shared_residuals(tracks: Tracks, camera: str) -> Array:
    """One camera's residuals [px] of markers that another camera sees too; otherwise a residual is meaningless."""
    seen = np.sum([np.isfinite(residual) for residual in tracks.residual.values()], axis=0)
    result: Array = tracks.residual[camera][np.isfinite(tracks.residual[camera]) & (seen > 1)]
    return result


def write_report(path: Path, tracks: dict[str, Tracks], rig: Rig) -> None:
    """Write the report on all recordings, completely or not at all."""
    recordings = [
        {
            "name": name,
            "cells": summary_cells(item),
            "notes": item.notes,
            "timeline": _timeline(item),
            "cameras": [_camera_section(item, camera, rig) for camera in item.pixel],
        }
        for name, item in tracks.items()
    ]
    page = jinja2.Environment(autoescape=True).from_string(PAGE)
    write_text(path, page.render(recordings=recordings))


def _camera_section(tracks: Tracks, name: str, rig: Rig) -> dict[str, object]:
    pixel = display_pixels(tracks, name, rig.cameras[name])
    images = tracks.images[name]
    first = min(images)
    _, sigma = tracks.in_frames(name)
    row_of = tracks.rows_by_frame(name)
    shown = int(np.isfinite(sigma[..., 0]).any(axis=0).sum())
    largest = np.nan_to_num(sigma).max(axis=(1, 2), initial=0.0)
    suspect = SUSPECT_SIGMAS * np.median(largest)
    worst = []
    for number in sorted(set(images) & set(row_of) - {first}):
        row = row_of[number]
        seen = int(np.isfinite(sigma[row, :, 0]).sum())
        if seen < shown or largest[row] > suspect:
            worst.append(
                {
                    "number": number,
                    "image": _annotated_jpeg(images[number], tracks, pixel, row),
                    "seen": seen,
                    "all": shown,
                    "sigma": f"{largest[row]:.2f}" if seen else "-",
                }
            )
    return {
        "name": name,
        "first": _annotated_jpeg(images[first], tracks, pixel, row_of.get(first, 0)),
        "first_number": first,
        "histogram": _histogram(tracks, name),
        "worst": worst,
    }


def _annotated_jpeg(content: bytes, tracks: Tracks, pixel: Array, row: int) -> str:
    """A stored frame with its markers and trails drawn in, as a base64 JPEG."""
    grey = np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE))
    shrink = min(1.0, MAX_WIDTH_PX / grey.shape[1])
    small = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    trails = shrink * pixel[max(row - 10, 0) : row + 1]
    annotated = annotate(small, shrink * pixel[row], tracks.state[row] == FILLED, tracks.names, trails)
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(annotated, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    return base64.b64encode(jpeg.tobytes()).decode()


def _timeline(tracks: Tracks) -> str:
    height = 0.6 + 0.16 * len(tracks.names)
    figure, axes = plt.subplots(figsize=(9, min(max(height, 1.4), 9)), layout="constrained")
    end = tracks.time[-1] + 1.0 / tracks.fps
    axes.imshow(
        tracks.state.T,
        aspect="auto",
        interpolation="nearest",
        cmap=ListedColormap(STATE_COLOURS),
        vmin=0,
        vmax=2,
        extent=(tracks.time[0], end, len(tracks.names) - 0.5, -0.5),
    )
    every = max(len(tracks.names) // 40, 1)
    axes.set_yticks(range(0, len(tracks.names), every), tracks.names[::every], fontsize=7)
    axes.set_xlabel("time [s]")
    return _png(figure)


def _histogram(tracks: Tracks, name: str) -> str:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 2.4), layout="constrained")
    sigma = tracks.pixel_sigma[name]
    for axes, values, label, empty_text in (
        (left, _shared_residuals(tracks, name), "reprojection residual [px]", "no marker is seen by two cameras"),
        (right, sigma[np.isfinite(sigma)], "sigma of a coordinate [px]", "no marker is seen"),
    ):
        if len(values):
            axes.hist(values, bins=60, range=(0.0, float(np.quantile(values, 0.995)) + 1e-9), color="#1f6fb2")
        else:
            axes.text(0.5, 0.5, empty_text, ha="center", va="center", transform=axes.transAxes, color="#666666")
            axes.set_xticks([])
        axes.set_xlabel(label)
        axes.set_yticks([])
    return _png(figure)


def _png(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    plt.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()
