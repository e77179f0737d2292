"""Elastic laws: their derivatives in kernels and tensors, and what is refused as an energy."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
import torch
from energies import OWN_ENERGIES, gent
from numba import njit
from scipy.optimize import brentq, minimize
from support import ROOT

from rafl.common.errors import SimulationError
from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.elements import element_terms
from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, ROWS, SECOND, STRETCH
from rafl.fem.laws import BUILT_IN, ENERGIES, LAWS, log, projective, register_law
from rafl.fem.laws.derivation import module as law_files
from rafl.fem.laws.derivation.energy import symbolic_energy
from rafl.fem.laws.derivation.expansion import STRETCHES
from rafl.fem.laws.generated.__main__ import sources
from rafl.fem.laws.kernel import fill_derivatives
from rafl.fem.laws.law import Energy, Law
from rafl.fem.laws.mooney_rivlin import SHARE
from rafl.fem.laws.yeoh import C2
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.compiled_engine import CompiledEngine
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator

MU, LAM = 1.3, 7.0

CASES = {
    "rest": [1.0, 1.0, 1.0],
    "repeated": [1.2, 1.2, 0.9],
    "distinct": [1.5, 1.1, 0.7],
    "expanded": [1.3, 1.25, 1.2],
    "lower branch": [5.0, 1.0, 0.5],
    "flat": [1.1, 0.9, 0.05],
    "inverted": [1.1, 0.8, -0.2],
}
OWN_CASES = ("rest", "repeated", "distinct", "expanded", "lower branch")  # far from where an energy is infinite
SYMBOLIC_ENERGIES: dict[str, Energy] = {name: module.energy for name, module in ENERGIES.items()} | OWN_ENERGIES


def cases(*names: str) -> list[Any]:
    """Parameters of each law at those of the named cases that it is defined for."""
    laws = [(law, case) for law in BUILT_IN for case in names]
    laws += [(law, case) for law in OWN_ENERGIES for case in names if case in OWN_CASES]
    return [pytest.param(law, CASES[case], id=f"{law}-{case}") for law, case in laws]


for_each_case = pytest.mark.parametrize(("name", "s"), cases(*CASES))
for_each_law = pytest.mark.parametrize("name", [*BUILT_IN, *OWN_ENERGIES])


@functools.cache
def law_named(name: str) -> Law:
    return LAWS[name] if name in BUILT_IN else Law.of_energy(name, OWN_ENERGIES[name])


@pytest.fixture
def own_law() -> Iterator[str]:
    """The name of a law that is registered during a test."""
    register_law("gent", gent)
    yield "gent"
    del LAWS["gent"]


@njit
def call_kernel(address: int, w: np.ndarray, mu: float, lam: float) -> None:
    fill_derivatives(address, w, mu, lam)


def kernel_derivatives(
    name: str, s: list[float], mu: float = MU, lam: float = LAM
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Energy, first (3), second (3, 3), flip (3) from one SIMD lane of the kernel; the other lanes are at rest."""
    w = np.zeros((ROWS, 8))
    w[STRETCH : STRETCH + 3] = 1.0
    w[STRETCH : STRETCH + 3, 5] = s
    call_kernel(law_named(name).kernel.address, w.reshape(-1), mu, lam)
    lane = w[:, 5]
    d = lane[SECOND : SECOND + 6]
    second = np.array([[d[0], d[3], d[5]], [d[3], d[1], d[4]], [d[5], d[4], d[2]]])
    return lane[ENERGY], lane[FIRST : FIRST + 3].copy(), second, lane[FLIP : FLIP + 3].copy()


