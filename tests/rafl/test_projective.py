import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from rafl.projective import signed_svd, stretch_derivatives, volume_projection

MU, LAM = 1.3, 7.0

CASES = {
    "rest": [1.0, 1.0, 1.0],
    "repeated": [1.2, 1.2, 0.9],
    "distinct": [1.5, 1.1, 0.7],
    "swollen": [1.3, 1.25, 1.2],
    "flat": [1.1, 0.9, 0.05],
    "inverted": [1.1, 0.8, -0.2],
    "beyond the fold": [5.0, 1.0, 0.5],
}


def svd(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    U, s, V = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    signed_svd(F, U, s, V)
    return U, s, V


def energy_and_slopes(s: list[float]) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    first, second = np.empty(3), np.empty((3, 3))
    twist, flip = np.empty(3), np.empty(3)
    energy = stretch_derivatives(np.array(s), MU, LAM, first, second, twist, flip, np.empty(3))
    return energy, first, second, twist, flip


@settings(deadline=None, max_examples=200)
@given(st.lists(st.floats(-2, 2), min_size=9, max_size=9))
def test_signed_svd(entries: list[float]) -> None:
    F = np.array(entries).reshape(3, 3)
    if np.linalg.norm(F) < 1e-3:
        return
    U, s, V = svd(F)
    np.testing.assert_allclose(U @ np.diag(s) @ V.T, F, atol=1e-13)
    for rotation in (U, V):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert s[0] >= s[1] >= abs(s[2]) - 1e-12
    np.testing.assert_allclose(np.abs(s), np.linalg.svd(F, compute_uv=False), atol=1e-12)


def test_svd_of_special_matrices() -> None:
    for F in (np.eye(3), -np.eye(3), np.diag([2.0, 2.0, 1.0]), np.diag([1.0, 0.0, 0.0]), np.ones((3, 3))):
        U, s, V = svd(F)
        np.testing.assert_allclose(U @ np.diag(s) @ V.T, F, atol=1e-14)
        assert np.linalg.det(U) == pytest.approx(1.0)


@pytest.mark.parametrize("s", CASES.values(), ids=CASES.keys())
def test_projection_is_the_nearest_volume_preserving_triple(s: list[float]) -> None:
    p = np.empty(3)
    volume_projection(np.array(s), p)
    assert p.prod() == pytest.approx(1.0, abs=1e-12)
    best = min(
        minimize(
            lambda a: ((np.array(s) - np.array([*np.exp(a), np.exp(-a.sum())])) ** 2).sum(),
            start,
            method="Nelder-Mead",
            options={"xatol": 1e-10, "fatol": 1e-14, "maxiter": 4000},
        ).fun
        for start in ([0.0, 0.0], [1.0, 0.0], np.log(p[:2]))
    )
    assert ((np.array(s) - p) ** 2).sum() == pytest.approx(best, abs=1e-9)


@pytest.mark.parametrize("s", CASES.values(), ids=CASES.keys())
def test_derivatives_against_finite_differences(s: list[float]) -> None:
    _, first, second, _, _ = energy_and_slopes(s)
    h = 1e-6
    for i in range(3):
        up, down = list(s), list(s)
        up[i] += h
        down[i] -= h
        slope = (energy_and_slopes(up)[0] - energy_and_slopes(down)[0]) / (2 * h)
        assert first[i] == pytest.approx(slope, rel=1e-6, abs=1e-8)
        bend = (energy_and_slopes(up)[1] - energy_and_slopes(down)[1]) / (2 * h)
        np.testing.assert_allclose(second[i], bend, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("s", [CASES["distinct"], CASES["flat"], CASES["inverted"], CASES["beyond the fold"]])
def test_twist_and_flip_are_the_divided_differences(s: list[float]) -> None:
    _, first, _, twist, flip = energy_and_slopes(s)
    for k in range(3):
        i, j = k, (k + 1) % 3
        assert twist[k] == pytest.approx((first[i] + first[j]) / (s[i] + s[j]), rel=1e-9)
        assert flip[k] == pytest.approx((first[i] - first[j]) / (s[i] - s[j]), rel=1e-7)


def test_flip_at_repeated_stretches_is_the_limit() -> None:
    exact = energy_and_slopes([1.2, 1.2, 0.9])[4][0]
    close = energy_and_slopes([1.2 + 1e-5, 1.2 - 1e-5, 0.9])
    assert exact == pytest.approx((close[1][0] - close[1][1]) / 2e-5, rel=1e-6)
