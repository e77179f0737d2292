import numpy as np
import pytest
import torch

from rafl.capture.specimen.specimen import Specimen
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.synthetic import loaded_equilibria, simulate_release
from rafl.fem.material import Material

TRUE_MATERIAL = Material(190e3, 0.45, mass="lumped", law="corotated")
LOADS = {"a": 0.04, "b": 0.10, "c": 0.07, "d": 0.08}
SPLITS = {"a": "train", "b": "train", "c": "val", "d": "test"}
FRAMES = 25


@pytest.fixture(scope="session")
def dataset(small_specimen: Specimen) -> Dataset:
    """Exact marker positions of simulated releases; the true material differs from the assumed one."""
    simulator = small_specimen.simulator(0.01, TRUE_MATERIAL)
    markers = small_specimen.markers(1e-6)
    zeros = np.zeros_like(small_specimen.mesh.vertices)
    starts = loaded_equilibria(simulator, small_specimen.loaded, np.array(list(LOADS.values())))
    positions = markers.positions(torch.from_numpy(simulate_release(simulator, starts, FRAMES, tuple(LOADS)))).numpy()
    trajectories = {
        name: Trajectory(
            0.01 * np.arange(FRAMES),
            positions[:, k],
            np.ones((FRAMES, 20), dtype=bool),
            np.full((FRAMES, 20, 3), 1e-5),
            starts[k],
            zeros,
            zeros,
            zeros,
            zeros[:, 0],
            SPLITS[name],
            {"load_g": 1e3 * load},
        )
        for k, (name, load) in enumerate(LOADS.items())
    }
    return Dataset("small", small_specimen.simulator(0.01), markers, trajectories, "a test")
