"""A camera turned by 0.2 degrees after its calibration, and a clock that is late by 0.3 frame: are they found?

    python tests/bench/moved_cameras.py [--out build/moved_cameras] [--frames 60] [--seeds 1]

The recordings are those of image_objective.py, after ten frames at rest. The last camera of a rig is turned about a
random axis; with two cameras its clock is late. `z` is the largest error of a turn or a clock over its standard
deviation; the first frame is that of the recording that is not used to find the cameras.
"""

import argparse
import itertools
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from image_objective import FPS, RIGS, distance, front_specimen, motions, write_recordings
from rich.console import Console
from scipy.interpolate import CubicSpline

from rafl.calibration.camera import OrthographicCamera
from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.registration.camera_change import CameraChange
from rafl.common.command_line import create_table

STILL, TURN, LATE = 10, np.radians(0.2), 0.3  # frames at rest, [rad], [frames]


@dataclass(frozen=True)
class Touched:
    """A rig of which one camera was touched.

    Attributes:
        cameras: as calibrated.
        name: of the touched camera, the last.
        change: of it.
    """

    cameras: dict[str, OrthographicCamera]
    name: str
    change: CameraChange

    @classmethod
    def of(cls, rig: str, centre: np.ndarray, seed: int) -> "Touched":
        """A rig turned about a random axis; late if another camera tells."""
        axis = np.random.default_rng(100 + seed).normal(size=3)
        late = LATE / FPS if len(RIGS[rig]) > 1 else 0.0
        value = np.concatenate([TURN * axis / np.linalg.norm(axis), np.zeros(3), [late]])
        return cls(RIGS[rig], list(RIGS[rig])[-1], CameraChange(value, centre))

    def film(self, name: str, exact: np.ndarray) -> np.ndarray:
        """Pixels of a body that rests before it moves as given, (T + STILL, M, 2)."""
        touched = name == self.name
        late = FPS * self.change.value[6] if touched else 0.0
        frames = np.arange(len(exact) + STILL) - STILL - late
        path = CubicSpline(np.arange(len(exact)), exact)(np.maximum(frames, 0.0))
        camera = self.cameras[name]
        return (self.change.moved(camera) if touched else camera).project(path)

    def largest_z(self, attributes: dict[str, object]) -> float:
        """The largest error of a turn or a clock over its standard deviation."""
        largest = 0.0
        for name in self.cameras:
            found = np.asarray(attributes[f"camera_change_{name}"], dtype=float)
            true = self.change.value if name == self.name else np.zeros(7)
            own = [0, 1, 2, 6]
            largest = max(largest, float(np.abs((found[:7] - true)[own] / found[7:14][own]).max()))
        return largest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60, help="of each recording after its release [60]")
    parser.add_argument("--out", type=Path, default=Path("build/moved_cameras"), help="for recordings")
    parser.add_argument("--seeds", type=int, default=1, help="number of axes and of sets of the pixels' errors [1]")
    options = parser.parse_args()
    torch.set_num_threads(1)
    whole = front_specimen()
    specimen = replace(whole, material=replace(whole.material, integration="enhanced"))
    centre = specimen.markers(1e-6).rest.mean(axis=0)
    table = create_table("release", "cameras", "turn", "found [degrees]", "clock [frames]", "z", "first frame [mm]")
    releases = motions(specimen, options.frames)
    for (kind, motion), rig, seed in itertools.product(releases.items(), RIGS, range(options.seeds)):
        touched = Touched.of(rig, centre, seed)
        folder = options.out / f"{kind} {rig} {seed}".replace(" ", "-")
        shutil.rmtree(folder, ignore_errors=True)
        rows = write_recordings(folder, specimen, motion, dict(touched.cameras), True, seed, touched.film)
        settings = CaptureSettings(start=STILL, initial="rest", fit_tolerance=2e-2)
        before, after = (
            build_dataset(specimen, folder, rows, replace(settings, refine_cameras=refine), "", lambda: None)
            for refine in (False, True)
        )
        first = [distance(item.trajectories["b"].q, motion[0, 1]) for item in (before, after)]
        attributes = after.trajectories["b"].attributes
        found = np.asarray(attributes[f"camera_change_{touched.name}"], dtype=float)
        turns = zip(np.degrees(found[:3]), np.degrees(found[7:10]), strict=True)
        table.add_row(
            kind,
            rig,
            ", ".join(f"{angle:.3f}" for angle in np.degrees(touched.change.value[:3])),
            ", ".join(f"{angle:.3f} +- {sigma:.3f}" for angle, sigma in turns),
            f"{FPS * found[6]:.4f} +- {FPS * found[13]:.4f}",
            f"{touched.largest_z(attributes):.1f}",
            f"{first[0]:.3f} -> {first[1]:.3f}",
        )
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
