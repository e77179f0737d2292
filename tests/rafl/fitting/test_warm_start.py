from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, training_loss
from rafl.data.synthetic import loaded_equilibria, release_dataset, twisted_shapes, vertex_markers, with_material
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.fitting import residual_targets, warm_start
from rafl.fitting.residual_targets import compute_targets, read_targets
from rafl.fitting.run_folder import FittedModel
from rafl.fitting.train_field import mean_error
from rafl.fitting.warm_start import pretrain
from rafl.residual.acceleration_field import ResidualField
from rafl.simulation.simulator import Simulator

MESH = HexMesh.box((4, 2, 2), (0.06, 0.02, 0.02))
BASE = Simulator(MESH, Material(), MESH.face_nodes("x-min"))


@pytest.fixture(scope="module")
def observed() -> Dataset:
    """Every vertex of a stiffer beam, released from loads of 10, 20 and 30 g."""
    target = with_material(BASE, 260e3, 0.49)
    starts = loaded_equilibria(target, MESH.face_nodes("x-max"), np.array([0.01, 0.02, 0.03]))
    return release_dataset("small", BASE, target, starts, 20, {"a": "train", "b": "val", "c": "train"})


def test_vertex_markers_are_at_the_vertices(random: np.random.Generator) -> None:
    q = torch.tensor(MESH.vertices + random.normal(0, 1e-3, MESH.vertices.shape))
    torch.testing.assert_close(vertex_markers(MESH).positions(q), q, rtol=0, atol=1e-15)


def test_twist_keeps_cross_sections_plane_and_rotates_the_tip() -> None:
    q = twisted_shapes(MESH, np.array([0.0, np.pi / 2]))
    np.testing.assert_allclose(q[0], MESH.vertices, atol=1e-15)
    tip = MESH.face_nodes("x-max")
    np.testing.assert_allclose(q[1, tip, 1] - 0.01, -(MESH.vertices[tip, 2] - 0.01), atol=1e-15)
    np.testing.assert_allclose(q[1, BASE.fixed], MESH.vertices[BASE.fixed], atol=1e-15)
    np.testing.assert_allclose(q[..., 0], np.broadcast_to(MESH.vertices[:, 0], q.shape[:2]))


def test_pretraining_reduces_the_simulation_error(observed: Dataset, tmp_path: Path) -> None:
    """With all vertices observed, with some of them, and with mass damping."""
    few = replace(
        observed,
        markers=observed.markers.select(np.arange(6, 45, 4)),
        trajectories={
            name: replace(item, **{key: getattr(item, key)[:, 6:45:4] for key in ("markers", "valid", "sigma")})
            for name, item in observed.trajectories.items()
        },
    )
    damped = replace(observed, simulator=replace(BASE, material=replace(BASE.material, mass_damping=2.0)))
    for number, dataset in enumerate((observed, few, damped)):
        torch.manual_seed(2)
        field = ResidualField()
        validate = [Recordings.of(dataset, ["b"])]
        rows: list[dict[str, float]] = []
        model = FittedModel("rafl", field=field)
        run = tmp_path / str(number)
        pretrain(field, [dataset], run, 15, 0, lambda: 1e3 * mean_error(validate, model), rows.append)  # noqa: B023
        assert rows[-1]["missing"] < 0.5 * rows[0]["missing"]
        assert mean_error(validate, model) < 0.3 * mean_error(validate, FittedModel("original"))
        assert 1e3 * mean_error(validate, model) <= min(row["validation_mm"] for row in rows) + 1e-9


def test_pretraining_keeps_the_scale_of_a_trained_field(observed: Dataset, tmp_path: Path) -> None:
    """Its error does not increase."""
    torch.manual_seed(2)
    field = ResidualField()
    field.set_scale(torch.linspace(0.5, 2.0, 34, dtype=torch.float64))
    scale = field.scale.clone()
    model = FittedModel("rafl", field=field)
    validate = [Recordings.of(observed, ["b"])]
    before = mean_error(validate, model)
    rows: list[dict[str, float]] = []
    pretrain(field, [observed], tmp_path, 4, 0, lambda: 1e3 * mean_error(validate, model), rows.append, trained=True)
    assert torch.equal(field.scale, scale)
    assert len(rows) == 4
    assert mean_error(validate, model) <= before


