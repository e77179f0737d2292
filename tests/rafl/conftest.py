from dataclasses import replace

import numpy as np
import pytest
import torch

from capture.motion import tip_force
from capture.specimen import Specimen
from rafl.dataset import Dataset, Trajectory
from rafl.material import Material
from rafl.rollout import rollout

TRUE = Material(190e3, 0.45, mass="lumped", law="corotated")
LOADS = {"a": 0.04, "b": 0.10, "c": 0.07, "d": 0.08}
SPLITS = {"a": "train", "b": "train", "c": "val", "d": "test"}
FRAMES = 25


@pytest.fixture(scope="session")
def dataset(small_specimen: Specimen) -> Dataset:
    """Exact markers of releases simulated with another material than the assumed one."""
    simulator = small_specimen.simulator(0.01, TRUE)
    markers = small_specimen.markers(1e-6)
    trajectories = {}
    nodes = np.zeros_like(small_specimen.mesh.vertices)
    for name, load in LOADS.items():
        q = simulator.equilibrium((simulator.weight + tip_force(small_specimen, load))[None])
        empty = Trajectory(
            0.01 * np.arange(FRAMES), np.zeros((FRAMES, 20, 3)), np.ones((FRAMES, 20), dtype=bool),
            np.full((FRAMES, 20, 3), 1e-5), q[0], nodes, nodes, nodes, nodes[:, 0], SPLITS[name],
            {"load_g": 1e3 * load},
        )  # fmt: skip
        one = Dataset("small", simulator, markers, {name: empty})
        with torch.no_grad():
            positions, _ = rollout(simulator, one.start([name]), FRAMES - 1)
        trajectories[name] = replace(empty, markers=markers.positions(positions)[:, 0].numpy())
    return Dataset("small", small_specimen.simulator(0.01), markers, trajectories, "by a test")