@for_each_case
def test_kernel_agrees_with_reference(name: str, s: list[float]) -> None:
    """The kernel accepts the stretches in any order."""
    mu, lam = (torch.tensor(value, dtype=torch.float64) for value in (MU, LAM))
    tensors = law_named(name).reference_derivatives(torch.tensor([s, s], dtype=torch.float64), mu, lam)
    reference = [x[1].numpy() for x in tensors]
    for shift in range(3):
        energy, first, second, flip = kernel_derivatives(name, np.roll(s, shift).tolist())
        assert energy == pytest.approx(reference[0], rel=1e-12, abs=1e-13)
        np.testing.assert_allclose(first, np.roll(reference[1], shift), rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(second, np.roll(reference[2], (shift, shift), (0, 1)), rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(flip, np.roll(reference[3], shift), rtol=1e-10, atol=1e-11)


@for_each_case
def test_derivatives_match_finite_differences(name: str, s: list[float]) -> None:
    _, first, second, _ = kernel_derivatives(name, s)
    h = 1e-6
    for i in range(3):
        up, down = list(s), list(s)
        up[i] += h
        down[i] -= h
        first_difference = (kernel_derivatives(name, up)[0] - kernel_derivatives(name, down)[0]) / (2 * h)
        assert first[i] == pytest.approx(first_difference, rel=1e-6, abs=1e-8)
        second_difference = (kernel_derivatives(name, up)[1] - kernel_derivatives(name, down)[1]) / (2 * h)
        np.testing.assert_allclose(second[i], second_difference, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("name", "s"), cases("distinct", "flat", "inverted", "lower branch"))
def test_flip_is_the_divided_difference_of_the_first_derivatives(name: str, s: list[float]) -> None:
    _, first, _, flip = kernel_derivatives(name, s)
    for k in range(3):
        i, j = k, (k + 1) % 3
        assert flip[k] == pytest.approx((first[i] - first[j]) / (s[i] - s[j]), rel=1e-7)


@for_each_law
def test_flip_at_repeated_stretches_is_the_limit_of_the_divided_difference(name: str) -> None:
    exact = kernel_derivatives(name, [1.2, 1.2, 0.9])[3][0]
    first = kernel_derivatives(name, [1.2 + 1e-5, 1.2 - 1e-5, 0.9])[1]
    assert exact == pytest.approx((first[0] - first[1]) / 2e-5, rel=1e-6)


@for_each_law
def test_law_linearises_to_its_rest_lame_parameters(name: str) -> None:
    """At rest d^2 psi / ds_i ds_j = 2 mu delta_ij + lambda, and the stress is zero."""
    mu, lam = (float(x) for x in law_named(name).rest_lame(torch.tensor(MU), torch.tensor(LAM)))
    assert (mu, lam) == pytest.approx((MU, LAM / 3 if name == "projective" else LAM))
    _, first, second, flip = kernel_derivatives(name, [1.0, 1.0, 1.0])
    np.testing.assert_allclose(first, 0.0, atol=1e-14)
    np.testing.assert_allclose(second, 2 * mu * np.eye(3) + lam, rtol=1e-6)
    np.testing.assert_allclose(flip, 2 * mu)


def exact_derivatives(energy: Energy) -> Callable[..., list[Any]]:
    """Energy, psi_0, psi_1 and psi_01 of an energy as functions of three numbers of mpmath."""
    psi = symbolic_energy(energy).subs({"mu": sympy.Rational(str(MU)), "lam": sympy.Rational(str(LAM))})
    values = [psi, psi.diff(STRETCHES[0]), psi.diff(STRETCHES[1]), psi.diff(STRETCHES[0], STRETCHES[1])]
    function = sympy.lambdify(STRETCHES, values, "mpmath")
    rest = function(*[mpmath.mpf(1)] * 3)[0]  # zero but for the rounding of constants

    def derivatives(*s: float) -> list[Any]:
        energy, *others = function(*map(mpmath.mpf, s))
        return [energy - rest, *others]

    return derivatives


@pytest.mark.parametrize("name", SYMBOLIC_ENERGIES)
def test_energy_and_stress_keep_their_digits_at_small_strain(name: str) -> None:
    """At strains of 1e-6 within 1e-9 of the values with 50 digits, although numbers of the order 1 cancel."""
    s = [1 + 1.3e-6, 1 - 0.7e-6, 1 + 0.2e-6]
    with mpmath.workdps(50):
        exact = [float(x) for x in exact_derivatives(SYMBOLIC_ENERGIES[name])(*s)]
    energy, first, second, _ = kernel_derivatives(name, s)
    assert energy == pytest.approx(exact[0], rel=1e-9)
    np.testing.assert_allclose(first[:2], exact[1:3], rtol=1e-9)
    assert second[0, 1] == pytest.approx(exact[3], rel=1e-12)


@pytest.mark.parametrize("name", SYMBOLIC_ENERGIES)
@pytest.mark.parametrize("gap", [1e-9, 1e-5, 1.29e-3, 1.31e-3, 1e-2])
def test_flip_keeps_its_digits_near_repeated_stretches(name: str, gap: float) -> None:
    """Within 1e-11 of the divided difference with 50 digits, on both sides of where its form changes (1.3e-3)."""
    s = [1.3, 1.3 - gap, 0.8]
    with mpmath.workdps(50):
        _, first, second, _ = exact_derivatives(SYMBOLIC_ENERGIES[name])(*s)
        exact = float((first - second) / (mpmath.mpf(s[0]) - mpmath.mpf(s[1])))
    assert kernel_derivatives(name, s)[3][0] == pytest.approx(exact, rel=1e-11)


def invariant(x: float) -> float:
    """|F|^2 - 3 of a bar of stretch x that keeps its volume."""
    return x**2 + 2 / x - 3


# Engineering stress of a bar that keeps its volume, relative to mu, at stretch x.
UNIAXIAL: dict[str, Callable[[float], float]] = {
    "projective": lambda x: 2 * (x - 1) - 2 * (x**-0.5 - 1) * x**-1.5,
    "corotated": lambda x: 3 * (x - 1),  # its volume term is the trace of the strain
    "neo-hookean": lambda x: x - x**-2,
    "yeoh": lambda x: (x - x**-2) * (1 + 2 * C2 * invariant(x)),
    "mooney-rivlin": lambda x: (x - x**-2) * (1 - SHARE + SHARE / x),
    "gent": lambda x: (x - x**-2) / (1 - invariant(x) / 30),
    "ogden": lambda x: 1.2 * (x**0.5 - x**-1.75) - 0.1 * (x**-3 - 1),
    "hencky": lambda x: 3 * np.log(x) / x,
}


def bar_stress(name: str, x: float, nu: float) -> float:
    """Engineering stress of one cell at stretch x, relative to mu; its lateral stretch makes the sides free."""
    mesh = HexMesh.box((1, 1, 1), (0.02, 0.02, 0.02))
    simulator = Simulator(mesh, Material(3e5, nu, law=name), mesh.face_nodes("x-min"), gravity=(0.0, 0.0, 0.0))

    def forces(lateral: float) -> np.ndarray:
        return simulator.elastic_gradient(mesh.vertices[None] * [x, lateral, lateral])[0]

    side = mesh.face_nodes("y-max")
    lateral = brentq(lambda y: forces(y)[side, 1].sum(), 0.6 * x**-0.5, 1.2 * x**-0.5, xtol=1e-14)
    return float(forces(lateral)[mesh.face_nodes("x-max"), 0].sum() / 0.02**2 / simulator.material.lame[0])


@pytest.mark.parametrize("x", [0.8, 1.1, 1.5, 2.0])
@pytest.mark.parametrize("name", UNIAXIAL)
def test_bar_in_tension(name: str, x: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The closed form of a rubber that keeps its volume, at nu = 0.4999.

    The bar's volume changes by about the stress over the bulk modulus, 2e-4 for a strain of 1, and the stress by a few
    times that. The corotated law keeps the trace of its strain instead, at any nu.
    """
    monkeypatch.setitem(LAWS, name, law_named(name))
    assert bar_stress(name, x, 0.4999) == pytest.approx(UNIAXIAL[name](x), rel=1e-3)


def test_laws_share_one_kernel(own_law: str) -> None:
    """Another law compiles no other element kernel."""
    mesh = HexMesh.box((1, 1, 1), (0.02, 0.02, 0.02))
    q, state = 1.1 * mesh.vertices[None], ConstitutiveState(np.array([[MU, LAM, 0.0, 0.0, 0.0]]))
    count, energies = set(), set()
    for name in ("corotated", "yeoh", own_law):
        engine = CompiledEngine(mesh, name, "full", mesh.face_nodes("x-min"))
        energies.add(float(engine.evaluate(q, state, tangent=False)[0][0]))
        count.add(len(element_terms.signatures))
    assert len(energies) == 3
    assert len(count) == 1


@pytest.mark.parametrize("integration", ["full", "selective"])
def test_own_law_in_kernels_and_tensors(own_law: str, integration: str, random: np.random.Generator) -> None:
    """Trajectories agree to 1e-10, gradients by E and nu to 1e-8."""
    mesh = HexMesh.box((3, 1, 1), (0.06, 0.02, 0.02))
    material = Material(1e5, 0.4, mass="lumped", law=own_law, integration=integration, viscosity=10.0)
    kick = torch.tensor(random.normal(0, 0.3, (1, *mesh.vertices.shape)))
    found = []
    for arithmetic in ("compiled", "torch"):
        simulator = Simulator(mesh, material, mesh.face_nodes("x-min"), arithmetic=arithmetic)
        values = {
            "youngs_modulus": torch.tensor(1e5, dtype=torch.float64, requires_grad=True),
            "poissons_ratio": torch.tensor(0.4, dtype=torch.float64, requires_grad=True),
        }
        start = Start(torch.tensor(mesh.vertices[None]), kick, 0 * kick, 0 * kick[..., 0], ("bar",))
        q, _ = rollout(simulator, start, 5, parameters=simulator.parameters(**values))
        (q[-1] ** 2).sum().backward()
        found.append((q.detach(), *(value.grad for value in values.values())))
    for compiled, tensors, tolerance in zip(*found, (1e-10, 1e-8, 1e-8), strict=True):
        assert compiled is not None
        assert float((compiled - tensors).abs().max()) < tolerance * float(tensors.abs().max())
        assert float(tensors.abs().max()) > 0


def test_gradient_by_the_modulus_of_an_own_law(own_law: str) -> None:
    """A beam under its weight: adjoint derivative by E against a difference."""
    mesh = HexMesh.box((4, 1, 1), (0.08, 0.02, 0.02))
    simulator = Simulator(mesh, Material(5e4, 0.4, mass="lumped", law=own_law), mesh.face_nodes("x-min"))
    zero = torch.zeros(1, *mesh.vertices.shape, dtype=torch.float64)
    start = Start(torch.tensor(mesh.vertices[None]), zero, zero, zero[..., 0], ("beam",))

    def height(modulus: torch.Tensor) -> torch.Tensor:
        q, _ = rollout(simulator, start, 4, parameters=simulator.parameters(youngs_modulus=modulus))
        return q[-1, 0, -1, 2]

    modulus = torch.tensor(5e4, dtype=torch.float64, requires_grad=True)
    height(modulus).backward()
    up, down = (float(height(torch.tensor(5e4 + h, dtype=torch.float64))) for h in (50.0, -50.0))
    assert float(modulus.grad) == pytest.approx((up - down) / 100.0, rel=1e-4)  # type: ignore[arg-type]


def test_a_step_that_begins_where_the_energy_is_not_defined(own_law: str) -> None:
    """A tip that flies through its clamp inverts the cell, whose volume has no logarithm: an error, no result."""
    mesh = HexMesh.box((1, 1, 1), (0.02, 0.02, 0.02))
    simulator = Simulator(mesh, Material(law=own_law, mass="lumped"), mesh.face_nodes("x-min"))
    v = torch.zeros(1, *mesh.vertices.shape, dtype=torch.float64)
    v[:, mesh.face_nodes("x-max"), 0] = -3.0
    start = Start(torch.tensor(mesh.vertices[None]), v, 0 * v, 0 * v[..., 0], ("tip",))
    with pytest.raises(SimulationError, match="step 1"):
        rollout(simulator, start, 1)


def test_generated_files_are_up_to_date() -> None:
    """`make laws` would change nothing."""
    if f"sympy=={sympy.__version__}\n" not in (ROOT / "constraints.txt").read_text():
        pytest.skip("another version of sympy may write the same derivatives in another order")
    for stem, text in sources().items():
        assert (ROOT / "rafl/fem/laws/generated" / f"{stem}.py").read_text(encoding="utf-8") == text


def squares(s0: Any, s1: Any, s2: Any) -> Any:
    return (s0 - 1) ** 2 + (s1 - 1) ** 2 + (s2 - 1) ** 2


@pytest.mark.parametrize(
    ("energy", "message"),
    [
        (lambda s0, s1, s2, mu, lam: mu**2 * squares(s0, s1, s2), "linear in mu and lam"),
        (lambda s0, s1, s2, mu, lam: squares(s0, s1, s2), "linear in mu and lam"),
        (lambda s0, s1, s2, mu, lam: mu * squares(s0, s1, 1), "s1 and s2 are exchanged, got 0.0013"),
        (lambda s0, s1, s2, mu, lam: mu * (s0**2 + s1**2 + s2**2 - 2), "no energy at rest .* got 1 mu"),
        (lambda s0, s1, s2, mu, lam: mu * (s0**2 + s1**2 + s2**2 - 3), "no stress at rest .* got 2 mu"),
        (lambda s0, s1, s2, mu, lam: lam * (s0 + s1 + s2 - 3) ** 2, "shear modulus at rest"),
        (lambda s0, s1, s2, mu, lam: mu * (s0**2 + s1**2 + s2**2 - 3) ** 1.5, "smooth at rest"),
        (lambda s0, s1, s2, mu, lam: mu * squares(s0, s1, s2) if s0 > 1 else 0, "can be called with symbols"),
        (lambda s0, s1, s2, mu, lam: mu * np.log(s0 * s1 * s2) ** 2, "log, exp, sqrt of rafl.fem.laws"),
        (lambda s0, s1, s2, mu, lam: mu * abs(s0 * s1 * s2 - 1) * squares(s0, s1, s2), "Abs"),
        (lambda s0, s1, s2, mu, lam: mu * squares(s0, s1, s2) + 1e-9 * mu * log(s0 * s1 * s2), "no stress at rest"),
        (lambda s0, s1, s2, mu, lam: mu * sympy.Symbol("x"), "s0, s1, s2, mu and lam only"),
    ],
)
def test_energies_that_are_refused(energy: Energy, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        register_law("refused", energy)
    assert "refused" not in LAWS


def test_names_that_are_refused() -> None:
    for name in (*BUILT_IN, "", 'a"b'):
        with pytest.raises(ValueError, match="choose another"):
            register_law(name, gent)
    with pytest.raises(ValueError, match=r"yeoh.*, got 'jelly'; register a law of your own first"):
        Material(law="jelly")


def test_derivatives_are_computed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second call reads the file of the first; another energy gets another file."""
    monkeypatch.setattr(law_files, "cache_folder", lambda: tmp_path)
    first = Law.of_energy("my gent", gent)
    (path,) = tmp_path.glob("my_gent_*.py")
    with monkeypatch.context() as patch:
        patch.setattr(law_files, "derive", None)
        assert Law.of_energy("my gent", gent).derivatives.__code__ == first.derivatives.__code__
    Law.of_energy("my gent", lambda *x: 2 * gent(*x))
    assert len(list(tmp_path.glob("my_gent_*.py"))) == 2
    assert path.exists()


def test_law_without_a_folder_to_write_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(law_files, "cache_folder", lambda: tmp_path / "file" / "folder")
    law = Law.of_energy("gent", gent)
    w = np.ones(ROWS * 8)
    call_kernel(law.kernel.address, w, MU, LAM)
    assert w[SECOND * 8] == pytest.approx(2 * MU + LAM)


@pytest.mark.parametrize("s", CASES.values(), ids=CASES.keys())
def test_projection_gives_the_nearest_stretches_of_product_one(s: list[float]) -> None:
    p = np.empty(3)
    projective.volume_projection(np.array(s), p)
    assert p.prod() == pytest.approx(1.0, abs=1e-12)
    smallest_distance = min(
        minimize(
            lambda a: ((np.array(s) - np.array([*np.exp(a), np.exp(-a.sum())])) ** 2).sum(),
            start,
            method="Nelder-Mead",
            options={"xatol": 1e-10, "fatol": 1e-14, "maxiter": 4000},
        ).fun
        for start in ([0.0, 0.0], [1.0, 0.0], np.log(p[:2]))
    )
    assert ((np.array(s) - p) ** 2).sum() == pytest.approx(smallest_distance, abs=1e-9)
