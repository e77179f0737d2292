"""Simulated releases of a specimen, for synthetic recordings."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.specimen.specimen import Specimen
from rafl.data.synthetic import loaded_equilibria, simulate_release, twisted_shapes
from rafl.fem.material import Material
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]


@dataclass(frozen=True)
class SimulatedMotion:
    """Motion of one synthetic recording.

    Attributes:
        name: of the recording.
        load: released tip load [kg].
        time: [s], (T).
        q: node positions [m], (T, N, 3); frame 0 is the moment of release.
    """

    name: str
    load: float
    time: Array
    q: Array


def tip_load_release(specimen: Specimen, material: Material, load: float, frames: int, fps: float) -> SimulatedMotion:
    """Motion after the release of a tip load [kg], from rest."""
    simulator = specimen.simulator(1.0 / fps, material)
    starts = loaded_equilibria(simulator, specimen.loaded, np.array([load]))
    return _simulate(f"load{1e3 * load:03.0f}g", load, simulator, starts, frames)


def twist_release(specimen: Specimen, material: Material, angle: float, frames: int, fps: float) -> SimulatedMotion:
    """Motion after the release of a twist about the x axis, which grows linearly to `angle` [rad] at the tip."""
    simulator = specimen.simulator(1.0 / fps, material)
    name = f"twist{np.degrees(angle):03.0f}deg"
    return _simulate(name, 0.0, simulator, twisted_shapes(specimen.mesh, np.array([angle])), frames)


def _simulate(name: str, load: float, simulator: Simulator, starts: Array, frames: int) -> SimulatedMotion:
    time = simulator.time_step * np.arange(frames)
    return SimulatedMotion(name, load, time, simulate_release(simulator, starts, frames, (name,))[:, 0])
