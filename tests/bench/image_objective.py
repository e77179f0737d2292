"""One camera or two, compared in the image plane and in space: first frames, free runs and E against the truth.

    python tests/bench/image_objective.py [--out build/image_objective] [--frames 60]

The canonical beam is released from a twist of 60 degrees, from a load that pulls it sideways too, and from loads in the
plane of the camera. One camera faces the side with the markers; the two others stand 45 degrees to either side of it.
Compared in space, a marker that one camera sees lies in the plane of the undeformed face, as its calibration assumes.
"""

import argparse
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import Camera, OrthographicCamera, Plane
from rafl.calibration.rig import Rig
from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.command_line import create_table
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.data.synthetic import load_force, simulate_release, twisted_shapes, with_material
from rafl.fitting.methods import METHODS
from rafl.fitting.run_folder import Settings
from rafl.simulation.simulator import Simulator
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.tracks import write_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))
from synthetic_tracks import tracks_of_pixels

SPECIMEN = Path(__file__).parents[2] / "datasets/specimens/canonical.yaml"
FPS, SIGMA_PX, PIXELS_PER_METRE = 100.0, 0.02, 9000.0
STIFFNESS = 0.8  # true Young's modulus over that assumed
EPOCHS = 15
IN_SPACE, IN_IMAGE = "in space", "in the image plane"


