"""Building a dataset: recordings registered to a specimen, with their first frames fitted."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pydantic
from numpy.typing import NDArray

from capture.initial import fit_first_frame
from capture.registration import IDENTITY, Rigid, rigid_fit
from capture.sources import Recorded, find_source, read_recorded
from capture.specimen import Specimen
from groundwork import InputError, StrictModel, require_file
from rafl.dataset import Dataset, Trajectory
from rafl.synthetic import load_force

Array = NDArray[Any]

FEWEST_MARKERS = 3
SAME_STEP = 5e-3  # largest relative difference of time steps within a dataset


class RecordingRow(StrictModel):
    """A row of recordings.csv.

    `load` says whether the load was cut off at the start (`released`) or hangs on during the motion
    (`hanging`); frames count from 0 and `last_frame` is included.
    """

    recording: str = pydantic.Field(min_length=1)
    load_g: float = pydantic.Field(ge=0)
    split: Literal["train", "val", "test"]
    load: Literal["released", "hanging"] = "released"
    first_frame: int = pydantic.Field(0, ge=0)
    last_frame: int | None = pydantic.Field(None, ge=1)


@dataclass(frozen=True)
class CaptureSettings:
    """How a dataset is built.

    Attributes:
        tolerance: how far a marker may stand off the surface [m].
        fit_tolerance: how far registered markers may be from the layout, root mean square [m].
        fps: of files that do not say.
        rest: recording and frame in which the specimen is undeformed, if any.
        moving_clamp: express markers in the frame of the clamp markers, where there are some.
    """

    tolerance: float
    fit_tolerance: float
    fps: float
    rest: tuple[str, int] | None
    moving_clamp: bool


def read_recording_rows(path: Path) -> list[RecordingRow]:
    """Read recordings.csv.

    Raises:
        InputError: missing, or a row that does not fit; names the line.
    """
    require_file(path, "a table of recordings (recordings.csv)")
    try:
        table = pd.read_csv(path, dtype=str, skipinitialspace=True)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise InputError(f"expected a table with commas in {path}, found: {error}; save it as CSV") from None
    rows = []
    for line, record in enumerate(table.to_dict("records"), start=2):
        given = {str(key).strip(): value.strip() for key, value in record.items() if isinstance(value, str)}
        try:
            rows.append(RecordingRow.model_validate(given))
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            column = ".".join(map(str, first["loc"]))
            raise InputError(f"{path} line {line}, column {column}: {first['msg']}; correct it") from None
    if not rows:
        raise InputError(f"expected at least one recording in {path}, found none; add a row")
    twice = [name for name, count in pd.Series([row.recording for row in rows]).value_counts().items() if count > 1]
    if twice:
        raise InputError(f"{path}: expected each recording once, {twice[0]} stands there twice; remove one row")
    if not any(row.split == "train" for row in rows):
        raise InputError(f"{path}: expected a recording with split `train`, found none; set one")
    return rows


def build_dataset(
    specimen: Specimen, folder: Path, rows: list[RecordingRow], settings: CaptureSettings, recipe: str,
    tick: Callable[[], None],
) -> Dataset:  # fmt: skip
    """Build a dataset of a specimen's recordings.

    Args:
        specimen: as described.
        folder: of tracks, C3D or npy files named after the recordings.
        rows: of recordings.csv.
        settings: how.
        recipe: text kept in the dataset.
        tick: called after every recording.

    Raises:
        InputError: a file, marker or frame that does not fit; names it.
        SimulationError: a first frame that cannot be fitted.
    """
    markers = specimen.markers(settings.tolerance)
    sources = {row.recording: find_source(folder, row.recording) for row in rows}
    read = {name: _selected(read_recorded(path, settings.fps), specimen, name) for name, path in sources.items()}
    clamp = specimen.clamp_layout.positions
    if settings.rest is not None:
        clamp, rest_fit = _measured_clamp(read, specimen, settings)
    else:
        rest_fit = None
    steps = {name: float(np.median(np.diff(item.time))) for name, item in read.items()}
    step = next(iter(steps.values()))
    for name, other in steps.items():
        if abs(other / step - 1.0) > SAME_STEP:
            raise InputError(
                f"recording {name}: expected {1 / step:.2f} frames/s as in {rows[0].recording}, found "
                f"{1 / other:.2f}; put recordings of different rates into different datasets"
            )
    simulator = specimen.simulator(step)
    trajectories = {}
    for row in rows:
        item = read[row.recording]
        rigid = _registration(item, specimen, clamp, rest_fit, settings, row.recording)
        time, position, sigma = _on_grid(item, rigid, len(specimen.layout.names), step, row)
        initial = fit_first_frame(simulator, markers, specimen.loaded, position[0], sigma[0], row.recording)
        if initial.residual > settings.fit_tolerance:
            raise InputError(
                f"recording {row.recording}: expected a first frame the specimen can be bent into, found its "
                f"markers {1e3 * initial.residual:.2f} mm off (root mean square; at most "
                f"{1e3 * settings.fit_tolerance:g} mm); check that the calibration's world is the specimen's frame, "
                "or allow it with --fit-tolerance-mm"
            )
        load = 1e-3 * row.load_g if row.load == "hanging" else 0.0
        added = np.zeros(len(specimen.mesh.vertices))
        added[specimen.loaded] = load / len(specimen.loaded)
        trajectories[row.recording] = Trajectory(
            time,
            position,
            np.isfinite(position[..., 0]),
            sigma,
            initial.q,
            np.zeros_like(initial.q),
            initial.force,
            load_force(simulator, specimen.loaded, load),
            added,
            row.split,
            {
                "load_g": row.load_g,
                "load": row.load,
                "registration_R": rigid.rotation.reshape(-1, 3, 3)[0],
                "registration_t": rigid.translation.reshape(-1, 3)[0],
                "registration_residual_mm": 1e3 * float(rigid.residual.max()),
                "fit_residual_mm": 1e3 * initial.residual,
                "source": item.source,
            },
        )
        tick()
    return Dataset(specimen.name, simulator, markers, trajectories, recipe)


def _selected(item: Recorded, specimen: Specimen, name: str) -> Recorded:
    """The recording with its markers in the order: the skin's, then the clamp's."""
    wanted = (*specimen.layout.names, *specimen.clamp_layout.names)
    if item.names is None:
        if item.position.shape[1] != len(wanted):
            raise InputError(
                f"recording {name}: expected {len(wanted)} markers as in the specimen, found "
                f"{item.position.shape[1]}; the file has no names, so its order must be the specimen's"
            )
        return item
    missing = [marker for marker in wanted if marker not in item.names]
    present = [marker for marker in specimen.layout.names if marker in item.names]
    if len(present) < FEWEST_MARKERS:
        raise InputError(
            f"recording {name}: expected at least {FEWEST_MARKERS} of the specimen's markers, found "
            f"{len(present)} (the file has {', '.join(item.names[:6])}...); name the markers alike in both"
        )
    order = [item.names.index(marker) if marker in item.names else -1 for marker in wanted]
    position, sigma = item.position[:, order].copy(), item.sigma[:, order].copy()
    lost = [wanted.index(marker) for marker in missing]
    position[:, lost] = np.nan
    return Recorded(wanted, item.time, position, sigma, item.rest, item.in_specimen_frame, item.source)


def _measured_clamp(read: dict[str, Recorded], specimen: Specimen, settings: CaptureSettings) -> tuple[Array, Rigid]:
    """Clamp marker positions as found where the specimen is undeformed, and the fit that shows them."""
    assert settings.rest is not None
    name, frame = settings.rest
    if name not in read or not frame < len(read[name].time):
        raise InputError(
            f"--rest {name}:{frame}: expected a recording of recordings.csv and one of its frames, found "
            "no such; correct it"
        )
    pose = read[name].position[frame]
    layout = np.concatenate([specimen.layout.positions, specimen.clamp_layout.positions])
    fit = _rigid_checked(pose, layout, settings.fit_tolerance, f"--rest {name}:{frame}")
    return fit.apply(pose)[len(specimen.layout.names) :], fit


def _rigid_checked(pose: Array, layout: Array, tolerance: float, what: str) -> Rigid:
    seen = np.isfinite(pose[:, 0])
    if seen.sum() < FEWEST_MARKERS:
        raise InputError(
            f"{what}: expected at least {FEWEST_MARKERS} markers in sight to register, found {seen.sum()}; "
            "choose another frame"
        )
    fit = rigid_fit(pose[seen], layout[seen])
    if fit.residual > tolerance:
        raise InputError(
            f"{what}: expected the markers where the specimen's layout has them, found them "
            f"{1e3 * float(fit.residual):.2f} mm off (root mean square; at most {1e3 * tolerance:g} mm); "
            "check at_mm, the unit and the order, or allow it with --fit-tolerance-mm"
        )
    return fit


def _registration(
    item: Recorded,
    specimen: Specimen,
    clamp: Array,
    rest_fit: Rigid | None,
    settings: CaptureSettings,
    name: str,
) -> Rigid:
    """From the recorded frame to the specimen frame; one for every frame where the clamp moves."""
    skin = len(specimen.layout.names)
    on_clamp = item.position[:, skin:]
    if len(clamp) >= FEWEST_MARKERS and np.isfinite(on_clamp).all(axis=(1, 2)).all():
        first = rigid_fit(on_clamp if settings.moving_clamp else on_clamp.mean(axis=0), clamp)
        worst = float(np.max(first.residual))
        if worst > settings.fit_tolerance:
            raise InputError(
                f"recording {name}: expected the clamp markers where the specimen has them, found them "
                f"{1e3 * worst:.2f} mm off; check the clamp's at_mm, or allow it with --fit-tolerance-mm"
            )
        return first
    if item.rest is not None:
        layout = np.concatenate([specimen.layout.positions, specimen.clamp_layout.positions])
        return _rigid_checked(item.rest, layout, settings.fit_tolerance, f"recording {name}, rest pose")
    if item.in_specimen_frame:
        return IDENTITY
    if rest_fit is not None:
        return rest_fit
    raise InputError(
        f"recording {name}: expected a way to the specimen frame, found none; describe the clamp's markers "
        "in the specimen (three or more, seen in every frame), or name an undeformed frame with --rest"
    )


def _on_grid(item: Recorded, rigid: Rigid, skin: int, step: float, row: RecordingRow) -> tuple[Array, Array, Array]:
    """Times, skin markers and sigma of the chosen frames on an even grid; dropped frames are gaps."""
    last = len(item.time) - 1 if row.last_frame is None else row.last_frame
    if not row.first_frame < last < len(item.time):
        raise InputError(
            f"recording {row.recording}: expected frames within 0 to {len(item.time) - 1}, found "
            f"{row.first_frame} to {last}; correct recordings.csv"
        )
    chosen = slice(row.first_frame, last + 1)
    if rigid.rotation.ndim == 3:
        rigid = Rigid(rigid.rotation[chosen], rigid.translation[chosen], rigid.residual)
    position = rigid.apply(item.position[chosen, :skin])
    # Turned into the specimen frame; correlations between axes are left out.
    sigma = np.sqrt(item.sigma[chosen, :skin] ** 2 @ np.swapaxes(rigid.rotation, -1, -2) ** 2)
    slot = np.rint((item.time[chosen] - item.time[row.first_frame]) / step).astype(int)
    if (np.diff(slot) < 1).any():
        frame = row.first_frame + int(np.argmax(np.diff(slot) < 1)) + 1
        raise InputError(
            f"recording {row.recording}: expected even frame times, frame {frame} comes "
            "too early; track it again with the true rate (--fps)"
        )
    grid = np.full((slot[-1] + 1, skin, 3), np.nan)
    grid_sigma = np.full_like(grid, np.inf)
    grid[slot], grid_sigma[slot] = position, np.where(np.isfinite(sigma), sigma, np.inf)
    if np.isfinite(grid[0, :, 0]).sum() < FEWEST_MARKERS:
        raise InputError(
            f"recording {row.recording}, frame {row.first_frame}: expected at least {FEWEST_MARKERS} markers"
            ", found fewer; start at a later first_frame"
        )
    return step * np.arange(len(grid)), grid, grid_sigma
