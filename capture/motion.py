"""Simulated releases of a specimen: the motion that synthetic recordings show."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from capture.specimen import Specimen
from rafl.material import Material
from rafl.rollout import Start, rollout
from rafl.simulator import GRAVITY, Simulator

Array = NDArray[Any]


@dataclass(frozen=True)
class Motion:
    """A simulated recording.

    Attributes:
        name: of the recording.
        load: what hung on the tip before the release [kg].
        time: [s], (T).
        q: mesh positions [m], (T, N, 3); frame 0 is the moment of release.
    """

    name: str
    load: float
    time: Array
    q: Array


def tip_force(specimen: Specimen, load: float) -> Array:
    """Nodal forces [N], (N, 3), of a load [kg] shared by the loaded nodes."""
    force = np.zeros_like(specimen.mesh.vertices)
    force[specimen.loaded] = load * np.asarray(GRAVITY) / len(specimen.loaded)
    return force


def tip_load_release(specimen: Specimen, material: Material, load: float, frames: int, fps: float) -> Motion:
    """Released from rest under a tip load [kg]."""
    simulator = specimen.simulator(1.0 / fps, material)
    q = simulator.equilibrium((simulator.weight + tip_force(specimen, load))[None])
    return _released(f"load{1e3 * load:03.0f}g", load, simulator, q, frames)


def twist_release(specimen: Specimen, material: Material, angle: float, frames: int, fps: float) -> Motion:
    """Released from a twist about the x axis, growing linearly to `angle` [rad] at the tip."""
    vertices = specimen.mesh.vertices
    x = vertices[:, 0] / np.ptp(vertices[:, 0])
    centre = 0.5 * (vertices.min(0) + vertices.max(0))
    y, z = (vertices - centre)[:, 1:].T
    cos, sin = np.cos(angle * x), np.sin(angle * x)
    q = np.stack([vertices[:, 0], centre[1] + cos * y - sin * z, centre[2] + sin * y + cos * z], axis=1)
    name = f"twist{np.degrees(angle):03.0f}deg"
    return _released(name, 0.0, specimen.simulator(1.0 / fps, material), q[None], frames)


def _released(name: str, load: float, simulator: Simulator, q: Array, frames: int) -> Motion:
    start = Start(
        torch.from_numpy(q),
        torch.zeros(q.shape, dtype=torch.float64),
        torch.zeros(q.shape, dtype=torch.float64),
        torch.zeros(q.shape[:2], dtype=torch.float64),
        (name,),
    )
    with torch.no_grad():
        positions, _ = rollout(simulator, start, frames - 1)
    return Motion(name, load, simulator.time_step * np.arange(frames), positions[:, 0].numpy())