def camera(angle: float, plane: bool) -> OrthographicCamera:
    """A camera that looks along y, turned about z by an angle [rad], with the plane y = 0 if asked for."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    rotation = axes @ Rotation.from_rotvec([0.0, 0.0, -angle]).as_matrix()
    return OrthographicCamera(
        image_size=(1280, 720),
        rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec().tolist()),
        scale=(PIXELS_PER_METRE, PIXELS_PER_METRE),
        offset=(200.0, 500.0),
        plane=Plane((0.0, -1.0, 0.0), 0.0, 5e-4) if plane else None,
    )


RIGS = {
    "one camera": {"front": camera(0.0, True)},
    "two cameras": {"left": camera(-np.pi / 4, False), "right": camera(np.pi / 4, False)},
}


def front_layout(specimen: Specimen) -> MarkerLayout:
    """The markers of one side of a beam only, at exact places."""
    front = specimen.layout.positions[:, 1] == 0.0
    names = tuple(name for name, own in zip(specimen.layout.names, front, strict=True) if own)
    return MarkerLayout(names, specimen.layout.positions[front], 0.0)


def front_specimen() -> Specimen:
    """The canonical beam with the markers of one side only."""
    whole = read_specimen(SPECIMEN)
    return replace(whole, layout=front_layout(whole))


def held_twist(simulator: Simulator, specimen: Specimen, angles: np.ndarray) -> np.ndarray:
    """Equilibria [m], (B, N, 3), of which a hand holds the tip turned about x by angles (B) [rad]."""
    held = replace(simulator, fixed=np.union1d(simulator.fixed, specimen.loaded))
    start = twisted_shapes(specimen.mesh, angles)
    weight = np.broadcast_to(simulator.weight, start.shape).copy()
    state = held.constitutive_state(len(angles))
    return held.minimise(start.copy(), np.zeros(start.shape[:2]), start, weight, state, "held twist")


def motions(specimen: Specimen, frames: int) -> dict[str, np.ndarray]:
    """True node positions [m], (T, B, N, 3), of every kind of release."""
    simulator = specimen.simulator(1.0 / FPS)
    true = with_material(simulator, STIFFNESS * simulator.material.youngs_modulus, 0.45)
    down = np.stack([load_force(true, specimen.loaded, load) for load in (0.04, 0.08)])
    sideways = down.copy()
    sideways[..., 1] = 0.7 * down[..., 2]
    starts = {
        "twist": held_twist(true, specimen, np.radians([40.0, 60.0])),
        "sideways": true.equilibrium(true.weight + sideways, label="sideways loads"),
        "in the plane": true.equilibrium(true.weight + down, label="loads"),
    }
    return {kind: simulate_release(true, own, frames, ("a", "b")) for kind, own in starts.items()}


def write_recordings(
    folder: Path,
    specimen: Specimen,
    motion: np.ndarray,
    cameras: dict[str, Camera],
    with_pixels: bool,
    seed: int,
    film: Callable[[str, np.ndarray], np.ndarray] | None = None,
) -> list[RecordingRow]:
    """Write the tracks of two recordings; those without pixels are what positions alone tell.

    film: exact pixels of a camera from exact positions (T, M, 3) [m]; those of the calibrated cameras if None.
    """
    markers, random, rig = specimen.markers(1e-6), np.random.default_rng(seed), Rig(dict(cameras))
    rows = []
    for b, (name, split) in enumerate((("a", "train"), ("b", "test"))):
        exact = markers.positions(torch.from_numpy(motion[:, b])).numpy()
        pixels = {}
        for key, own in cameras.items():
            pixel = own.project(exact) if film is None else film(key, exact)
            pixel = pixel + random.normal(0.0, SIGMA_PX, pixel.shape)
            pixels[key] = CameraPixels(pixel, np.full_like(pixel, SIGMA_PX))
        tracks = tracks_of_pixels(markers.names, rig, pixels, FPS)
        write_tracks(folder / f"{name}.h5", tracks if with_pixels else replace(tracks, calibration=""))
        rows.append(RecordingRow(recording=name, load_g=0, split=split))
    return rows


def free_run(dataset: Dataset, run: Path, frames: int) -> tuple[np.ndarray, float]:
    """Vertices of the test recording [m], (T, N, 3), after system identification, and E [Pa]."""
    shutil.rmtree(run, ignore_errors=True)
    run.mkdir(parents=True)
    settings = Settings("sysid", (dataset.name,), EPOCHS, 0.0, 0.0, 0, frames, 0)
    model = METHODS["sysid"]([dataset], settings, run, lambda row: None)
    with torch.no_grad():
        vertices, _ = Recordings.of(dataset, ["b"]).simulate_vertices(parameters=model.parameters(dataset.simulator))
    table = pd.read_csv(run / "parameters.csv").set_index("name")
    return vertices[:, 0].numpy(), float(table.loc["youngs_modulus", "value"])


def distance(found: np.ndarray, true: np.ndarray) -> float:
    """Root mean square distance of vertices [mm]."""
    return 1e3 * float(np.sqrt(((found - true) ** 2).sum(-1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60, help="of each recording [60]")
    parser.add_argument("--out", type=Path, default=Path("build/image_objective"), help="for recordings and runs")
    parser.add_argument("--seed", type=int, default=0, help="of the pixels' errors [0]")
    options = parser.parse_args()
    torch.set_num_threads(1)
    specimen = front_specimen()
    table = create_table("release", "cameras", "compared", "first frame [mm]", "free run [mm]", "E / true")
    for kind, motion in motions(specimen, options.frames).items():
        for rig, cameras in RIGS.items():
            for objective in (IN_SPACE, IN_IMAGE):
                folder = options.out / f"{kind} {rig} {objective}".replace(" ", "-")
                rows = write_recordings(
                    folder / "tracks", specimen, motion, dict(cameras), objective == IN_IMAGE, options.seed
                )
                settings = CaptureSettings(start=0, initial="rest", fit_tolerance=2e-2)
                dataset = build_dataset(specimen, folder / "tracks", rows, settings, "", lambda: None)
                vertices, modulus = free_run(dataset, folder / "run", options.frames)
                true = specimen.material.youngs_modulus * STIFFNESS
                first = distance(dataset.trajectories["b"].q, motion[0, 1])
                run = distance(vertices, motion[:, 1])
                table.add_row(kind, rig, objective, f"{first:.3f}", f"{run:.3f}", f"{modulus / true:.4f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
