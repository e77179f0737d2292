from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, training_loss
from rafl.data.synthetic import hung, released, twisted, vertex_markers, with_material
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.fitting import residual_targets as targets
from rafl.fitting import warm_start as lesson
from rafl.fitting.residual_targets import training_targets
from rafl.fitting.run_folder import FittedModel
from rafl.fitting.train_field import mean_error
from rafl.fitting.warm_start import warm_start
from rafl.residual.acceleration_field import ResidualField
from rafl.simulation.simulator import Simulator

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


def test_the_lesson_needs_no_simulation_and_helps(seen: Dataset, tmp_path: Path) -> None:
    """Of every vertex, of some of them, and where mass damping acts too."""
    few = replace(
        seen,
        markers=seen.markers.some(np.arange(6, 45, 4)),
        trajectories={
            name: replace(item, **{key: getattr(item, key)[:, 6:45:4] for key in ("markers", "valid", "sigma")})
            for name, item in seen.trajectories.items()
        },
    )
    damped = replace(seen, simulator=replace(BASE, material=replace(BASE.material, mass_damping=2.0)))
    for number, dataset in enumerate((seen, few, damped)):
        torch.manual_seed(2)
        field = ResidualField()
        validate = [Recordings.of(dataset, ["b"])]
        rows: list[dict[str, float]] = []
        model = FittedModel("rafl", field=field)
        run = tmp_path / str(number)
        warm_start(field, [dataset], run, 15, 0, lambda: 1e3 * mean_error(validate, model), rows.append)  # noqa: B023
        assert rows[-1]["missing"] < 0.5 * rows[0]["missing"]
        assert mean_error(validate, model) < 0.3 * mean_error(validate, FittedModel("original"))
        assert 1e3 * mean_error(validate, model) <= min(row["validation_mm"] for row in rows) + 1e-9


def test_a_learned_field_goes_on_without_another_scale(seen: Dataset, tmp_path: Path) -> None:
    """And is never worse than it came."""
    torch.manual_seed(2)
    field = ResidualField()
    field.scale_to(torch.linspace(0.5, 2.0, 34, dtype=torch.float64))
    scale = field.scale.clone()
    model = FittedModel("rafl", field=field)
    validate = [Recordings.of(seen, ["b"])]
    before = mean_error(validate, model)
    rows: list[dict[str, float]] = []
    warm_start(field, [seen], tmp_path, 4, 0, lambda: 1e3 * mean_error(validate, model), rows.append, learned=True)
    assert torch.equal(field.scale, scale)
    assert len(rows) == 4
    assert mean_error(validate, model) <= before


@pytest.mark.parametrize(("room", "states"), [(38, 38), (37, 19), (17, 17), (1, 16)])
def test_what_does_not_fit_in_memory_is_left_out(
    seen: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int, states: int
) -> None:
    """Recordings of 19 steps first, then steps, never below a batch; the lesson still helps."""
    monkeypatch.setattr(lesson, "MOST_POINTS", room * 8 * len(MESH.hexes))
    small = lesson.Lesson(seen, tmp_path / "targets-0.pt")
    assert small.states == states
    np.testing.assert_allclose(small.size, small.inputs.double().square().mean((1, 2)).sqrt().numpy(), rtol=1e-5)
    torch.manual_seed(2)
    field, rows = ResidualField(), list[dict[str, float]]()
    warm_start(field, [seen], tmp_path, 15, 0, lambda: 0.0, rows.append)
    assert rows[-1]["missing"] < 0.8 * rows[0]["missing"]


def test_the_compliance_is_of_all_columns(seen: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many of them, and of the states, are worked out at once."""
    nodes = len(MESH.vertices)
    whole = BASE.solve_tangent(MESH.vertices[None], np.eye(3 * nodes).reshape(1, nodes, 3, -1))[0]
    once = lesson.Lesson(seen, tmp_path / "targets-0.pt")
    monkeypatch.setattr(lesson, "TOGETHER", 7)
    monkeypatch.setattr(lesson, "COLUMNS", 10)
    apart = lesson.Lesson(seen, tmp_path / "targets-0.pt")
    for each in (once, apart):
        np.testing.assert_allclose(each.compliance.numpy(), whole.reshape(3 * nodes, -1), rtol=1e-5, atol=1e-9)
    assert torch.equal(once.inputs, apart.inputs)
    assert torch.equal(once.turn, apart.turn)


def test_the_forces_are_kept_for_an_interrupted_run(
    seen: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = training_targets(seen, tmp_path / "targets-0.pt", 20)
    monkeypatch.setattr(targets, "residual_targets", None)
    for once, again in zip(first, training_targets(seen, tmp_path / "targets-0.pt", 20), strict=True):
        assert torch.equal(once, again)


def test_what_cannot_be_followed_teaches_nothing(
    seen: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps of another kind, viscosity, a mesh that is too large."""
    field = ResidualField()
    before = {key: value.clone() for key, value in field.state_dict().items()}
    material = replace(BASE.material, viscosity=20.0)
    for simulator in (replace(BASE, substeps=2), replace(BASE, material=material)):
        other = replace(seen, simulator=simulator)
        assert not lesson.can_teach(other)
        warm_start(field, [other], tmp_path, 3, 0, lambda: 0.0, lambda row: None)
    assert lesson.can_teach(seen)
    monkeypatch.setattr(lesson, "LARGEST", len(MESH.vertices) - 1)
    assert not lesson.can_teach(seen)
    warm_start(field, [seen], tmp_path, 3, 0, lambda: 0.0, lambda row: None)
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
