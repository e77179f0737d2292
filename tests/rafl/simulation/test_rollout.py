import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.fem.laws import LAWS
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.rollout import FIRST_ACCELERATION_FRACTION, Start, _BodyBatch, equilibrium, rollout
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS as INTEGRATOR_OF
from rafl.simulation.time_integration import Integrator, State

MESH = HexMesh.box((2, 1, 1), (0.04, 0.02, 0.02))
FIXED = MESH.face_nodes("x-min")
INTEGRATORS = ("implicit-euler", "generalised-alpha")


def simulator_of(integrator: str = "implicit-euler", **values: object) -> Simulator:
    settings = {"mass": "lumped", "law": "projective", "youngs_modulus": 1e5, "poissons_ratio": 0.4}
    return Simulator(MESH, Material(**(settings | values)), FIXED, integrator=integrator)


def start_of(q: Tensor, v: Tensor | None = None, force: Tensor | None = None) -> Start:
    zeros = torch.zeros_like(q)
    names = tuple("abcdefghi")[: len(q)]
    return Start(q, zeros if v is None else v, zeros if force is None else force, zeros[..., 0], names)


def state(name: str, random: np.random.Generator) -> np.ndarray:
    """Positions of one of the named states, (2, N, 3) [m]."""
    q = np.stack([MESH.vertices, MESH.vertices])
    if name == "repeated stretches":  # equal lateral stretches at every point
        return q * [1.1, 0.95, 0.95]
    if name == "shaken":
        return q + random.normal(0, 1e-3, q.shape)
    if name == "turned":
        return (q + random.normal(0, 5e-4, q.shape)) @ Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix().T
    if name == "near inversion":
        q[:, MESH.vertices[:, 0] > 0.03, 0] -= 0.0185
    return q


# Factor of each input, chosen so that a change of 1e-6 is well above the solver tolerance.
SCALE = {
    "q": 1e-2,
    "v": 1.0,
    "force": 1e-1,
    "youngs_modulus": 1e4,
    "poissons_ratio": 0.1,
    "density": 1e3,
    "gravity": 10.0,
    "mass_damping": 1.0,
    "stiffness_damping": 1e-2,
    "viscosity": 100.0,
    "branch_shares": 1.0,
    "branch_times": 0.1,
    "clamp": 1e-2,
    "added_mass": 1e-3,
}


def inputs(q: np.ndarray, damped: bool, random: np.random.Generator, steps: int) -> dict[str, Tensor]:
    values = {
        "q": q,
        "v": random.normal(0, 0.05, q.shape),
        "force": random.normal(0, 0.02, q.shape),
        "youngs_modulus": np.array([1e5, 2e5]),
        "poissons_ratio": np.array([0.4, 0.45]),
        "density": np.array(1070.0),
        "gravity": np.array([0.5, -0.3, -9.8]),
        "clamp": q[:, FIXED] + random.normal(0, 1e-3, (steps, 2, len(FIXED), 3)),
        "added_mass": random.uniform(0, 1e-3, q.shape[:2]),
    }
    if damped:
        values |= {
            "mass_damping": np.array(2.0),
            "stiffness_damping": np.array(3e-3),
            "viscosity": np.array(15.0),
            "branch_shares": np.array([0.2, 0.1]),
            "branch_times": np.array([[0.005, 0.08], [0.01, 0.3]]),
        }
    return {key: torch.tensor(value / SCALE[key], dtype=torch.float64) for key, value in values.items()}


def simulate(simulator: Simulator, scaled: dict[str, Tensor], steps: int) -> Tensor:
    values = {key: SCALE[key] * value for key, value in scaled.items()}
    q, v, force, clamp, added = (values.pop(key) for key in ("q", "v", "force", "clamp", "added_mass"))
    start = Start(q, v, force, added, ("a", "b"))
    return rollout(simulator, start, steps, parameters=simulator.parameters(**values), clamp=clamp)[0][1:]


@pytest.mark.parametrize("name", ["rest", "repeated stretches", "shaken", "turned", "near inversion"])
@pytest.mark.parametrize(
    ("integrator", "law", "integration", "damped"),
    [
        ("implicit-euler", "projective", "full", False),
        ("implicit-euler", "corotated", "full", True),
        ("implicit-euler", "neo-hookean", "enhanced", True),
        ("generalised-alpha", "neo-hookean", "full", False),
        ("generalised-alpha", "projective", "full", True),
        ("generalised-alpha", "corotated", "enhanced", False),
        ("generalised-alpha", "corotated", "enhanced", True),
    ],
)
def test_gradients(
    name: str, integrator: str, law: str, integration: str, damped: bool, random: np.random.Generator
) -> None:
    """With respect to initial state, forces, masses, material, gravity, damping, branches and motion of the clamp."""
    steps = 3
    simulator = simulator_of(integrator, law=law, integration=integration)
    scaled = inputs(state(name, random), damped, random, steps)
    keys = list(scaled)
    weights = torch.tensor(random.normal(size=(steps, 2, len(MESH.vertices), 3)))

    def loss(*leaves: Tensor) -> Tensor:
        return 100.0 * (weights * simulate(simulator, dict(zip(keys, leaves, strict=True)), steps)).sum()

    leaves = [scaled[key].requires_grad_() for key in keys]
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-4, rtol=1e-4, fast_mode=True)


