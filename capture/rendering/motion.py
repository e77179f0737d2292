"""Simulated releases of a specimen: the motion that synthetic recordings show."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.capture.specimen.specimen import Specimen

from rafl.data.synthetic import hung, let_go, twisted
from rafl.fem.material import Material
from rafl.simulation.simulator import Simulator

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


def tip_load_release(specimen: Specimen, material: Material, load: float, frames: int, fps: float) -> Motion:
    """Released from rest under a tip load [kg]."""
    simulator = specimen.simulator(1.0 / fps, material)
    starts = hung(simulator, specimen.loaded, np.array([load]))
    return _motion(f"load{1e3 * load:03.0f}g", load, simulator, starts, frames)


def twist_release(specimen: Specimen, material: Material, angle: float, frames: int, fps: float) -> Motion:
    """Released from a twist about the x axis, growing linearly to `angle` [rad] at the tip."""
    simulator = specimen.simulator(1.0 / fps, material)
    name = f"twist{np.degrees(angle):03.0f}deg"
    return _motion(name, 0.0, simulator, twisted(specimen.mesh, np.array([angle])), frames)


def _motion(name: str, load: float, simulator: Simulator, starts: Array, frames: int) -> Motion:
    time = simulator.time_step * np.arange(frames)
    return Motion(name, load, time, let_go(simulator, starts, frames, (name,))[:, 0])
