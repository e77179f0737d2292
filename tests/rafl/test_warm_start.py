from dataclasses import replace

import numpy as np
import pytest
import torch

from rafl.dataset import Dataset
from rafl.fit import mean_error
from rafl.material import Material
from rafl.mesh import HexMesh
from rafl.objective import Recordings, training_loss
from rafl.residual import ResidualField
from rafl.run import FittedModel
from rafl.simulator import Simulator
from rafl.synthetic import hung, released, twisted, vertex_markers, with_material
from rafl.warm_start import missing_forces, shows_every_vertex, warm_start

MESH = HexMesh.box((4, 2, 2), (0.06, 0.02, 0.02))
BASE = Simulator(MESH, Material(), MESH.face_nodes("x-min"))


@pytest.fixture(scope="module")
def seen() -> Dataset:
    """Every vertex of a stiffer beam let go from weights of 10, 20 and 30 g."""
    target = with_material(BASE, 260e3, 0.49)
    starts = hung(target, MESH.face_nodes("x-max"), np.array([0.01, 0.02, 0.03]))
    return released("small", BASE, target, starts, 20, {"a": "train", "b": "val", "c": "train"})


def test_vertices_as_markers_are_where_the_vertices_are(random: np.random.Generator) -> None:
    q = torch.tensor(MESH.vertices + random.normal(0, 1e-3, MESH.vertices.shape))
    torch.testing.assert_close(vertex_markers(MESH).positions(q), q, rtol=0, atol=1e-15)


def test_a_twist_keeps_sections_plane_and_turns_the_tip() -> None:
    q = twisted(MESH, np.array([0.0, np.pi / 2]))
    np.testing.assert_allclose(q[0], MESH.vertices, atol=1e-15)
    tip = MESH.face_nodes("x-max")
    np.testing.assert_allclose(q[1, tip, 1] - 0.01, -(MESH.vertices[tip, 2] - 0.01), atol=1e-15)
    np.testing.assert_allclose(q[1, BASE.fixed], MESH.vertices[BASE.fixed], atol=1e-15)
    np.testing.assert_allclose(q[..., 0], np.broadcast_to(MESH.vertices[:, 0], q.shape[:2]))


def test_missing_forces_make_the_simulator_follow(seen: Dataset) -> None:
    """Each step of the untouched simulator, the missing force added, ends where the recording does."""
    missing = missing_forces(seen, ["c"])
    recorded = seen.trajectories["c"].markers
    for t in (0, 5, 18):
        force = torch.from_numpy(missing.force[t : t + 1])
        state = (missing.q[t : t + 1], missing.v[t : t + 1])
        h = BASE.time_step
        inertia = np.repeat(BASE.node_mass[None] / h**2, 1, axis=0)
        after = BASE.minimise(
            state[0].copy(), inertia, state[0] + h * state[1], BASE.weight + force.numpy(), BASE.resistance(1), "step"
        )
        np.testing.assert_allclose(after[0], recorded[t + 1], atol=1e-9)
    itself = released("own", BASE, BASE, seen.trajectories["c"].q[None], 10, {"a": "train"})
    assert np.abs(missing_forces(itself, ["a"]).force).max() < 1e-6


def test_the_lesson_needs_no_simulation_and_helps(seen: Dataset) -> None:
    torch.manual_seed(2)
    field = ResidualField()
    validate = [Recordings.of(seen, ["b"])]
    rows: list[dict[str, float]] = []
    model = FittedModel("rafl", field=field)
    warm_start(field, [seen], 15, 0, lambda: 1e3 * mean_error(validate, model), rows.append)
    assert rows[-1]["missing"] < rows[0]["missing"]
    assert mean_error(validate, model) < 0.5 * mean_error(validate, FittedModel("original"))
    assert 1e3 * mean_error(validate, model) <= min(row["validation_mm"] for row in rows) + 1e-9


def test_who_does_not_show_every_vertex_teaches_nothing(seen: Dataset, dataset: Dataset) -> None:
    assert shows_every_vertex(seen)
    assert not shows_every_vertex(dataset)
    assert not shows_every_vertex(replace(seen, simulator=replace(BASE, substeps=2)))
    valid = seen.trajectories["a"].valid.copy()
    valid[3, 4] = False
    gap = {**seen.trajectories, "a": replace(seen.trajectories["a"], valid=valid)}
    assert not shows_every_vertex(replace(seen, trajectories=gap))
    field = ResidualField()
    before = {key: value.clone() for key, value in field.state_dict().items()}
    warm_start(field, [dataset], 3, 0, lambda: 0.0, lambda row: None)
    assert all(torch.equal(value, before[key]) for key, value in field.state_dict().items())


def test_coordinates_count_by_their_variance(seen: Dataset) -> None:
    """A coordinate of twice the usual sigma counts a quarter; one not observed, nothing."""
    sigma = np.full(seen.trajectories["a"].sigma.shape, 1e-5)
    sigma[:, 3, 1], sigma[:, 4, 2] = 2e-5, np.inf
    item = replace(seen.trajectories["a"], sigma=sigma)
    one = replace(seen, trajectories={"a": item})
    recordings = Recordings.of(one, ["a"], by_sigma=True)
    none = torch.zeros(0)
    losses = []
    for marker, axis in ((0, 0), (3, 1), (4, 2)):
        simulated = recordings.markers.clone()
        simulated[:, :, marker, axis] += 1e-3
        losses.append(float(training_loss(recordings, simulated, none)))
    assert losses == pytest.approx([1e-3, 0.25e-3, 0.0])
