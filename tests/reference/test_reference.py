"""Trajectories, gradients and forces of the paper's own simulator."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support import SHARED

from rafl.features import GaussPoints, features
from rafl.material import Material
from rafl.mesh import HexMesh
from rafl.residual import ResidualField
from rafl.rollout import Start, rollout
from rafl.simulator import Simulator

FOLDER = SHARED / "reference"
pytestmark = [
    pytest.mark.reference,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"reference data absent at {FOLDER}"),
]


def named(pattern: str) -> list[Path]:
    return sorted(FOLDER.glob(pattern)) if FOLDER.is_dir() else []


def simulator_of(data: np.lib.npyio.NpzFile) -> Simulator:
    mesh = HexMesh(data["vertices"], data["hexes"].astype(np.int64))
    material = Material(float(data["youngs_modulus"]), float(data["poissons_ratio"]), float(data["density"]))
    return Simulator(mesh, material, data["fixed"].astype(np.int64), float(data["dt"]), tuple(data["gravity"]))


@pytest.mark.parametrize("path", named("[vtl]*.npz"), ids=lambda path: path.stem)
def test_trajectories(path: Path) -> None:
    data = np.load(path)
    simulator = simulator_of(data)
    assert simulator.node_mass == pytest.approx(np.full(len(data["vertices"]), data["node_mass"]))
    start = Start(
        torch.from_numpy(data["q"][:1]),
        torch.from_numpy(data["v"][:1]),
        torch.from_numpy(simulator.weight + data["f_ext"])[None],
        simulator.node_mass[None],
        (path.stem,),
    )
    with torch.no_grad():
        q, _ = rollout(simulator, start, len(data["q"]) - 1)
    assert np.abs(q[:, 0].numpy() - data["q"]).max() < 1e-9


def test_gradients() -> None:
    data = np.load(FOLDER / "gradient_original_canonical.npz")
    simulator = simulator_of(data)
    leaves = {key: torch.tensor(data[key]).requires_grad_() for key in ("q0", "v0", "f_ext")}
    e = torch.tensor(float(data["youngs_modulus"]), dtype=torch.float64).requires_grad_()
    nu = torch.tensor(float(data["poissons_ratio"]), dtype=torch.float64).requires_grad_()
    loads = iter(leaves["f_ext"])
    start = Start(
        leaves["q0"][None], leaves["v0"][None], torch.tensor(simulator.weight)[None],
        simulator.node_mass[None], ("gradient",),
    )  # fmt: skip
    q, _ = rollout(simulator, start, 20, lambda q, v: next(loads)[None], (e, nu))
    loss = ((q[1:, 0] - torch.tensor(data["vertices"])) ** 2).sum()
    loss.backward()
    assert loss.item() == pytest.approx(float(data["loss"]), rel=1e-6)
    free = np.setdiff1d(np.arange(len(data["vertices"])), data["fixed"])
    for key, by in (("q0", "d_q0"), ("v0", "d_v0"), ("f_ext", "d_f_ext")):
        gradient = leaves[key].grad
        assert gradient is not None
        expected = data[by][..., free, :]
        assert np.abs(gradient.numpy()[..., free, :] - expected).max() < 1e-6 * np.abs(expected).max(), key
    assert e.grad is not None
    assert nu.grad is not None
    assert e.grad.item() == pytest.approx(float(data["d_youngs_modulus"]), rel=1e-6)
    assert nu.grad.item() == pytest.approx(float(data["d_poissons_ratio"]), rel=1e-6)


@pytest.mark.parametrize("path", named("residual_field_*.npz"), ids=lambda path: path.stem)
def test_residual_field(path: Path) -> None:
    """Features, force and its derivatives by the state.

    The files' derivatives by the weights are not compared: the one by the last, linear layer violates
    Euler's identity sum(W4 * dL/dW4) = L, which ours fulfils (see test_features).
    """
    data = np.load(path)
    mesh = HexMesh(data["vertices"], data["hexes"].astype(np.int64))
    simulator = Simulator(mesh, Material(), mesh.face_nodes("x-min"))
    field = ResidualField()
    for number, weight in enumerate(field.parameters()):
        weight.data = torch.tensor(data[f"W{number}"])
    q = torch.tensor(data["q"])[None].requires_grad_()
    v = torch.tensor(data["v"])[None].requires_grad_()
    gravity = torch.tensor(simulator.gravity, dtype=torch.float64)
    values, _ = features(q, v, GaussPoints.of(mesh, 1070.0), gravity)
    force = field.on(simulator)(q, v)
    (force * torch.tensor(data["c"])).sum().backward()
    assert q.grad is not None
    assert v.grad is not None
    for ours, theirs in (
        (values, data["features"]), (force, data["force"]), (q.grad, data["d_q"]), (v.grad, data["d_v"]),
    ):  # fmt: skip
        assert np.abs(ours.detach().numpy()[0] - theirs).max() < 1e-9 * np.abs(theirs).max()
