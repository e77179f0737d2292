import numpy as np
import pytest
import torch

from rafl.material import Material
from rafl.mesh import HexMesh
from rafl.rollout import Start, rollout
from rafl.simulator import SimulationError, Simulator


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    mesh = HexMesh.box((2, 1, 1), (0.04, 0.02, 0.02))
    return Simulator(mesh, Material(1e5, 0.4, mass="lumped"), mesh.face_nodes("x-min"))


def started(simulator: Simulator, q: torch.Tensor, v: torch.Tensor, force: torch.Tensor) -> Start:
    return Start(q, v, force, np.stack([simulator.node_mass] * len(q)), ("a", "b")[: len(q)])


@pytest.mark.parametrize("state", ["rest", "shaken", "turned", "near inversion"])
def test_gradients_by_finite_differences(simulator: Simulator, state: str, random: np.random.Generator) -> None:
    """By q0, v0, forces, E and nu, through three steps of a batch of two."""
    vertices = simulator.mesh.vertices
    q = np.stack([vertices, vertices])
    if state == "shaken":
        q = q + random.normal(0, 1e-3, q.shape)
    if state == "turned":
        q = q @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T
    if state == "near inversion":
        q[:, vertices[:, 0] > 0.03, 0] -= 0.0185
    inputs = {
        "q": torch.tensor(q),
        "v": torch.tensor(random.normal(0, 0.05, q.shape)),
        "force": torch.tensor(random.normal(0, 0.02, q.shape)),
        "e": torch.tensor([1e5, 2e5], dtype=torch.float64),
        "nu": torch.tensor([0.4, 0.45], dtype=torch.float64),
    }
    weights = torch.tensor(random.normal(size=(4, *q.shape)))

    def loss(values: dict[str, torch.Tensor]) -> torch.Tensor:
        start = started(simulator, values["q"], values["v"], values["force"])
        positions, _ = rollout(simulator, start, 3, material=(values["e"], values["nu"]))
        return (positions * weights).sum()

    leaves = {key: value.clone().requires_grad_() for key, value in inputs.items()}
    loss(leaves).backward()
    for key, step in (("q", 1e-7), ("v", 1e-5), ("force", 1e-5), ("e", 1.0), ("nu", 1e-6)):
        direction = torch.tensor(random.normal(size=inputs[key].shape))
        up, down = (loss({**inputs, key: inputs[key] + sign * step * direction}) for sign in (1, -1))
        slope = float((up - down) / (2 * step))
        gradient = leaves[key].grad
        assert gradient is not None
        assert float((gradient * direction).sum()) == pytest.approx(slope, rel=2e-5, abs=1e-9), key


def test_the_residual_force_acts_at_the_start_of_each_step(simulator: Simulator) -> None:
    """Eq. (2): adding f to the external force or returning it as residual is the same thing."""
    q = torch.tensor(simulator.mesh.vertices[None])
    still = torch.zeros_like(q)
    extra = 0.01 * torch.ones_like(q)
    weight = torch.tensor(simulator.weight[None])
    by_hook, forces = rollout(simulator, started(simulator, q, still, weight), 4, lambda q, v: extra)
    by_load, none = rollout(simulator, started(simulator, q, still, weight + extra), 4)
    torch.testing.assert_close(by_hook, by_load, atol=1e-12, rtol=0)
    assert forces.shape == (4, *q.shape)
    assert none.numel() == 0


def test_a_failed_step_names_recording_and_step(simulator: Simulator) -> None:
    q = torch.tensor(simulator.mesh.vertices[None])
    start = started(simulator, q, torch.zeros_like(q), torch.zeros_like(q))
    calls = []

    def bad(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return torch.full_like(q, torch.nan if len(calls) == 3 else 0.0)

    with pytest.raises(SimulationError, match=r"step 3: trajectory 0 .*recordings: a"):
        rollout(simulator, start, 5, bad)
