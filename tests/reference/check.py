"""Compare the simulator with every file of reference data in a folder.

    python tests/reference/check.py ../shared/reference

Prints one line per file: name, largest deviation relative to its limit, limit. Exits with 1 if a limit is exceeded.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.fem.material import Material, lame
from rafl.fem.mesh import HexMesh
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.features import GaussPoints, features
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator

TRAJECTORY_LIMIT = 1e-9  # [m]
GRADIENT_LIMIT = 1e-6  # relative to the largest component
FIELD_LIMIT = 1e-9  # relative to the largest component


@dataclass(frozen=True)
class Deviation:
    """Deviation of the simulator from the reference in one quantity."""

    quantity: str
    value: float
    limit: float
    unit: str

    @property
    def passed(self) -> bool:
        return self.value <= self.limit


def simulator_of(data: dict[str, np.ndarray]) -> Simulator:
    mesh = HexMesh(data["vertices"], data["hexes"].astype(np.int64))
    material = Material(float(data["youngs_modulus"]), float(data["poissons_ratio"]), float(data["density"]))
    return Simulator(mesh, material, data["fixed"].astype(np.int64), float(data["dt"]), tuple(data["gravity"]))


def simulate(data: dict[str, np.ndarray], **leaves: Tensor) -> Tensor:
    """Positions (T, N, 3); f_ext is constant (N, 3) or given per step (T - 1, N, 3)."""
    simulator = simulator_of(data)
    q, v, force = (
        leaves.get(key, torch.from_numpy(value))
        for key, value in (
            ("q0", data["q0"] if "q0" in data else data["q"][0]),
            ("v0", data["v0"] if "v0" in data else data["v"][0]),
            ("f_ext", data["f_ext"]),
        )
    )
    steps = len(force) if force.ndim == 3 else len(data["q"]) - 1
    mass = data.get("node_mass", simulator.node_mass)
    extra = torch.from_numpy(np.broadcast_to(mass, simulator.node_mass.shape) - simulator.node_mass)
    gravity = torch.tensor(simulator.gravity, dtype=torch.float64)
    constant = extra[:, None] * gravity + (force if force.ndim == 2 else 0.0)
    loads = iter(force)
    residual = (lambda q, v, external: next(loads)[None]) if force.ndim == 3 else None
    values = {key: value for key, value in leaves.items() if key not in ("q0", "v0", "f_ext")}
    start = Start(q[None], v[None], constant[None], extra[None], ("reference",))
    return rollout(simulator, start, steps, residual, simulator.parameters(**values))[0][:, 0]


def trajectory(data: dict[str, np.ndarray]) -> Iterator[Deviation]:
    with torch.no_grad():
        q = simulate(data).numpy()
    yield Deviation("q", float(np.abs(q - data["q"]).max()), TRAJECTORY_LIMIT, "m")


def gradient(data: dict[str, np.ndarray]) -> Iterator[Deviation]:
    leaves = {key: torch.tensor(data[key]).requires_grad_() for key in ("q0", "v0", "f_ext")}
    names = ("youngs_modulus", "poissons_ratio", "gravity")
    leaves |= {key: torch.tensor(data[key], dtype=torch.float64).requires_grad_() for key in names}
    q = simulate(data, **leaves)
    loss = ((q[1:] - torch.tensor(data["vertices"])) ** 2).sum()
    loss.backward()
    found = {"loss": loss.item()} | {f"d_{key}": leaf.grad.numpy() for key, leaf in leaves.items()}
    # Derivatives with respect to 2 mu and lambda follow from those with respect to E and nu.
    e, nu = (torch.tensor(float(data[key]), dtype=torch.float64).requires_grad_() for key in names[:2])
    mu, lam = lame(e, nu)
    jacobian = np.array([[float(g) for g in torch.autograd.grad(x, (e, nu), retain_graph=True)] for x in (2 * mu, lam)])
    by_material = np.array([found["d_youngs_modulus"], found["d_poissons_ratio"]])
    found["d_two_mu"], found["d_lambda"] = np.linalg.solve(jacobian.T, by_material)
    free = np.setdiff1d(np.arange(len(data["vertices"])), data["fixed"])
    for key, ours in found.items():
        if key not in data:
            continue
        nodal = key in ("d_q0", "d_v0", "d_f_ext")
        theirs, mine = (np.asarray(x)[..., free, :] if nodal else np.asarray(x) for x in (data[key], ours))
        yield Deviation(key, float(np.abs(mine - theirs).max() / np.abs(theirs).max()), GRADIENT_LIMIT, "relative")


def residual_field(data: dict[str, np.ndarray]) -> Iterator[Deviation]:
    """Features, force and their derivatives.

    The derivatives in the files with respect to the weights are those of L + 2 sum(force at exact rest): two earlier
    gradients had not been set to zero. (The last layer is linear, so sum(W4 * dL/dW4) must be L, but theirs is not.)
    Agreement with either L or this sum is accepted. At rest their features are 1e-10 where a square root was
    regularised, so the sum agrees to 1e-8 only.
    """
    mesh = HexMesh(data["vertices"], data["hexes"].astype(np.int64))
    simulator = Simulator(mesh, Material(), mesh.face_nodes("x-min"))
    field = ResidualField()
    weights = list(field.parameters())
    for number, weight in enumerate(weights):
        weight.data = torch.tensor(data[f"W{number}"])
    q, v = (torch.tensor(data[key])[None].requires_grad_() for key in ("q", "v"))
    gravity = torch.tensor(simulator.gravity, dtype=torch.float64)
    values, _ = features(q, v, GaussPoints.of(mesh, simulator.material.density), gravity)
    zeros = torch.zeros_like(q)
    force = field.on(simulator)(q, v, zeros)
    by_q, by_v, *by_weights = torch.autograd.grad((force * torch.tensor(data["c"])).sum(), [q, v, *weights])
    for quantity, ours, theirs in (
        ("features", values[0], data["features"]),
        ("force", force[0], data["force"]),
        ("d_q", by_q[0], data["d_q"]),
        ("d_v", by_v[0], data["d_v"]),
    ):
        difference = np.abs(ours.detach().numpy() - theirs).max()
        yield Deviation(quantity, float(difference / np.abs(theirs).max()), FIELD_LIMIT, "relative")
    rest = torch.from_numpy(mesh.vertices)[None]
    at_rest = torch.autograd.grad(field.on(simulator)(rest, zeros, zeros).sum(), weights)
    readings = [
        max(
            float(np.abs((mine + times * extra).numpy() - data[f"d_W{n}"]).max() / np.abs(data[f"d_W{n}"]).max())
            for n, (mine, extra) in enumerate(zip(by_weights, at_rest, strict=True))
        )
        for times in (0.0, 2.0)
    ]
    yield Deviation("d_W", min(readings), 1e-7, "relative")


def deviations(path: Path) -> list[Deviation] | None:
    """Deviations of the quantities in a file; None if it is no reference file of a known kind."""
    with np.load(path) as file:
        data = dict(file)
    for key, compare in (("features", residual_field), ("d_q0", gradient), ("f_ext", trajectory)):
        if key in data:
            return list(compare(data))
    return None


def main() -> int:
    folder = Path(sys.argv[1]) if len(sys.argv) == 2 else None
    if folder is None or not folder.is_dir():
        print(f"expected one folder of .npz reference files, got {' '.join(sys.argv[1:]) or 'nothing'}")
        return 2
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        print(f"expected .npz reference files in {folder}, found none")
        return 2
    failed = False
    for path in paths:
        try:
            found = deviations(path)
        except (SimulationError, KeyError, ValueError, OSError, BadZipFile) as error:
            print(f"{path.name:48s} FAILED: {error}")
            failed = True
            continue
        if found is None:
            print(f"{path.name:48s} skipped: neither trajectory, gradient nor residual field")
            continue
        worst = max(found, key=lambda item: item.value / item.limit)
        passed = all(item.passed for item in found)
        failed |= not passed
        print(
            f"{path.name:48s} {worst.quantity:>10s} {worst.value:.2e} {worst.unit}, "
            f"limit {worst.limit:.0e}{'' if passed else '  FAILED'}"
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
