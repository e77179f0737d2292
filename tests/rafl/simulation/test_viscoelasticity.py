"""Maxwell branches against closed forms."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from rafl.fem.material import Material
from rafl.fem.maxwell import branch_shares, branch_times, complex_modulus
from rafl.fem.mesh import HexMesh
from rafl.simulation.adjoint import SolveContext, _constitutive_state, strains
from rafl.simulation.rollout import Start, rollout, simulate_steps
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS
from rafl.simulation.viscous_memory import ViscousMemory

SHARES, TIMES = (0.06, 0.1, 0.2), (0.01, 0.1, 1.0)
TIMES_TO_SETTLE = 3.0  # longest relaxation times, after which 5 % of the transient of the slowest branch is left
NO_GRAVITY = (0.0, 0.0, 0.0)
CELL = HexMesh.box((1, 1, 1), (0.01, 0.01, 0.01))
SCHEMES = pytest.mark.parametrize("integration", ["full", "selective", "enhanced"])


def cell_simulator(integration: str) -> Simulator:
    material = Material(1e5, 0.45, law="corotated", integration=integration, branch_shares=SHARES, branch_times=TIMES)
    return Simulator(CELL, material, np.arange(8), gravity=NO_GRAVITY)


def shear_stress(simulator: Simulator, shear: np.ndarray, h: float, mode: str = "shear") -> np.ndarray:
    """Force along the motion [N], per shear and area or per bending amplitude, at every step of a history of strain.

    `shear`: the top moves along x with this shear strain. `bending`: the hourglass mode of bending has this amplitude.
    """
    engine, parameters = simulator.engine, simulator.parameters()
    shape = np.zeros((8, 3))
    corners = CELL.vertices / 0.01
    if mode == "shear":
        shape[:, 0] = 0.01 * corners[:, 2]
    else:
        shape[:, 0] = 0.01 * (corners[:, 0] - 0.5) * (corners[:, 2] - 0.5)
    rest = torch.from_numpy(CELL.vertices[None])
    branches = parameters.branches(simulator.material.law, 1)
    points = len(engine.quadrature.points.shape)
    memory = ViscousMemory(torch.zeros(1, dtype=torch.float64), points, *branches, strains(rest, engine))
    hourglass = simulator.hourglass_stiffness(parameters, 1)
    found = []
    for amount in shear:
        q = rest + amount * torch.from_numpy(shape)
        moduli = parameters.moduli(simulator.material.law, 1)
        viscous = memory.stress_terms(h)
        state = _constitutive_state(moduli, None, hourglass, *viscous, None, SolveContext(simulator, None))
        force = engine.evaluate(q.numpy(), state, tangent=False)[1][0]
        memory = memory.after(strains(q, engine), h)
        found.append((force * shape).sum())
    return np.array(found)


@SCHEMES
@pytest.mark.parametrize("frequencies", [pytest.param((0.1,), marks=pytest.mark.slow), (0.5, 2.0, 8.0, 20.0, 50.0)])
def test_storage_and_loss_modulus(integration: str, frequencies: tuple[float, ...]) -> None:
    """G' = G (1 + sum g x^2 / (1 + x^2)), G'' = G sum g x / (1 + x^2), x = 2 pi f tau: within 1 % of |G*| at 1 ms.

    A small shear strain oscillates with multiples of the first frequency; the response to the last period of that one,
    when the first transient is over, is decomposed.
    """
    h = 1e-3
    period = round(1.0 / (frequencies[0] * h))
    lead = period * int(np.ceil(TIMES_TO_SETTLE * max(TIMES) / (period * h)))
    time = h * np.arange(1, lead + period + 1)
    waves = [2 * np.pi * frequency * time for frequency in frequencies]
    response = shear_stress(cell_simulator(integration), 1e-5 * np.sin(waves).sum(axis=0), h)[-period:]
    static = shear_stress(cell_simulator(integration), np.array([1e-5] * 2), 1e9)[-1] / 1e-5
    for frequency, wave in zip(frequencies, waves, strict=True):
        storage = 2 * (response * np.sin(wave[-period:])).mean() / 1e-5 / static
        loss = 2 * (response * np.cos(wave[-period:])).mean() / 1e-5 / static
        expected = complex_modulus(
            torch.tensor(SHARES), torch.tensor(TIMES), torch.tensor([frequency], dtype=torch.float64)
        )
        size = float(torch.hypot(*expected))
        assert storage == pytest.approx(float(expected[0]), abs=0.01 * size), frequency
        assert loss == pytest.approx(float(expected[1]), rel=0.012), frequency


@SCHEMES
@pytest.mark.parametrize("mode", ["shear", "bending"])
def test_relaxation_after_a_ramp_is_exact(integration: str, mode: str) -> None:
    """Strain that grows linearly over h and then stays: stress G (1 + sum g (1 - e^(-h/tau)) tau/h e^(-t/tau)).

    In bending a smaller share relaxes, because changes of volume do not: hardly any where the cell locks.
    """
    h = 5e-3
    simulator = cell_simulator(integration)
    found = shear_stress(simulator, np.full(60, 1e-6), h, mode)
    static = shear_stress(simulator, np.full(2, 1e-6), 1e9, mode)[-1]
    t = h * np.arange(60)
    shares, times = np.array(SHARES)[:, None], np.array(TIMES)[:, None]
    relaxing = (shares * -np.expm1(-h / times) * times / h * np.exp(-t / times)).sum(0)
    if mode == "shear":
        np.testing.assert_allclose(found / static, 1.0 + relaxing, rtol=1e-6)
    else:
        share = (found / static - 1.0) / relaxing
        np.testing.assert_allclose(share, share[0], rtol=1e-4)
        assert (0.9 if integration == "enhanced" else 0.2) < share[0] <= 1.0 + 1e-6


def test_branches_of_a_constant_loss_factor() -> None:
    """The loss factor of the branches is within 6 % of the requested one, and all shares are positive."""
    for tan_delta in (0.02, 0.1, 0.2):
        shares = branch_shares(torch.tensor(tan_delta, dtype=torch.float64), 0.5, 50.0)
        assert (shares > 0).all()
        times = torch.tensor(branch_times(0.5, 50.0), dtype=torch.float64)
        storage, loss = complex_modulus(shares, times, torch.logspace(-0.3, 1.7, 40, dtype=torch.float64))
        np.testing.assert_allclose(loss / storage, tan_delta, rtol=0.06)
    tan_delta = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: branch_shares(x, 0.5, 50.0), [tan_delta])


BEAM = HexMesh.box((5, 1, 1), (0.05, 0.01, 0.01))


def bent_beam(integrator: str, h: float, **values: object) -> tuple[Simulator, Start]:
    """A beam, its tip pulled aside, let go without gravity."""
    material = Material(1e5, 0.45, mass="lumped", law="corotated", integration="enhanced", **values)
    fixed = BEAM.face_nodes("x-min")
    simulator = Simulator(BEAM, material, fixed, h, NO_GRAVITY, integrator)
    force = np.zeros((1, len(BEAM.vertices), 3))
    force[:, BEAM.face_nodes("x-max"), 2] = 3e-3
    q = torch.from_numpy(simulator.equilibrium(force))
    return simulator, Start.at_rest(q)


def energies(integrator: str, steps: int, h: float) -> np.ndarray:
    """Kinetic, elastic and stored energy of the branches [J], after every step."""
    simulator, start = bent_beam(integrator, h, branch_shares=SHARES, branch_times=TIMES)
    engine, parameters = simulator.engine, simulator.parameters()
    state = simulator.constitutive_state(1)
    assert state.hourglass is not None
    mass = torch.from_numpy(simulator.node_mass)[:, None]
    branches = parameters.branches(simulator.material.law, 1)[0][0]
    volume = torch.from_numpy(BEAM.volumes)[:, None]
    multiplicity = torch.tensor([1.0, 1.0, 1.0, 2.0, 2.0, 2.0], dtype=torch.float64)
    viscous = torch.from_numpy(state.hourglass.viscous[0, 0])
    totals = [engine.evaluate(start.q.numpy(), state, tangent=False)[0][0]]
    with torch.no_grad():
        for step in simulate_steps(simulator, start, steps):
            kinetic = 0.5 * float((mass * step.state.v[0] ** 2).sum())
            elastic = engine.evaluate(step.state.q.numpy(), state, tangent=False)[0][0]
            assert step.memory is not None
            assert step.memory.branch_strain is not None
            stored = 0.0
            for modulus, own in zip(branches, step.memory.branch_strain[:, 0], strict=True):
                stored += float(modulus * (volume * multiplicity * own[:, :6] ** 2).sum())
                stored += float(0.5 * modulus * torch.einsum("ec,cd,ed->", own[:, 6:], viscous, own[:, 6:]))
            totals.append(kinetic + elastic + stored)
    return np.array(totals)


@pytest.mark.parametrize("steps", [500, pytest.param(10_000, marks=pytest.mark.slow)])
def test_energy_never_rises_with_implicit_euler(steps: int) -> None:
    """Kinetic, elastic and stored energy after every step is at most that before it."""
    found = energies("implicit-euler", steps, 2e-3)
    assert (np.diff(found) <= 1e-12 * found[0]).all()
    assert found[-1] < 0.1 * found[0]


@pytest.mark.parametrize("steps", [500, pytest.param(10_000, marks=pytest.mark.slow)])
def test_energy_decays_with_generalised_alpha(steps: int) -> None:
    """The energy never exceeds that before by more than its wobble within a step, and decays."""
    found = energies("generalised-alpha", steps, 2e-3)
    least = np.minimum.accumulate(found)
    assert (found[1:] - least[:-1] <= 0.03 * np.maximum(least[:-1], 1e-9 * found[0])).all()
    assert found[-1] < (1e-9 if steps > 5000 else 0.5) * found[0]


@functools.cache
def swinging_heights(integrator: str, h: float) -> np.ndarray:
    """Heights of all vertices of a beam with initial velocity in its first mode, every 8 ms."""
    simulator, start = bent_beam(integrator, h, branch_shares=SHARES, branch_times=TIMES, viscosity=200.0)
    rest = torch.from_numpy(BEAM.vertices[None])
    v = torch.zeros_like(rest)
    x = rest[..., 0] / 0.05
    v[..., 2] = 0.05 * x**2 * (6 - 4 * x + x**2)
    with torch.no_grad():
        q, _ = rollout(simulator, replace(start, q=rest, v=v), round(0.128 / h))
    return q[:: round(8e-3 / h), 0, :, 2].numpy()


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_order_in_time_with_branches(integrator: str) -> None:
    """RMS error relative to a solution with far smaller steps: order 1 and 2. Viscosity damps the highest modes."""

    exact = swinging_heights("generalised-alpha", 2.5e-4)
    errors = [np.sqrt(((swinging_heights(integrator, h) - exact) ** 2).mean()) for h in (2e-3, 1e-3)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1 if integrator == "implicit-euler" else 2, abs=0.25)


def test_equilibria_are_relaxed() -> None:
    """A body held for long under a load is where it is without branches."""
    simulator, start = bent_beam("generalised-alpha", 5e-3, branch_shares=SHARES, branch_times=TIMES)
    force = torch.zeros_like(start.q)
    force[:, BEAM.face_nodes("x-max"), 2] = 3e-3
    with torch.no_grad():
        q, _ = rollout(simulator, replace(start, force=force), 40)
    assert float((q - start.q).abs().max()) < 1e-9


def test_a_motion_continues_from_its_history() -> None:
    """From the state in the middle and the positions before it, implicit Euler repeats the rest of the motion."""
    simulator, start = bent_beam("implicit-euler", 5e-3, branch_shares=SHARES, branch_times=TIMES, viscosity=50.0)
    middle = 12
    with torch.no_grad():
        q, _ = rollout(simulator, start, 2 * middle)
        velocity = (q[middle] - q[middle - 1]) / simulator.time_step
        resumed = replace(start, q=q[middle], v=velocity, history=q[:middle])
        again, _ = rollout(simulator, resumed, middle)
        forgetful, _ = rollout(simulator, replace(resumed, history=None), middle)
    amplitude = float((q[-1] - start.q).abs().max())
    assert float((again - q[middle:]).abs().max()) < 1e-8 * amplitude
    assert float((forgetful - q[middle:]).abs().max()) > 1e-2 * amplitude