@pytest.mark.parametrize(("max_states", "states"), [(38, 38), (37, 19), (17, 17), (1, 16)])
def test_number_of_states_is_limited(
    observed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, max_states: int, states: int
) -> None:
    """Recordings of 19 steps are left out first, then steps, but at least one batch remains and can be fitted."""
    monkeypatch.setattr(warm_start, "MAX_QUADRATURE_POINTS", max_states * 8 * len(MESH.hexes))
    warm_start.compute_few_targets(observed, tmp_path / "targets-0.pt")
    small = warm_start.TargetFit(observed, tmp_path / "targets-0.pt")
    assert small.states == states
    np.testing.assert_allclose(small.feature_rms, small.inputs.double().square().mean((1, 2)).sqrt().numpy(), rtol=1e-5)
    torch.manual_seed(2)
    field, rows = ResidualField(), list[dict[str, float]]()
    pretrain(field, [observed], tmp_path, 15, 0, lambda: 0.0, rows.append)
    assert rows[-1]["missing"] < 0.8 * rows[0]["missing"]


def test_chunk_sizes_do_not_change_the_result(
    observed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = len(MESH.vertices)
    whole = BASE.solve_tangent(MESH.vertices[None], np.eye(3 * nodes).reshape(1, nodes, 3, -1))[0]
    warm_start.compute_few_targets(observed, tmp_path / "targets-0.pt")
    once = warm_start.TargetFit(observed, tmp_path / "targets-0.pt")
    monkeypatch.setattr(warm_start, "STATES_PER_CHUNK", 7)
    monkeypatch.setattr(warm_start, "COLUMNS_PER_CHUNK", 10)
    chunked = warm_start.TargetFit(observed, tmp_path / "targets-0.pt")
    for each in (once, chunked):
        np.testing.assert_allclose(each.compliance.numpy(), whole.reshape(3 * nodes, -1), rtol=1e-5, atol=1e-9)
    assert torch.equal(once.inputs, chunked.inputs)
    assert torch.equal(once.rotation, chunked.rotation)


def test_saved_targets_are_not_computed_again(
    observed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "targets-0.pt"
    compute_targets(observed, path, 20)
    first = read_targets(observed, path)
    monkeypatch.setattr(residual_targets, "residual_targets", None)
    compute_targets(observed, path, 20)
    for once, again in zip(first, read_targets(observed, path), strict=True):
        assert torch.equal(once, again)


def test_unsupported_datasets_are_skipped(observed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Several substeps, viscosity, or a mesh that is too large."""
    field = ResidualField()
    before = {key: value.clone() for key, value in field.state_dict().items()}
    material = replace(BASE.material, viscosity=20.0)
    for simulator in (replace(BASE, substeps=2), replace(BASE, material=material)):
        other = replace(observed, simulator=simulator)
        assert not warm_start.can_fit_targets(other)
        pretrain(field, [other], tmp_path, 3, 0, lambda: 0.0, lambda row: None)
    assert warm_start.can_fit_targets(observed)
    monkeypatch.setattr(warm_start, "MAX_VERTICES", len(MESH.vertices) - 1)
    assert not warm_start.can_fit_targets(observed)
    pretrain(field, [observed], tmp_path, 3, 0, lambda: 0.0, lambda row: None)
    assert all(torch.equal(value, before[key]) for key, value in field.state_dict().items())


def test_by_sigma_weights_coordinates_by_their_variance(observed: Dataset) -> None:
    """A coordinate with twice the median sigma has a quarter of the weight, an unobserved one has none."""
    sigma = np.full(observed.trajectories["a"].sigma.shape, 1e-5)
    sigma[:, 3, 1], sigma[:, 4, 2] = 2e-5, np.inf
    item = replace(observed.trajectories["a"], sigma=sigma)
    one = replace(observed, trajectories={"a": item})
    recordings = Recordings.of(one, ["a"], by_sigma=True)
    no_forces = torch.zeros(0)
    losses = []
    for marker, axis in ((0, 0), (3, 1), (4, 2)):
        simulated = recordings.markers.clone()
        simulated[:, :, marker, axis] += 1e-3
        losses.append(float(training_loss(recordings, simulated, no_forces)))
    assert losses == pytest.approx([1e-3, 0.25e-3, 0.0])
