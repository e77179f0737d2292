"""The functions that `import rafl` offers: one for each step from a recording to a prediction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from rafl.calibration.board import read_board
from rafl.calibration.board_images import board_views, check_shared_world
from rafl.calibration.foreign.read import read_any_calibration
from rafl.calibration.rig import Rig, write_calibration
from rafl.calibration.solve import solve_rig
from rafl.capture.dataset.build import build_dataset as build
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import read_recording_rows
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.errors import InputError, SimulationError
from rafl.common.marker_table import marker_table
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.dataset_file import read_dataset, write_dataset
from rafl.data.markers import Markers
from rafl.data.objective import Recordings
from rafl.data.synthetic import load_force
from rafl.data.views import View
from rafl.evaluation.metrics import compare, error_table
from rafl.fem.laws import register_law
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.fitting.fit import fit
from rafl.fitting.run_folder import FittedModel, ResidualModel, load_model
from rafl.residual.acceleration_field import ResidualField
from rafl.simulation.parameters import Parameters
from rafl.simulation.rollout import ResidualForce, Start, equilibrium, rollout
from rafl.simulation.simulator import Simulator
from rafl.tracking.linking.layout import read_layout
from rafl.tracking.linking.naming import with_face_planes
from rafl.tracking.pipeline import TrackingSettings, track_recording
from rafl.tracking.reconstruction.corrected_tracks import CorrectedTracks, read_corrected_tracks
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks, write_tracks
from rafl.tracking.video.recordings import filmed_cameras, find_recordings

__all__ = [
    "CaptureSettings",
    "CorrectedTracks",
    "Dataset",
    "FittedModel",
    "HexMesh",
    "InputError",
    "Markers",
    "Material",
    "Parameters",
    "ResidualField",
    "ResidualForce",
    "ResidualModel",
    "Rig",
    "Simulation",
    "SimulationError",
    "Simulator",
    "Specimen",
    "Start",
    "Tracks",
    "Trajectory",
    "View",
    "build_dataset",
    "calibrate",
    "equilibrium",
    "evaluate",
    "fit",
    "load_model",
    "predict",
    "read_calibration",
    "read_corrected_tracks",
    "read_dataset",
    "read_specimen",
    "read_tracks",
    "register_law",
    "rollout",
    "simulate",
    "track",
    "write_calibration",
    "write_dataset",
    "write_tracks",
]

Array = NDArray[Any]

EQUILIBRIUM_STEPS = 200  # largest number of fixed-point steps towards an equilibrium with a residual force
EQUILIBRIUM_TOLERANCE = 1e-7  # largest movement of a vertex in the last of these steps [m]; a marker's sigma is 1e-5 m


@dataclass(frozen=True)
class Simulation:
    """A simulated motion.

    Attributes:
        time: [s], (T).
        vertices: positions of the mesh [m], (T, N, 3).
        markers: positions of the markers [m], (T, M, 3).
        marker_names: (M).
    """

    time: Array
    vertices: Array
    markers: Array
    marker_names: tuple[str, ...]

    def table(self) -> pd.DataFrame:
        """One row per frame and marker, in mm: frame, time_s, marker, x_mm, y_mm, z_mm."""
        return marker_table(self.time, self.marker_names, self.markers)


def calibrate(
    images: str | Path,
    board: str | Path | None = None,
    model: str = "orthographic",
    tilt_signs: Mapping[str, int] | None = None,
) -> Rig:
    """Calibrate cameras from board images.

    Args:
        images: folder with one subfolder of board images per camera.
        board: board description; `board.yaml` in that folder if None.
        model: `orthographic` or `pinhole`.
        tilt_signs: by camera, +1 if the right (or lower) edge of its reference board is farther away, else -1; needed
            only if the images leave it open.

    Raises:
        InputError: a file cannot be read, or the images do not determine the cameras.
    """
    folder = Path(images)
    description = read_board(Path(board) if board else folder / "board.yaml")
    views, sizes = board_views(folder, description)
    check_shared_world(views)
    return solve_rig(views, sizes, description, dict(tilt_signs or {}), model).rig


def read_calibration(
    path: str | Path, unit: str | None = None, image_sizes: Mapping[str, tuple[int, int]] | None = None
) -> Rig:
    """Read `calib.yaml`, or a calibration of OpenCV, aniposelib, Caliscope, MATLAB or DLT coefficients.

    Args:
        path: file, or folder of files with one camera each.
        unit: mm, cm or m: unit of the lengths in a file that does not state it.
        image_sizes: width and height [px] by camera, in the order of the file; needed if the file does not tell them,
            or has no names for its cameras.

    Raises:
        InputError: the file cannot be read, or something in it or missing from it must be decided by you.
    """
    return read_any_calibration(Path(path), unit, lambda _: image_sizes or {})


def track(
    videos: str | Path,
    calibration: str | Path,
    specimen: str | Path | None = None,
    *,
    calibration_unit: str | None = None,
    fps: float | None = None,
    fill: int = 5,
    sync: bool = False,
) -> dict[str, Tracks]:
    """Track the markers of every recording.

    Args:
        videos: folder of videos (`<recording>/<camera>.mp4`), or one video.
        calibration: `calib.yaml`, or a calibration of another program, see `read_calibration`.
        specimen: specimen description that names the markers; None to name them by row and column.
        calibration_unit: mm, cm or m: unit of the lengths in a calibration that does not state it.
        fps: true frames per second; None to trust the videos.
        fill: longest gap to fill [frames].
        sync: find the time offsets of the cameras from the motion.

    Returns:
        Tracks by recording: positions [m] with sigma, over time [s].

    Raises:
        InputError: a file cannot be read, or a recording cannot be tracked.
    """
    rig = read_any_calibration(Path(calibration), calibration_unit, lambda count: filmed_cameras(Path(videos), count))
    layout = read_layout(Path(specimen)) if specimen else None
    rig = with_face_planes(rig, layout) if layout else rig
    settings = TrackingSettings(layout, fps, fill, sync)
    recordings = find_recordings(Path(videos), rig, Path(calibration))
    return {name: track_recording(sources, rig, settings, lambda: None) for name, sources in recordings.items()}


def build_dataset(
    specimen: str | Path, tracks: str | Path, recordings: str | Path, settings: CaptureSettings | None = None
) -> Dataset:
    """Build a dataset: register recordings to the specimen, embed the markers in the mesh, fit the first frames.

    Args:
        specimen: specimen description.
        tracks: folder of tracks (.h5), motion capture (.c3d) or arrays (q0.npy, ...).
        recordings: `recordings.csv` with the columns recording, load_g, split.
        settings: how first frames are fitted and what is tolerated; the defaults if None.

    Raises:
        InputError: a file cannot be read, or a recording does not fit the specimen.
        SimulationError: the first frame of a recording could not be fitted.
    """
    described = read_specimen(Path(specimen))
    rows = read_recording_rows(Path(recordings))
    recipe = f"{described.text}\n# recordings.csv\n{Path(recordings).read_text(encoding='utf-8')}"
    return build(described, Path(tracks), rows, settings or CaptureSettings(), recipe, lambda: None)


def simulate(
    dataset: Dataset, model: FittedModel | ResidualModel | None = None, recordings: Sequence[str] | None = None
) -> dict[str, Simulation]:
    """Simulate recordings of a dataset from their first frames.

    Args:
        dataset: gives the mesh, the material and the first frames.
        model: fitted model, or a residual model of your own; None for the baseline simulator.
        recordings: names; all if None.

    Raises:
        InputError: the model is not applicable to this mesh.
        SimulationError: a step did not converge; the message names it.
    """
    chosen = _fitted(model)
    names = list(dataset.trajectories) if recordings is None else list(recordings)
    simulator = chosen.simulator(dataset.simulator)
    batch = Recordings.of(dataset, names).in_simulator(simulator)
    with torch.no_grad():
        vertices, _ = batch.simulate_vertices(chosen.residual(simulator), chosen.parameters(simulator))
        markers = dataset.markers.positions(vertices)
    result = {}
    for b, name in enumerate(names):
        time = dataset.trajectories[name].time
        frames = len(time)
        result[name] = Simulation(
            time, vertices[:frames, b].numpy(), markers[:frames, b].numpy(), dataset.markers.names
        )
    return result


def predict(
    specimen: Specimen,
    model: FittedModel | ResidualModel | None = None,
    *,
    load_g: float,
    frames: int = 100,
    fps: float = 100.0,
) -> Simulation:
    """Predict the motion of a specimen that is let go from rest under a tip load.

    The specimen need not have been filmed: the model was fitted on others. The motion starts in the equilibrium under
    gravity, the load and the model's residual force.

    Args:
        specimen: shape, markers and assumed material.
        model: fitted model, or a residual model of your own; None for the baseline simulator.
        load_g: mass that hangs on the tip until the release [g].
        frames: number of frames, the release included.
        fps: frames per second, and the time step of the simulation. Keep the frame rate of the training recordings:
            numerical damping depends on the time step, and so does what a field has learned to compensate.

    Raises:
        InputError: an argument is out of range, the model is not applicable to this mesh, or a marker is off the
            surface by more than 2 mm.
        SimulationError: no equilibrium under the load, or a step did not converge.
    """
    if not (0 <= load_g < np.inf and frames >= 2 and 0 < fps < np.inf):
        raise InputError(
            f"expected a load of at least 0 g, 2 frames and a positive frame rate, found {load_g:g} g, "
            f"{frames} frames, {fps:g} frames/s"
        )
    chosen = _fitted(model)
    simulator = chosen.simulator(specimen.simulator(1.0 / fps))
    residual, parameters = chosen.residual(simulator), chosen.parameters(simulator)
    markers = specimen.markers(2e-3)
    load = torch.from_numpy(load_force(simulator, specimen.loaded, 1e-3 * load_g))[None]
    none = torch.zeros_like(load)
    with torch.no_grad():
        start = _loaded_shape(simulator, load, residual, parameters)
        state = Start(start, none, none, none[..., 0], (f"load {load_g:g} g",))
        vertices = rollout(simulator, state, frames - 1, residual, parameters)[0]
        positions = markers.positions(vertices)
    time = simulator.time_step * np.arange(frames)
    return Simulation(time, vertices[:, 0].numpy(), positions[:, 0].numpy(), markers.names)


def _loaded_shape(
    simulator: Simulator, load: torch.Tensor, residual: ResidualForce | None, parameters: Parameters
) -> torch.Tensor:
    """Equilibrium (1, N, 3) [m] under gravity, a load (1, N, 3) [N] and the residual force, by fixed-point steps.

    Raises:
        SimulationError: the steps do not converge.
    """
    shape = equilibrium(simulator, load, parameters, label="load at rest")
    if residual is None:
        return shape
    external = load + torch.from_numpy(simulator.weight)
    at_rest = torch.zeros_like(shape)
    for _ in range(EQUILIBRIUM_STEPS):
        force = load + residual(shape, at_rest, external)
        moved = equilibrium(simulator, force, parameters, label="load at rest with the residual force")
        change = float((moved - shape).norm(dim=-1).max())
        shape = moved
        if change < EQUILIBRIUM_TOLERANCE:
            return shape
    raise SimulationError(
        f"no equilibrium under the load: vertices still move by {1e3 * change:.2g} mm in fixed-point step "
        f"{EQUILIBRIUM_STEPS}; use a smaller load, or the baseline simulator"
    )


def evaluate(models: Mapping[str, FittedModel | ResidualModel], datasets: Sequence[Dataset]) -> pd.DataFrame:
    """The paper's error of the baseline simulator (`original`) and of models on recorded motions.

    Args:
        models: fitted models, or residual models of your own, by the name that the table shows.
        datasets: recorded motions.

    Returns:
        One row per dataset, recording and method: mean marker error and its standard deviation over frames [mm].

    Raises:
        InputError: a model is not applicable to a mesh.
        SimulationError: a step did not converge; the message names it.
    """
    fitted = {name: _fitted(model) for name, model in models.items()}
    return error_table([item for dataset in datasets for item in compare(dataset, fitted)])


def _fitted(model: FittedModel | ResidualModel | None) -> FittedModel:
    """The model to simulate with, whatever it is given as."""
    if model is None:
        return FittedModel("original")
    return model if isinstance(model, FittedModel) else FittedModel("own", own=model)
