"""A small laboratory: one good file of every format that the commands read."""

import io
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import stereo
import torch
import trimesh
import yaml
from filmed_markers import filmed, pinhole_camera, side_camera
from scipy.interpolate import CubicSpline
from support import SMALL_SPECIMEN, draw_frame

from rafl.batch.state import Book, State, Status
from rafl.batch.unit import create_unit
from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import Rig, rig_text, write_calibration
from rafl.capture.specimen.specimen import read_specimen
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.dataset_file import write_dataset
from rafl.data.markers import Markers
from rafl.data.synthetic import loaded_equilibria, simulate_release
from rafl.fem.material import Material
from rafl.fitting.run_folder import FittedModel, save_model
from rafl.residual.acceleration_field import ResidualField
from rafl.simulation.simulator import Simulator
from rafl.tracking.reconstruction.corrections import (
    Accept,
    Delete,
    Place,
    Swap,
    corrections_path,
    path_text,
    write_corrections,
)
from rafl.tracking.reconstruction.export import WRITERS
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks, write_tracks

FRAMES = 8
SIZE = (200, 160)  # of the video [px]
LOADS = {"take1": 0.04, "take2": 0.06, "take3": 0.08}  # [kg]
SPLITS = dict(zip(LOADS, ("train", "val", "test"), strict=True))

SPECIMEN = (
    SMALL_SPECIMEN.replace("element_mm: 10", "element_mm: 20")
    + """  - {name: L, face: y-min, at_mm: [10, 0, 14], rows: 2, columns: 4, spacing_mm: [12, 8]}
  - {name: R, face: y-max, at_mm: [10, 20, 14], rows: 2, columns: 4, spacing_mm: [12, 8]}
"""
)
BOARD = """format: rafl-board/1
pattern: {kind: charuco, squares: [9, 6], square_mm: 10.0, marker_mm: 7.5, dictionary: DICT_4X4_250}
simultaneous: false
world:
  left/00.png: {origin_mm: [0, 0, 0], x_axis: [1, 0, 0], y_axis: [0, 0, -1]}
moved:
- {from: left/00.png, to: left/01.png, along: [0, -1, 0]}
"""
PLAN = """format: rafl-sweep/1
datasets: [data.h5]
methods: [sysid-e, {method: rafl, name: field, options: {epochs: [1, 2], learning-rate: 1e-3, by-sigma: true}}]
seeds: [0, 1]
options: {frames: 4}
evaluate: all
"""
CLUSTER = """format: rafl-cluster/1
partition: short
minutes: 30
memory_gb: 2.5
setup: [module load python]
options: {nice: 10}
"""


def make_laboratory(folder: Path) -> None:
    """Write all files into a new folder."""
    folder.mkdir(parents=True)
    (folder / "small.yaml").write_text(SPECIMEN)
    (folder / "board.yaml").write_text(BOARD)
    (folder / "recordings.csv").write_text("recording,load_g,split,first_frame\ntake1,40,train,0\ntake2,60,val,0\n")
    (folder / "names.csv").write_text("file,specimen\nL1,L1\nL2,L2\n")
    trimesh.creation.box((40.0, 20.0, 20.0)).export(folder / "body.stl")
    (folder / "body.yaml").write_text(
        SPECIMEN.replace("{box_mm: [60, 20, 20], element_mm: 20}", "{surface: body.stl, element_mm: 10}")
    )
    (folder / "plan.yaml").write_text(PLAN)
    (folder / "cluster.yaml").write_text(CLUSTER)
    _write_units(folder)
    _write_motions(folder)
    _write_video(folder)
    _write_foreign(folder)


def _write_units(folder: Path) -> None:
    """A list of two units, of which one has failed."""
    units = [create_unit(name, ["rafl-fit", "data.h5"], [f"{name}.pt"], ["data.h5"]) for name in ("one", "two")]
    book = Book(folder / "sweep" / "units", Path("."))
    book.write_units(units)
    state = State(
        status=Status.failed,
        command=units[0].command,
        inputs={"data.h5": (10, 20)},
        attempts=2,
        host="node1",
        job="12_3",
        started=datetime(2026, 1, 2, tzinfo=UTC),
        seconds=2.5,
        reason="expected more, found less",
    )
    book.write_state("one", state)


def _write_foreign(folder: Path) -> None:
    """Calibrations of other programs, and images."""
    (folder / "stereo.toml").write_text(stereo.aniposelib_text())
    stereo.write_opencv(folder / "left.yml", stereo.opencv_values("left"))
    stereo.write_matlab_stereo(folder / "stereo.mat")
    stereo.write_dlt(folder / "dlt.csv")
    image = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    for name in ("board.png", "board.jpg"):
        cv2.imwrite(str(folder / name), image)


def _write_motions(folder: Path) -> None:
    """Tracks of all formats, a dataset, and a model."""
    specimen = read_specimen(folder / "small.yaml")
    true = specimen.simulator(0.01, Material(190e3, 0.45, mass="lumped", law="corotated"))
    markers = specimen.markers(1e-6)
    starts = loaded_equilibria(true, specimen.loaded, np.array(list(LOADS.values())))
    motion = torch.from_numpy(simulate_release(true, starts, FRAMES, tuple(LOADS)))
    positions = markers.positions(motion).numpy().transpose(1, 0, 2, 3)
    for name, position in zip(LOADS, positions, strict=True):
        tracks = _tracks(markers.names, position)
        for kind, write in WRITERS.items():
            path = folder / kind / f"{name}.{kind}"
            path.parent.mkdir(exist_ok=True)
            write(path, tracks, {})
        write_tracks(folder / "tracks" / f"{name}.h5", tracks)
    _write_corrections(folder / "tracks" / "take1.h5")
    write_dataset(folder / "data.h5", _filmed(_dataset(specimen.simulator(0.01), markers, starts, positions)))
    save_model(folder / "field", FittedModel("rafl", ResidualField(), {"youngs_modulus": 160e3}))