def test_gradients_by_the_material_of_distorted_cells(random: np.random.Generator) -> None:
    """Every cell has a hourglass stiffness of its own, which depends on E, nu and the damping."""
    mesh = HexMesh(MESH.vertices + random.uniform(-2e-3, 2e-3, MESH.vertices.shape), MESH.hexes)
    material = Material(1e5, 0.4, mass="lumped", law="corotated", integration="enhanced")
    simulator = Simulator(mesh, material, FIXED, integrator="generalised-alpha")
    q = torch.tensor(mesh.vertices + random.normal(0, 1e-3, (2, *mesh.vertices.shape)))
    weights = torch.tensor(random.normal(size=q.shape))

    def loss(e: Tensor, nu: Tensor, viscosity: Tensor, damping: Tensor, shares: Tensor) -> Tensor:
        own = {"youngs_modulus": 1e5 * e, "poissons_ratio": nu, "viscosity": 100.0 * viscosity}
        own |= {"stiffness_damping": 1e-2 * damping, "branch_shares": shares, "branch_times": torch.tensor([0.01, 0.1])}
        parameters = simulator.parameters(**own)
        return 100.0 * (weights * rollout(simulator, start_of(q), 3, parameters=parameters)[0][-1]).sum()

    values = ([1.0, 2.0], [0.4, 0.45], 0.2, 0.3, [0.1, 0.3])
    leaves = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in values]
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-4, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize(("law", "integration"), [*((law, "full") for law in LAWS), ("corotated", "enhanced")])
def test_gradients_of_the_equilibrium(law: str, integration: str, random: np.random.Generator) -> None:
    simulator = simulator_of(law=law, integration=integration)
    force = torch.tensor(random.normal(0, 0.2, (2, len(MESH.vertices), 3)))
    modulus = torch.tensor([10.0, 12.0], dtype=torch.float64)
    ratio, density, gravity = (torch.tensor(x, dtype=torch.float64) for x in (4.0, 1.07, [0.1, 0.2, -0.98]))
    fixed = torch.tensor(MESH.vertices[FIXED] / SCALE["clamp"]).repeat(2, 1, 1)
    weights = torch.tensor(random.normal(size=force.shape))

    def loss(force: Tensor, e: Tensor, nu: Tensor, rho: Tensor, gravity: Tensor, fixed: Tensor) -> Tensor:
        own = {"youngs_modulus": e, "poissons_ratio": nu, "density": rho, "gravity": gravity}
        parameters = simulator.parameters(**{key: SCALE[key] * value for key, value in own.items()})
        q = equilibrium(simulator, SCALE["force"] * force, parameters, SCALE["clamp"] * fixed)
        return 100.0 * (weights * q).sum()

    leaves = [x.requires_grad_() for x in (force, modulus, ratio, density, gravity, fixed)]
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-4, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_adjoint_is_the_transpose_of_the_derivative(integrator: str, random: np.random.Generator) -> None:
    """Dot-product test <w, J d> = <J^T w, d> to 1e-9 over five steps.

    J d is computed in forward mode: the perturbation takes linear steps with the same tangents. The formulas of the
    integrators are linear in the state, so they also hold for the perturbation.
    """
    steps = 5
    simulator = simulator_of(integrator)
    q, v, force = (torch.tensor(x) for x in (state("shaken", random), *random.normal(0, 0.05, (2, 2, 12, 3))))
    leaves = [x.clone().requires_grad_() for x in (q, v, force)]
    positions, _ = rollout(simulator, start_of(*leaves), steps)
    weights = torch.tensor(random.normal(size=positions.shape))
    dq, dv, df = (torch.tensor(random.normal(size=x.shape)) for x in (q, v, force))
    gradients = torch.autograd.grad(positions, leaves, weights)
    transposed = sum(float((g * x).sum()) for g, x in zip(gradients, (dq, dv, df), strict=True))

    engine, constitutive, method = simulator.engine, simulator.constitutive_state(2), INTEGRATOR_OF[integrator]
    mass, zeros = torch.from_numpy(simulator.node_mass).expand(2, -1), torch.zeros(2, 1, dtype=torch.float64)
    free, fixed = engine.free_index, torch.from_numpy(FIXED)

    def tangents(x: Tensor) -> np.ndarray:
        return engine.evaluate(x.detach().numpy(), constitutive, tangent=True)[2]

    def solution_change(method: Integrator, change: State, x: Tensor, h: float) -> Tensor:
        """Change of the solution x of a step due to a change of the state before it."""
        problem = method.problem(change, mass, zeros, h)
        change_of_x = torch.zeros_like(dq)
        change_of_x[:, fixed] = change.q[:, fixed]
        fixed_force = torch.from_numpy(engine.multiply(tangents(x), change_of_x.numpy()))
        right = (problem.inertia[..., None] * problem.target + df - fixed_force).numpy().reshape(2, -1)[:, free]
        diagonal = np.repeat(problem.inertia.numpy(), 3, axis=1)[:, free]
        flat = change_of_x.reshape(2, -1)
        flat[:, free] = torch.from_numpy(engine.solve_once(tangents(x), diagonal, right[:, None])[:, 0])
        return flat.reshape(dq.shape)

    total, h = float((weights[0] * dq).sum()), simulator.time_step
    change = State(dq, dv, torch.zeros_like(dq))
    if method.uses_acceleration:
        short, body = FIRST_ACCELERATION_FRACTION * h, _BodyBatch.of(simulator, None, zeros.expand(2, 12))
        first = body.initial_acceleration(
            State(q, v, torch.zeros_like(q)), force + body.weight, zeros, q[:, fixed], None, short
        )
        first[:, fixed] = -v[:, fixed] / short
        x = solution_change(INTEGRATOR_OF["implicit-euler"], change, q + short * v + short**2 * first, short)
        start = ((x - dq) / short - dv) / short
        start[:, fixed] = 0.0
        change = State(dq, dv, start)
    before = positions[0]
    for step in range(steps):
        after = positions[step + 1]
        x = before + method.fraction * (after - before)  # where the equation of the step holds
        change = method.advance(change, solution_change(method, change, x, h), h)
        total += float((weights[step + 1] * change.q).sum())
        before = after
    assert total == pytest.approx(transposed, rel=1e-9)


