import numpy as np
import pytest
import torch
from devices import ON_DEVICES

from rafl.fem.tensors.svd import signed_svd


def check(F: torch.Tensor, tolerance: float) -> None:
    """Check that U and V are rotations, s descends and only its last is negative, and the product is F."""
    U, s, V = signed_svd(F)
    identity = torch.eye(3, dtype=F.dtype, device=F.device).expand_as(F)
    for rotation in (U, V):
        assert float((rotation @ rotation.mT - identity).abs().max()) < 1e-14
        assert torch.allclose(torch.linalg.det(rotation), F.new_ones(()))
    assert float((U @ torch.diag_embed(s) @ V.mT - F).abs().max()) < tolerance
    assert bool((s[..., 0] >= s[..., 1]).all())
    assert bool((s[..., 1] >= s[..., 2].abs() - tolerance).all())
    assert bool(((s[..., 2] < 0) == (torch.linalg.det(F) < 0)).logical_or(s[..., 2].abs() < tolerance).all())


@ON_DEVICES
@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.3, 2.0])
def test_of_many_matrices_at_once(scale: float, device: str, random: np.random.Generator) -> None:
    """From exact rest, with repeated stretches, to inversion, turned at will."""
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    F = (np.eye(3) + scale * random.normal(size=(40, 5, 3, 3))) @ (turn * np.sign(np.linalg.det(turn)))
    check(torch.tensor(F, device=device), 1e-14 * (1 + scale))


@ON_DEVICES
def test_of_degenerate_matrices(device: str) -> None:
    """Repeated, negative and zero stretches; the ill-conditioned do not spoil the others."""
    one_row = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.6423473344796382, 0.5]])
    tiny = np.array([[0.0, 9.8e-160, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    flat = np.diag([1.0, 0.0, 0.0])
    swapped = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    F = np.stack([np.eye(3), -np.eye(3), np.diag([1.0, 2.0, 2.0]), flat, np.ones((3, 3)), one_row, tiny, swapped])
    check(torch.tensor(F, device=device), 1e-14)
