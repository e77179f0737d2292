"""The limit on the energy that a residual field adds: motions that it would make flutter stay bounded."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from rafl.data.dataset import Dataset
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.fitting.run_folder import FittedModel, Settings, load_model, save_model
from rafl.fitting.train_field import fit_residual_field
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.energy_limit import LimitedForce, energy_scale, largest_work
from rafl.simulation.rollout import Start, equilibrium, rollout
from rafl.simulation.simulator import Simulator

FRACTION = 0.2


@pytest.fixture(scope="module")
def beam() -> Simulator:
    mesh = HexMesh.box((4, 1, 1), (0.08, 0.02, 0.02))
    material = Material(1e5, 0.4, law="corotated", mass="lumped", integration="enhanced")
    return Simulator(mesh, material, mesh.face_nodes("x-min"), integrator="generalised-alpha")


@pytest.fixture(scope="module")
def release(beam: Simulator) -> Start:
    """At rest, bent down by a weight at the tip that is gone."""
    force = torch.zeros(1, *beam.mesh.vertices.shape, dtype=torch.float64)
    force[0, beam.mesh.face_nodes("x-max"), 2] = -0.02
    return Start.at_rest(equilibrium(beam, force))


def feed(simulator: Simulator, rate: float) -> object:
    """A force along the velocity, which feeds energy into every motion: negative damping of `rate` [1/s]."""
    mass = torch.from_numpy(simulator.node_mass)[:, None]

    def force(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
        return rate * mass * v

    return force


def speed(positions: Tensor) -> Tensor:
    return torch.diff(positions, dim=0).square().sum((1, 2, 3)).sqrt()


def total_energy(simulator: Simulator, start: Start, positions: Tensor) -> np.ndarray:
    """Potential energy above the start at every frame [J]: a lower bound of the total one."""
    own = simulator.engine.evaluate(
        positions[:, 0].contiguous().numpy(), simulator.constitutive_state(len(positions)), tangent=False
    )[0]
    external = torch.from_numpy(simulator.weight) * positions[:, 0]
    energy: np.ndarray = own - external.sum((1, 2)).numpy()
    return energy - energy[0]


@pytest.mark.parametrize("steps", [600, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_field_that_feeds_energy_cannot_make_a_beam_flutter(beam: Simulator, release: Start, steps: int) -> None:
    """Without the limit the motion grows by orders of magnitude, or fails; with it the energy stays bounded."""
    parameters = beam.parameters()
    force = feed(beam, 8.0)
    free, _ = rollout(beam, release, 120, force)  # type: ignore[arg-type]
    assert speed(free)[-20:].max() > 3.0 * speed(free)[:20].max()
    limited, _ = rollout(beam, release, steps, LimitedForce(force, beam, parameters, FRACTION))  # type: ignore[arg-type]
    external = torch.from_numpy(beam.weight)[None]
    limit = FRACTION * float(energy_scale(beam, parameters, release.q, release.v, external))
    # Within one frame the body may move farther than its velocity at the start foretells.
    assert total_energy(beam, release, limited).max() <= 1.5 * limit
    assert speed(limited)[-20:].max() < 2.0 * speed(limited)[:20].max()


def test_every_rollout_begins_anew(beam: Simulator, release: Start) -> None:
    """A limited force remembers nothing between rollouts; called on its own, it is the force without a limit."""
    force = feed(beam, 8.0)
    limited = LimitedForce(force, beam, beam.parameters(), FRACTION)  # type: ignore[arg-type]
    first, _ = rollout(beam, release, 60, limited)
    q, v = first[-1], torch.ones_like(first[-1])
    for _ in range(3):
        assert torch.equal(limited(q, v, v), force(q, v, v))  # type: ignore[operator]
    assert torch.equal(rollout(beam, release, 60, limited)[0], first)


def test_a_force_below_the_limit_is_not_changed(beam: Simulator, release: Start) -> None:
    force = feed(beam, -2.0)
    plain, forces = rollout(beam, release, 40, force)  # type: ignore[arg-type]
    limited, _ = rollout(beam, release, 40, LimitedForce(force, beam, beam.parameters(), FRACTION))  # type: ignore[arg-type]
    assert torch.equal(plain, limited)
    assert float(largest_work(plain, forces)) == 0.0  # it only damps


def test_trained_fields_carry_a_limit(dataset: Dataset, tmp_path: Path) -> None:
    """A trained field's limit lies above its work in training, so that it does not change there; it is saved."""
    settings = Settings("rafl", ("small.h5",), 2, 2e-3, 1e-5, 10, 12, 5)
    model = fit_residual_field([dataset], settings, tmp_path, lambda row: None)
    assert model.energy_fraction is not None
    assert model.energy_fraction > 0.0
    assert load_model(tmp_path).energy_fraction == model.energy_fraction
    simulator, start = dataset.simulator, dataset.start(dataset.split("train"))
    unlimited = FittedModel("rafl", model.field, time_integration=model.time_integration)
    positions = [rollout(simulator, start, 12, each.residual(simulator))[0].detach() for each in (model, unlimited)]
    assert torch.equal(*positions)
    save_model(tmp_path, FittedModel("rafl", ResidualField()))
    assert load_model(tmp_path).energy_fraction is None
