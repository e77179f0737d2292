from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, ROWS, SECOND, STRETCH
from rafl.fem.laws import LAWS, projective

MU, LAM = 1.3, 7.0

CASES = {
    "rest": [1.0, 1.0, 1.0],
    "repeated": [1.2, 1.2, 0.9],
    "distinct": [1.5, 1.1, 0.7],
    "expanded": [1.3, 1.25, 1.2],
    "flat": [1.1, 0.9, 0.05],
    "inverted": [1.1, 0.8, -0.2],
    "lower branch": [5.0, 1.0, 0.5],
}
for_each_case = pytest.mark.parametrize("s", CASES.values(), ids=CASES.keys())
for_each_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())


def kernel_derivatives(law: ModuleType, s: list[float]) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Energy, first (3), second (3, 3), flip (3) from one SIMD lane of the kernel; the other lanes are at rest."""
    w = np.zeros((ROWS, 8))
    w[STRETCH : STRETCH + 3] = 1.0
    w[STRETCH : STRETCH + 3, 5] = s
    law.derivatives(w.reshape(-1), MU, LAM)
    lane = w[:, 5]
    d = lane[SECOND : SECOND + 6]
    second = np.array([[d[0], d[3], d[5]], [d[3], d[1], d[4]], [d[5], d[4], d[2]]])
    return lane[ENERGY], lane[FIRST : FIRST + 3].copy(), second, lane[FLIP : FLIP + 3].copy()


@for_each_law
@for_each_case
def test_kernel_agrees_with_reference(law: ModuleType, s: list[float]) -> None:
    """The kernel accepts the stretches in any order."""
    mu, lam = (torch.tensor(value, dtype=torch.float64) for value in (MU, LAM))
    reference = [x.numpy() for x in law.reference_derivatives(torch.tensor(s, dtype=torch.float64), mu, lam)]
    for shift in range(3):
        energy, first, second, flip = kernel_derivatives(law, np.roll(s, shift).tolist())
        assert energy == pytest.approx(reference[0], rel=1e-12, abs=1e-13)
        np.testing.assert_allclose(first, np.roll(reference[1], shift), rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(second, np.roll(reference[2], (shift, shift), (0, 1)), rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(flip, np.roll(reference[3], shift), rtol=1e-10, atol=1e-11)


@for_each_law
@for_each_case
def test_derivatives_match_finite_differences(law: ModuleType, s: list[float]) -> None:
    _, first, second, _ = kernel_derivatives(law, s)
    h = 1e-6
    for i in range(3):
        up, down = list(s), list(s)
        up[i] += h
        down[i] -= h
        first_difference = (kernel_derivatives(law, up)[0] - kernel_derivatives(law, down)[0]) / (2 * h)
        assert first[i] == pytest.approx(first_difference, rel=1e-6, abs=1e-8)
        second_difference = (kernel_derivatives(law, up)[1] - kernel_derivatives(law, down)[1]) / (2 * h)
        np.testing.assert_allclose(second[i], second_difference, rtol=1e-5, atol=1e-6)


@for_each_law
@pytest.mark.parametrize("s", [CASES["distinct"], CASES["flat"], CASES["inverted"], CASES["lower branch"]])
def test_flip_is_the_divided_difference_of_the_first_derivatives(law: ModuleType, s: list[float]) -> None:
    _, first, _, flip = kernel_derivatives(law, s)
    for k in range(3):
        i, j = k, (k + 1) % 3
        assert flip[k] == pytest.approx((first[i] - first[j]) / (s[i] - s[j]), rel=1e-7)


@for_each_law
def test_flip_at_repeated_stretches_is_the_limit_of_the_divided_difference(law: ModuleType) -> None:
    exact = kernel_derivatives(law, [1.2, 1.2, 0.9])[3][0]
    first = kernel_derivatives(law, [1.2 + 1e-5, 1.2 - 1e-5, 0.9])[1]
    assert exact == pytest.approx((first[0] - first[1]) / 2e-5, rel=1e-6)


@for_each_law
def test_law_linearises_to_its_rest_lame_parameters(law: ModuleType) -> None:
    """At rest d^2 psi / ds_i ds_j = 2 mu delta_ij + lambda, and the stress is zero."""
    mu, lam = (float(x) for x in law.rest_lame(torch.tensor(MU), torch.tensor(LAM)))
    _, first, second, flip = kernel_derivatives(law, [1.0, 1.0, 1.0])
    np.testing.assert_allclose(first, 0.0, atol=1e-14)
    np.testing.assert_allclose(second, 2 * mu * np.eye(3) + lam, rtol=1e-6)
    np.testing.assert_allclose(flip, 2 * mu)


@for_each_case
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
