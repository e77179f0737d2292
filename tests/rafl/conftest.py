import numpy as np
import pytest
import torch
from rafl.capture.specimen.specimen import Specimen

from rafl.data.dataset import Dataset, Trajectory
from rafl.data.synthetic import hung, let_go
from rafl.fem.material import Material

TRUE = Material(190e3, 0.45, mass="lumped", law="corotated")
LOADS = {"a": 0.04, "b": 0.10, "c": 0.07, "d": 0.08}
SPLITS = {"a": "train", "b": "train", "c": "val", "d": "test"}
FRAMES = 25


@pytest.fixture(scope="session")
def dataset(small_specimen: Specimen) -> Dataset:
    """Exact markers of releases simulated with another material than the assumed one."""
    simulator = small_specimen.simulator(0.01, TRUE)
    markers = small_specimen.markers(1e-6)
    nodes = np.zeros_like(small_specimen.mesh.vertices)
    starts = hung(simulator, small_specimen.loaded, np.array(list(LOADS.values())))
    seen = markers.positions(torch.from_numpy(let_go(simulator, starts, FRAMES, tuple(LOADS)))).numpy()
    trajectories = {
        name: Trajectory(
            0.01 * np.arange(FRAMES),
            seen[:, k],
            np.ones((FRAMES, 20), dtype=bool),
            np.full((FRAMES, 20, 3), 1e-5),
            starts[k],
            nodes,
            nodes,
            nodes,
            nodes[:, 0],
            SPLITS[name],
            {"load_g": 1e3 * load},
        )
        for k, (name, load) in enumerate(LOADS.items())
    }
    return Dataset("small", small_specimen.simulator(0.01), markers, trajectories, "by a test")
