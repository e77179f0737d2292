"""An evaluation without a simulation: bodies that swing by a formula."""

from dataclasses import replace

import numpy as np

from rafl.data.strain_range import StrainRange
from rafl.evaluation.evaluation_file import Evaluation
from rafl.evaluation.metrics import BASELINE, Comparison
from rafl.evaluation.surface import Surface, SurfaceMotion
from rafl.fem.mesh import HexMesh

MESH = HexMesh.box((10, 3, 3), (0.1, 0.03, 0.03))
MARKED = np.flatnonzero((MESH.vertices[:, 1] == 0.0) & (MESH.vertices[:, 0] > 0.0))[::2]  # vertices with a marker
LOST = (3, slice(5, 9))  # marker that is missing, and in which rows
METHODS = (BASELINE, "rafl")
TIME_STEP = 0.01
# Amplitude of each method's swing, relative to the recorded one.
FACTORS = (0.8, 1.02, 1.1, 0.9, 0.95)


def swing(frames: int, factor: float) -> np.ndarray:
    """Positions [m], (T, N, 3), of a damped swing."""
    time = TIME_STEP * np.arange(frames)[:, None]
    q = np.repeat(MESH.vertices[None], frames, axis=0)
    q[..., 2] -= 0.02 * factor * np.cos(30.0 * time) * np.exp(-2.0 * time) * (MESH.vertices[:, 0] / 0.1) ** 2
    return q


def make_comparison(
    recording: str = "load060g",
    split: str = "test",
    methods: tuple[str, ...] = METHODS,
    frames: int = 40,
    dataset: str = "beam",
) -> Comparison:
    """A recording with simulations; those of all methods but the baseline have a residual force that grows along x."""
    random = np.random.default_rng(0)
    recorded = swing(frames, 1.0)[:, MARKED] + random.normal(0.0, 1e-5, (frames, len(MARKED), 3))
    recorded[LOST[1], LOST[0]] = np.nan
    bodies = {method: swing(frames, factor) for method, factor in zip(methods, FACTORS, strict=False)}
    simulated = {method: q[:, MARKED] for method, q in bodies.items()}
    force = np.zeros((frames - 1, *MESH.vertices.shape))
    force[..., 2] = 0.05 * MESH.vertices[:, 0]
    time = TIME_STEP * np.arange(frames)
    return Comparison(
        dataset=dataset,
        recording=recording,
        split=split,
        time=time,
        recorded=recorded,
        simulated=simulated,
        distances={method: np.linalg.norm(markers - recorded, axis=-1) for method, markers in simulated.items()},
        rest_distances={
            method: np.linalg.norm((markers - recorded)[-4:].mean(0), axis=-1) for method, markers in simulated.items()
        },
        marker_names=tuple(f"m{number}" for number in range(len(MARKED))),
        surface=Surface.of(MESH),
        motions={
            method: SurfaceMotion.of(MESH, q, None if method == BASELINE else force) for method, q in bodies.items()
        },
        strains={method: StrainRange(0.1, 1.0) for method in methods},
    )


def make_evaluation(methods: tuple[str, ...] = METHODS, count: int = 3, frames: int = 40) -> Evaluation:
    """Recordings of one dataset: the first for training, the second for validation, the others for testing."""
    item = make_comparison(methods=methods, frames=frames)
    splits = ["train", "val"] + ["test"] * count
    comparisons = [
        replace(item, recording=f"load{60 + 5 * number:03d}g", split=splits[number]) for number in range(count)
    ]
    return Evaluation(comparisons, "rafl: trained a residual acceleration field")