def _write_corrections(path: Path) -> None:
    """One correction of every kind."""
    first, second, *_ = read_tracks(path).names
    who: dict[str, Any] = {"by": "Ann", "camera": "front"}
    times = [datetime(2026, 1, 1, 0, minute, tzinfo=UTC) for minute in range(6)]
    dot = path_text(np.array([2, 3]), np.full((2, 2), 40.0), np.full((2, 2), 0.1))
    entries = (
        Swap(**who, at=times[0], tracks="e" * 64, markers=(first, second), first=3),
        Swap(**who, at=times[1], markers=(first, second), first=3),
        Place(**who, at=times[2], marker="new", new=True, how="hand", path=dot),
        Delete(**who, at=times[3], marker="new", first=2, last=3),
        Accept(**who, at=times[4], marker=second, first=1, last=2),
        Delete(**who | {"camera": "late"}, at=times[5], marker=first, first=2, last=3),
    )
    write_corrections(corrections_path(path), entries)


def _tracks(names: tuple[str, ...], position: np.ndarray) -> Tracks:
    """Tracks of two cameras, which saw positions (T, M, 3); the clock of one is late."""
    frames, count = position.shape[:2]
    cameras = {"front": _camera(), "late": side_camera(0.3)}
    time, late = 0.01 * np.arange(frames), 0.004
    own = CubicSpline(time, position)(time + late)

    def each(value: np.ndarray) -> dict[str, np.ndarray]:
        return dict.fromkeys(cameras, value)

    return Tracks(
        names=names,
        time=time,
        position=position,
        sigma=np.full_like(position, 1e-5),
        state=np.ones((frames, count), np.uint8),
        pixel={name: camera.project(position) for name, camera in cameras.items()},
        residual=each(np.zeros((frames, count))),
        pixel_sigma=each(np.full((frames, count, 2), 0.02)),
        damaged=each(np.zeros(frames, dtype=bool)),
        frame=each(np.arange(frames)),
        images={"front": {0: b"no image"}, "late": {}},
        fps=100.0,
        calibration=rig_text(Rig(dict(cameras))),
        sources={"front.mp4": "0" * 64},
        settings="of a test",
        lag={"late": np.full(frames, late)},
        filmed_time={"late": time + late},
        filmed_pixel={"late": cameras["late"].project(own)},
        filmed_sigma={"late": np.full((frames, count, 2), 0.02)},
    )


def _dataset(simulator: Simulator, markers: Markers, starts: np.ndarray, positions: np.ndarray) -> Dataset:
    zeros = np.zeros_like(simulator.mesh.vertices)
    seen = np.ones(positions.shape[1:3], dtype=bool)
    sigma = np.full(positions.shape[1:], 1e-5)
    items = {
        name: Trajectory(
            0.01 * np.arange(FRAMES), positions[k], seen, sigma, starts[k], *(zeros,) * 3, zeros[:, 0], SPLITS[name],
            {"load_g": 1e3 * load, "still_frames": 0, "registration": "calibration"},
        )
        for k, (name, load) in enumerate(LOADS.items())
    }  # fmt: skip
    return Dataset("small", simulator, markers, items, "of a test")


def _filmed(dataset: Dataset) -> Dataset:
    """The dataset with the pixels of two cameras; the clamp of the last recording moves."""
    cameras = {"left": side_camera(0.3, (0.02, -0.01)), "pin": pinhole_camera(0.5)}
    last, found = list(LOADS)[-1], filmed(dataset, cameras).trajectories
    return replace(dataset, trajectories=found | {last: filmed(dataset, cameras, moving=True).trajectories[last]})


def _camera() -> OrthographicCamera:
    plane = Plane((0.0, 0.0, 1.0), 0.0, 5e-4)
    return OrthographicCamera(image_size=SIZE, scale=(1e4, 1e4), rotation_vector=(0.0, 0.0, 0.0), plane=plane)


def _write_video(folder: Path) -> None:
    """A video of twelve dots, with its calibration and layout."""
    content = io.BytesIO()
    with av.open(content, "w", format="mp4") as output:
        stream = output.add_stream("libx264", rate=100)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for frame in range(FRAMES):
            dots = [(40.0 + 30 * i + frame, 40.0 + 35 * j, 6.0, 6.0, 0.0) for i in range(4) for j in range(3)]
            image = av.VideoFrame.from_ndarray(draw_frame(dots, SIZE, noise=1.0, seed=frame), format="gray")
            output.mux(stream.encode(image.reformat(format="yuv420p")))
        output.mux(stream.encode())
    (folder / "videos").mkdir()
    (folder / "videos" / "take1.mp4").write_bytes(content.getvalue())
    write_calibration(folder / "calib.yaml", Rig({"front": _camera()}))
    markers = [{"name": f"m{i}{j}", "at_mm": [4.0 + 3 * i, 4.0 + 3.5 * j, 0.0]} for i in range(4) for j in range(3)]
    (folder / "dots.yaml").write_text(yaml.safe_dump({"format": "rafl-specimen/1", "markers": markers}))
