"""Recordings of a box at rest whose dots are at known places."""

import functools
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from synthetic_tracks import tracks_of_pixels

from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import Rig
from rafl.capture.description.specimen_text import body_of_box
from rafl.capture.registration.recording import Recording
from rafl.capture.specimen.specimen import Body, Specimen, build_specimen
from rafl.data.markers import embed
from rafl.data.synthetic import with_material
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.tracks import Tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels

SIZE_MM = (100.0, 20.0, 20.0)
FRAMES = 12
SIDES = np.array([(x, y, z) for y in (0, 20) for z in (14, 6) for x in range(10, 100, 12)], dtype=float)
TOP_AND_TIP = np.array(
    [*((x, y, 20) for y in (6, 14) for x in range(10, 100, 12)), *((100, y, z) for y in (5, 15) for z in (5, 15))],
    dtype=float,
)


def box_body() -> Body:
    """The box."""
    return body_of_box("box", SIZE_MM, None)


@functools.cache
def _specimen() -> Specimen:
    return build_specimen(box_body(), MarkerLayout.of([]), Path(), "")


@functools.cache
def _sagging(stiffness: float) -> np.ndarray:
    simulator = _specimen().simulator(0.01)
    true = with_material(simulator, stiffness * simulator.material.youngs_modulus, 0.49)
    return true.equilibrium(true.weight[None])[0]


def still(places_mm: np.ndarray, stiffness: float = 1.0, lying: bool = False) -> Recording:
    """A recording of the box, that is `stiffness` times as stiff as assumed, with dots at `places_mm` (M, 3).

    As one camera sees them, dots on the sides have an assumed y, with a sigma of 0.5 mm.
    """
    mesh = _specimen().mesh
    q = mesh.vertices if lying else _sagging(stiffness)
    names = tuple(f"left-r1c{number + 1}" for number in range(len(places_mm)))
    position = embed(mesh, names, 1e-3 * places_mm).positions(torch.from_numpy(q)).numpy()
    sigma = np.full_like(position, 2e-5)
    on_side = np.isin(places_mm[:, 1], (0.0, SIZE_MM[1]))
    position[on_side, 1], sigma[on_side, 1] = 1e-3 * places_mm[on_side, 1], 5e-4
    noise = np.random.default_rng(1).normal(0.0, 1e-5, (FRAMES, *position.shape))
    time = np.arange(FRAMES) / 100.0
    return Recording(names, time, position + noise, np.repeat(sigma[None], FRAMES, axis=0), None, True, "still.h5")


LEFT, RIGHT = (
    OrthographicCamera(
        image_size=(640, 240),
        scale=(5000.0, 5000.0),
        rotation_vector=tuple(Rotation.from_matrix(axes).as_rotvec().tolist()),
        offset=(320.0 - 5000.0 * 0.05 * axes[0][0], 100.0),
        plane=Plane((0.0, axes[2][1], 0.0), axes[2][1] * y, 5e-4),
    )
    for axes, y in (([[1, 0, 0], [0, 0, -1], [0, 1, 0]], 0.0), ([[-1, 0, 0], [0, 0, -1], [0, -1, 0]], 0.02))
)
STILL_RIG = Rig({"left": LEFT, "right": RIGHT})


def still_tracks(places_mm: np.ndarray = SIDES) -> Tracks:
    """The tracks of the sagging box, of which a camera sees the left and another one the right side."""
    recording = still(places_mm)
    pixels = {}
    for name, y in (("left", 0.0), ("right", SIZE_MM[1])):
        seen = (places_mm[:, 1] == y)[:, None]
        path = np.where(seen, STILL_RIG.cameras[name].project(recording.position), np.nan)
        pixels[name] = CameraPixels(path, np.where(seen, 0.02, np.full_like(path, np.nan)))
    assert recording.names is not None
    return tracks_of_pixels(recording.names, STILL_RIG, pixels, longest_gap=5)


def corner_pixels(camera: str) -> np.ndarray:
    """Pixels of the corners of the side that a camera films, as the box sags: at the clamp, then at the tip, (4, 2)."""
    vertices, q = _specimen().mesh.vertices, _sagging(1.0)
    y = 0.0 if camera == "left" else 1e-3 * SIZE_MM[1]
    ends = [(x, y, z) for x in (0.0, 1e-3 * SIZE_MM[0]) for z in (1e-3 * SIZE_MM[2], 0.0)]
    nodes = [int(np.linalg.norm(vertices - end, axis=1).argmin()) for end in ends]
    return np.asarray(STILL_RIG.cameras[camera].project(q[nodes]))