def test_residual_force_acts_like_an_external_force() -> None:
    """Paper, eq. 2: a constant force has the same effect as external force and as residual."""
    simulator = simulator_of()
    q = torch.tensor(MESH.vertices[None])
    extra = 0.01 * torch.ones_like(q)
    seen = []

    def residual(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
        seen.append(external)
        return extra

    by_hook, forces = rollout(simulator, start_of(q), 4, residual)
    by_load, no_forces = rollout(simulator, start_of(q, force=extra), 4)
    torch.testing.assert_close(by_hook, by_load, atol=1e-12, rtol=0)
    torch.testing.assert_close(seen[0][0], torch.from_numpy(simulator.weight))
    assert forces.shape == (4, *q.shape)
    assert no_forces.numel() == 0


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_uniformly_moving_clamp_causes_no_strain(integrator: str) -> None:
    """Clamp and body move at the same constant velocity."""
    simulator = Simulator(MESH, Material(), FIXED, gravity=(0.0, 0.0, 0.0), integrator=integrator)
    q = torch.tensor(MESH.vertices[None])
    speed = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    moves = simulator.time_step * torch.arange(1, 7)[:, None, None, None] * speed
    clamp = q[:, FIXED] + moves
    positions, _ = rollout(simulator, start_of(q, speed.expand_as(q)), 6, clamp=clamp)
    torch.testing.assert_close(positions[1:], q + moves, atol=2e-9, rtol=0)


@pytest.mark.parametrize("substeps", [1, 4])
def test_substeps_equal_smaller_time_steps(substeps: int) -> None:
    q = torch.tensor(MESH.vertices[None])
    material = Material(mass="lumped")
    coarse = Simulator(MESH, material, FIXED, 0.01, substeps=substeps)
    fine = Simulator(MESH, material, FIXED, 0.01 / substeps)
    positions, _ = rollout(coarse, start_of(q), 5)
    every, _ = rollout(fine, start_of(q), 5 * substeps)
    torch.testing.assert_close(positions, every[::substeps], atol=1e-11, rtol=0)


def test_failed_step_names_trajectory_and_step() -> None:
    simulator = simulator_of()
    q = torch.tensor(MESH.vertices[None])
    calls = []

    def bad(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
        calls.append(1)
        return torch.full_like(q, torch.nan if len(calls) == 3 else 0.0)

    with pytest.raises(SimulationError, match=r"step 3: trajectory 0 .*trajectories: a"):
        rollout(simulator, start_of(q), 5, bad)


def test_both_integrators_simulate_a_body_released_at_one_node() -> None:
    """The force jumps at that node; with the exact initial acceleration generalised-alpha failed in the fourth step."""
    mesh = HexMesh.box((6, 2, 2), (0.06, 0.02, 0.02))
    material = Material(1.5e5, 0.49, mass="lumped", law="corotated", viscosity=300.0)
    tip = mesh.face_nodes("x-max")
    force = torch.zeros(1, len(mesh.vertices), 3, dtype=torch.float64)
    force[0, tip[0], 2] = 1.0
    swings = []
    for integrator in INTEGRATORS:
        simulator = Simulator(mesh, material, mesh.face_nodes("x-min"), integrator=integrator)
        positions, _ = rollout(simulator, start_of(equilibrium(simulator, force)), 30)
        swings.append(positions[:, 0, tip[-1], 2].numpy())
    damped, free = swings
    assert np.abs(free[:3] - damped[:3]).max() < 4e-3 < np.ptp(damped)
    assert np.ptp(damped) < np.ptp(free) < 2.0 * np.ptp(damped)
