"""Text summary of a dataset: a table of recordings, warnings, and the contents of the file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from rafl.calibration.summary import OTHER_SET_UP
from rafl.capture.dataset.camera_summary import CAMERA_HEADINGS, camera_rows, camera_warnings
from rafl.capture.dataset.contradictions import contradictions
from rafl.common.command_line import create_table
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset
from rafl.fem.material import unit_hints
from rafl.tracking.linking.layout import DEFAULT_SIGMA_MM

MISPLACED_MM = 2.0  # farther from its description than a hand misplaces a dot: four usual standard deviations
# Ratio of the mean of the markers' shifts to their scatter, and the least number of markers. Six dots that a hand has
# misplaced exceed the ratio along one axis once in 150 specimens (Student's t), fewer dots more often.
MOVED_ALIKE_RATIO, MOVED_ALIKE_MARKERS = 2.0, 6
MANY_MISPLACED = 3  # so many may have one cause, the calibration
# What the share of valid positions counts.
VALID = (
    "share of positions that are known, of all markers in the specimen file in all frames. A marker on a face that no "
    "camera films has none: of two faces with as many dots, one alone gives 50 %"
)
TOLD_APART = 0.1  # standard deviation of log E up to which a frame is told apart from the material


def recordings_table(dataset: Dataset) -> Table:
    """Table with one row per recording: split, load, first frame, residuals of registration and first frame, sigma."""
    fits = ("registration [mm]", "first frame fit [mm]", "sigma [mm]")
    table = create_table("recording", "split", "load [g]", "frames", "valid", "first frame", *fits)
    table.caption, table.caption_justify = Text(f"valid: {VALID}", style="default"), "left"
    for name, item in dataset.trajectories.items():
        values = item.attributes
        averaged = int(str(values.get("still_frames", 0)))
        state = (
            f" (mean of {averaged} before)" if averaged else " (moving)" if values.get("initial") == "moving" else ""
        )
        first_frame = f"{values.get('first_frame', '-')}{state}"
        table.add_row(
            name,
            item.split,
            load_text(values),
            str(len(item.time)),
            f"{item.valid.mean():.1%}",
            first_frame,
            _number(values.get("registration_residual_mm"), ".3f"),
            _number(values.get("fit_residual_mm"), ".3f"),
            _number(largest_sigma(values), ".2g"),
        )
    return table


def load_text(values: Mapping[str, object]) -> str:
    """The load of a recording in words, from its attributes."""
    load = values.get("load_g")
    return "none" if load == 0.0 else f"{_number(load, 'g')} {values.get('load', '')}"


def cameras_table(dataset: Dataset) -> Table | None:
    """Table of the cameras that were found elsewhere than calibrated; None without any."""
    rows = camera_rows(dataset)
    table = create_table(*CAMERA_HEADINGS)
    for row in rows:
        table.add_row(*("\n".join(lines) for lines in row.cells))
    return table if rows else None


def largest_sigma(attributes: dict[str, Any]) -> float:
    """Largest standard deviation of a marker in the fitted first frame [mm]; NaN if none is known."""
    sigma = np.asarray(attributes.get("fit_sigma_mm", np.nan), dtype=float)
    known = sigma[np.isfinite(sigma)]
    return float(known.max()) if known.size else np.nan


def _number(value: object, format_spec: str) -> str:
    return format(value, format_spec) if isinstance(value, (int, float)) and np.isfinite(value) else "-"


def warnings(dataset: Dataset) -> list[str]:
    """Messages on misplaced markers, markers left out, frames that are not free, and quantities that contradict."""
    material = dataset.simulator.material
    units = [f"specimen {dataset.name}: {hint}" for hint in unit_hints(material.youngs_modulus, material.density)]
    lines = [*units, *_moved_alike(dataset), *_bad_fits(dataset)]
    moved = dataset.markers.moved
    distances = np.zeros(len(dataset.markers.names)) if moved is None else 1e3 * np.linalg.norm(moved, axis=1)
    off = [(name, mm) for name, mm in zip(dataset.markers.names, distances, strict=True) if mm > MISPLACED_MM]
    if len(off) < MANY_MISPLACED:
        lines += [
            f"marker {name}: found {mm:.1f} mm from its at_mm in the first frames; correct at_mm, or its name in the "
            "tracks"
            for name, mm in off
        ]
    else:
        listed = ", ".join(f"{name} {mm:.1f}" for name, mm in off)
        lines.append(
            f"markers found far from their at_mm in the first frames, in mm: {listed}. Correct at_mm, or their names "
            f"in the tracks; or else {OTHER_SET_UP}"
        )
    if names := dataset.registered_through_model:
        found = [dataset.trajectories[name].attributes for name in names]
        lines.append(f"recordings {', '.join(names)}: {_frame_through_model(found)}")
    for name, item in dataset.trajectories.items():
        if outliers := item.attributes.get("set_aside"):
            lines.append(
                f"recording {name}: {outliers} too far from the position in the specimen's layout, left out; correct "
                "at_mm, or the names in the tracks"
            )
        if unfit := item.attributes.get("unfit_corrections"):
            lines.append(f"recording {name}: {unfit}; see rafl-review")
        start, not_free = (int(str(item.attributes.get(key, 0))) for key in ("first_frame", "not_free_frames"))
        if not_free:
            lines.append(
                f"recording {name}: expected a free motion from the release on, found none in frames "
                f"{start - not_free} to {start - 1} (a hand, a slack string, or a load that touches again); it starts "
                f"after them"
            )
    # With a wrong unit every modulus contradicts the others, and the reason that is named is another one.
    return [*lines, *missing_pixels(dataset), *camera_warnings(dataset), *([] if units else contradictions(dataset))]


def _moved_alike(dataset: Dataset) -> list[str]:
    """A message if all markers were found moved by about the same distance: no hand misplaces all dots alike."""
    moved = dataset.markers.moved
    if moved is None or len(moved) < MOVED_ALIKE_MARKERS:
        return []
    mean, scatter = 1e3 * moved.mean(axis=0), 1e3 * moved.std(axis=0)
    alike = (np.abs(mean) > DEFAULT_SIGMA_MM) & (np.abs(mean) > MOVED_ALIKE_RATIO * scatter)
    if not alike.any():
        return []
    along = ", ".join(f"{mean[k]:+.1f} mm along {'xyz'[k]}" for k in np.flatnonzero(alike))
    return [
        f"all markers were found moved alike from their at_mm in the first frames: {along}. Either the dots are that "
        "far off, or at_mm counts from another edge (correct at_mm), or a camera was touched since its calibration "
        "(--refine-cameras), or the calibration's world is not the specimen's frame"
    ]


def _bad_fits(dataset: Dataset) -> list[str]:
    """A message on first frames whose markers the model follows less well than their places are known."""
    fits = {name: item.attributes.get("fit_residual_mm") for name, item in dataset.trajectories.items()}
    bad = {name: mm for name, mm in fits.items() if isinstance(mm, float) and mm > DEFAULT_SIGMA_MM}
    if not bad:
        return []
    listed = ", ".join(f"{name} {mm:.2f}" for name, mm in bad.items())
    return [
        f"first frames whose markers are farther from the fitted body than {DEFAULT_SIGMA_MM:g} mm, to which places of "
        f"dots are usually known, in mm (root mean square): {listed}. Check at_mm, the size of the body and its clamp "
        f"in the specimen file, and the names of the markers; or else {OTHER_SET_UP}"
    ]


def missing_pixels(dataset: Dataset) -> list[str]:
    """A message on recordings of which only positions are known, if others have pixels."""
    without = [name for name, item in dataset.trajectories.items() if not item.has_pixels]
    if not without or len(without) == len(dataset.trajectories):
        return []
    return [
        f"recordings {', '.join(without)}: no pixels, which the others have; where they are compared together, all are "
        "by their 3-D positions; build them again from tracks"
    ]


def _frame_through_model(recordings: list[dict[str, Any]]) -> str:
    """What is known of a frame that was found through the model, and what would tell it.

    The swing shows Young's modulus whatever the frame is: where it shows another, the frame is that uncertain.

    Args:
        recordings: attributes of those in the frame.
    """
    advice = "film the undeformed specimen (--rest), or put three markers on the clamp"
    keys = ("registration_modulus", "registration_modulus_sigma")
    modulus, sigma = (float(recordings[0].get(key, np.nan)) for key in keys)
    if not np.isfinite(sigma):
        return f"their frame was found through the assumed material, which a fitted material then depends on; {advice}"
    swings = np.array([float(attributes.get("swing_modulus", np.nan)) for attributes in recordings])
    swing = float(np.median(swings[np.isfinite(swings)])) if np.isfinite(swings).any() else modulus
    also = "" if abs(np.log(swing / modulus)) <= sigma else f", where their swing shows {1e-3 * swing:.0f} kPa"
    sigma = float(np.hypot(sigma, np.log(swing / modulus)))
    found = f"their frame was found together with E = {1e-3 * modulus:.0f} kPa, {100 * sigma:.0f} % uncertain{also}"
    if sigma > TOLD_APART:
        unloaded = all(float(attributes.get("load_g", 0.0)) == 0.0 for attributes in recordings)
        return f"{found}: the two cannot be told apart; {advice}{', or give load_g' if unloaded else ''}"
    return f"{found}, from the loads in recordings.csv, whose errors a fitted material then has; better {advice}"


def print_contents(path: Path, console: Console) -> None:
    """Print the specimen, recordings, residuals and provenance of a dataset file.

    Raises:
        InputError: the file is no dataset, or is damaged.
    """
    dataset = read_dataset(path)
    tables = [table for table in (recordings_table(dataset), cameras_table(dataset)) if table]
    simulator, mesh = dataset.simulator, dataset.simulator.mesh
    with h5py.File(path, "r") as file:
        created, software, units = (str(file.attrs.get(key, "-")) for key in ("created", "software", "units"))
    size = 1e3 * np.ptp(mesh.vertices, axis=0)
    material = simulator.material
    lines = {
        "specimen": f"{dataset.name}: {len(mesh.vertices)} vertices, {len(mesh.hexes)} elements, "
        f"{size[0]:.4g} x {size[1]:.4g} x {size[2]:.4g} mm, {1e6 * mesh.volumes.sum():.4g} ml; "
        f"{len(simulator.fixed)} fixed vertices",
        "material": f"{material.law}, E = {material.youngs_modulus:g} Pa, nu = {material.poissons_ratio:g}, "
        f"{material.density:g} kg/m3, {material.mass} mass",
        "time": f"{1 / simulator.time_step:g} frames/s, {simulator.integrator}, {simulator.substeps} substeps",
        "markers": f"{len(dataset.markers.names)}: {', '.join(dataset.markers.names)}",
        "pixels": ", ".join(dict.fromkeys(camera for item in dataset.trajectories.values() for camera in item.views))
        or "none, positions only",
        "splits": ", ".join(f"{split} {len(dataset.split(split))}" for split in ("train", "val", "test")),
        "units": units,
        "created": f"{created} by {software}",
    }
    for key, text in lines.items():
        console.print(Text.assemble((key, "bold"), f": {text}"))
    for table in tables:
        console.print(table)
    for name, item in dataset.trajectories.items():
        values = item.attributes
        line = (
            f"{name}: registered by {values.get('registration', '-')} ({values.get('registration_markers') or '-'}); "
            f"first frame from {values.get('first_frame_from', '-')}; source {values.get('source', '-')}; "
            f"corrections {values.get('corrections') or '-'}"
        )
        console.print(Text(line))
    for line in warnings(dataset):
        console.print(Text(line))
