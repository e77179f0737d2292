import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rafl.fem.kernel_layout import DEFORMATION, ROWS, STRETCH, U, V
from rafl.fem.svd import signed_svd, signed_svd_simd


def svd(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    left, s, right = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    signed_svd(F, left, s, right)
    return left, s, right


def simd_svd(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """SVD of F (8, 3, 3) by the SIMD kernel, which takes all eight at once."""
    w = np.zeros((ROWS, 8))
    w[DEFORMATION : DEFORMATION + 9] = F.reshape(8, 9).T
    signed_svd_simd(w.reshape(-1))
    left, right = (w[offset : offset + 9].T.reshape(8, 3, 3) for offset in (U, V))
    return left, w[STRETCH : STRETCH + 3].T, right


@settings(deadline=None, max_examples=200)
@given(st.lists(st.floats(-2, 2), min_size=9, max_size=9))
def test_signed_svd_factors_random_matrices(entries: list[float]) -> None:
    F = np.array(entries).reshape(3, 3)
    if np.linalg.norm(F) < 1e-3:
        return
    left, s, right = svd(F)
    np.testing.assert_allclose(left @ np.diag(s) @ right.T, F, atol=1e-13)
    for rotation in (left, right):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert s[0] >= s[1] >= abs(s[2]) - 1e-12
    np.testing.assert_allclose(np.abs(s), np.linalg.svd(F, compute_uv=False), atol=1e-12)


def test_signed_svd_of_degenerate_matrices() -> None:
    one_row = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.6423473344796382, 0.5]])
    tiny = np.array([[0.0, 9.8e-160, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    flat = np.diag([1.0, 0.0, 0.0])
    for F in (np.eye(3), -np.eye(3), np.diag([2.0, 2.0, 1.0]), flat, np.ones((3, 3)), one_row, tiny):
        left, s, right = svd(F)
        np.testing.assert_allclose(left @ np.diag(s) @ right.T, F, atol=1e-14)
        np.testing.assert_allclose(left @ left.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(left) == pytest.approx(1.0)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.3, 2.0])
def test_signed_svd_simd(scale: float, random: np.random.Generator) -> None:
    """From exact rest, with repeated stretches, to inversion: every SIMD lane is accurate to rounding."""
    for _ in range(200):
        F = np.eye(3) + scale * random.normal(size=(8, 3, 3))
        left, s, right = simd_svd(F)
        np.testing.assert_allclose(left * s[:, None] @ right.swapaxes(1, 2), F, atol=1e-14 * (1 + scale))
        for rotation in (left, right):
            product = rotation @ rotation.swapaxes(1, 2)
            np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), F.shape), atol=4e-15)
            np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
        np.testing.assert_array_equal((s < 0).sum(axis=1), np.linalg.det(F) < 0)
