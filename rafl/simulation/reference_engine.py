"""Reference engine in plain torch tensors, on any device; `rafl.simulation.compiled_engine` is tested against it.

It is not optimised. Its matrices are dense, so it suits specimens of a few thousand unknowns.
"""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.laws import LAWS
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import QuadratureRule
from rafl.solvers.linear import Factors

Array = NDArray[Any]

STRETCH_PAIRS = ((0, 1), (1, 2), (2, 0))  # order of the pair stiffnesses of `rafl.fem.laws`
STRAIN_COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))  # order of symmetric tensors


def signed_svd(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """F = U diag(s) V^T with rotations U, V (..., 3, 3); s (..., 3) descends, and its last has the sign of det F."""
    U, s, Vh = torch.linalg.svd(F)
    flip_u, flip_v = torch.linalg.det(U).sign(), torch.linalg.det(Vh).sign()
    U = torch.cat([U[..., :2], U[..., 2:] * flip_u[..., None, None]], dim=-1)
    V = torch.cat([Vh.mT[..., :2], Vh.mT[..., 2:] * flip_v[..., None, None]], dim=-1)
    return U, torch.cat([s[..., :2], s[..., 2:] * (flip_u * flip_v)[..., None]], dim=-1), V


class ReferenceEngine:
    """Energy, gradient, tangent and linear solves of one mesh with one elastic law.

    The arguments are those of `rafl.simulation.compiled_engine.CompiledEngine`, and a torch device.
    """

    factorisation_cost = 5.0  # Newton steps with a reused factor

    def __init__(
        self, mesh: HexMesh, law: str, integration: str, fixed: NDArray[np.int64], device: str = "cpu"
    ) -> None:
        self.mesh = mesh
        self.fixed = fixed
        self.law = law
        self.device = torch.device(device)
        self.quadrature = QuadratureRule.from_scheme(mesh, integration)
        points = self.quadrature.points
        self._gradient, self._volume = self._tensor(points.gradient), self._tensor(points.volume)
        self._shares = self._tensor(self.quadrature.point_shares)
        self._hexes = torch.from_numpy(mesh.hexes).to(self.device)
        free = np.setdiff1d(np.arange(len(mesh.vertices)), fixed)
        self.free_index = (3 * free[:, None] + np.arange(3)).ravel()
        unknowns = 3 * mesh.hexes[:, :, None] + np.arange(3)
        self._unknowns = torch.from_numpy(unknowns.reshape(-1, 24)).to(self.device)

    def _tensor(self, array: Array) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float64).to(self.device)

    def evaluate(
        self, q: Array, state: ConstitutiveState, *, tangent: bool, project: bool = False
    ) -> tuple[Array, Array, Tensor]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if `tangent`, tangents [N/m] (B, 3 N, 3 N).

        The tangents are exact, or positive semi-definite if `project`.
        """
        moduli = self._tensor(state.moduli)
        at_cells = self._tensor(q)[:, self._hexes]  # (B, E, 8, 3)
        F = torch.einsum("beni,epnj->bepij", at_cells, self._gradient)
        U, s, V = signed_svd(F)
        mu, lam = (moduli[:, k, None, None] * self._shares[:, k] for k in (0, 1))  # (B, 1, P)
        energy, first, second, flip = LAWS[self.law].reference_derivatives(
            s, mu.expand(s.shape[:-1]), lam.expand(s.shape[:-1])
        )
        P = U @ torch.diag_embed(first) @ V.mT
        H = self._tangent(U, s, V, first, second, flip, project) if tangent else None
        if state.damped:
            damping = self._damping(q, F, moduli, state, tangent, project)
            energy, P = energy + damping[0], P + damping[1]
            H = None if H is None else H + damping[2]
        force = torch.einsum("ep,bepij,epnj->beni", self._volume, P, self._gradient)
        gradient = torch.zeros(q.shape, dtype=torch.float64, device=self.device)
        gradient.index_add_(1, self._hexes.reshape(-1), force.reshape(len(q), -1, 3))
        total = torch.einsum("ep,bep->b", self._volume, energy)
        return total.cpu().numpy(), gradient.cpu().numpy(), self._assembled(H, len(q))

    def _tangent(
        self, U: Tensor, s: Tensor, V: Tensor, first: Tensor, second: Tensor, flip: Tensor, project: bool
    ) -> Tensor:
        """dP / dF (B, E, P, 3, 3, 3, 3), computed in the frame of the singular vectors."""
        if project:
            values, vectors = torch.linalg.eigh(second)
            second = vectors @ torch.diag_embed(values.clamp_min(0.0)) @ vectors.mT
        local = s.new_zeros(*s.shape[:-1], 3, 3, 3, 3)
        for i in range(3):
            for j in range(3):
                local[..., i, i, j, j] = second[..., i, j]
        for k, (i, j) in enumerate(STRETCH_PAIRS):
            total = s[..., i] + s[..., j]
            total = torch.where(total.abs() > 1e-8, total, torch.copysign(torch.full_like(total, 1e-8), total))
            twist, pair_flip = (first[..., i] + first[..., j]) / total, flip[..., k]
            if project:
                twist, pair_flip = twist.clamp_min(0.0), pair_flip.clamp_min(0.0)
            local[..., i, j, i, j] = local[..., j, i, j, i] = 0.5 * (pair_flip + twist)
            local[..., i, j, j, i] = local[..., j, i, i, j] = 0.5 * (pair_flip - twist)
        return torch.einsum("...ia,...jb,...abcd,...kc,...ld->...ijkl", U, V, local, U, V)

    def _damping(
        self, q: Array, F: Tensor, moduli: Tensor, state: ConstitutiveState, tangent: bool, project: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Energy, stress P and tangent dP / dF of Kelvin-Voigt viscosity and of stiffness damping."""
        weighted = moduli[:, [2, 3, 4], None, None] * self._shares[:, [0, 0, 1]].T[:, None]
        eta, mu, lam = (x[..., None, None] for x in weighted.unbind(1))
        identity = torch.eye(3, dtype=torch.float64, device=self.device)
        assert state.velocity_offset is not None
        assert state.strain_offset is not None
        velocity = state.velocity_factor * self._tensor(q) - self._tensor(state.velocity_offset)
        L = torch.einsum("beni,epnj->bepij", velocity[:, self._hexes], self._gradient)
        D, trace = 0.5 * (L + L.mT), L.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        strain_offset = F.new_zeros(F.shape)
        components = self._tensor(state.strain_offset)
        for k, (i, j) in enumerate(STRAIN_COMPONENTS):
            strain_offset[..., i, j] = strain_offset[..., j, i] = components[..., k]
        strain_rate = state.strain_factor * 0.5 * (F.mT @ F - identity) - strain_offset
        S = 2.0 * eta * strain_rate
        P = F @ S + 2.0 * mu * D + lam * trace * identity
        viscous = eta / state.strain_factor * strain_rate**2 + mu / state.velocity_factor * D**2
        energy = viscous.sum((-2, -1)) + (0.5 * lam / state.velocity_factor * trace**2)[..., 0, 0]
        if not tangent:
            return energy, P, F.new_zeros(0)
        viscous_modulus = (eta * state.strain_factor)[..., None, None]
        H = viscous_modulus * (
            torch.einsum("...im,...kj->...ijkm", F, F) + torch.einsum("...in,...kn,jm->...ijkm", F, F, identity)
        )
        if not project:
            H = H + torch.einsum("ik,...jm->...ijkm", identity, S)
        mu, lam = mu[..., None, None] * state.velocity_factor, lam[..., None, None] * state.velocity_factor
        H = H + mu * (torch.einsum("ik,jm->ijkm", identity, identity) + torch.einsum("im,jk->ijkm", identity, identity))
        return energy, P, H + lam * torch.einsum("ij,km->ijkm", identity, identity)

    def _assembled(self, H: Tensor | None, batch: int) -> Tensor:
        """Global tangents (B, 3 N, 3 N) [N/m] of dP / dF; (0, 3 N, 3 N) without it."""
        size = 3 * len(self.mesh.vertices)
        if H is None:
            return torch.zeros(0, size, size, dtype=torch.float64, device=self.device)
        cells = torch.einsum("ep,epnj,bepijkl,epml->benimk", self._volume, self._gradient, H, self._gradient)
        tangents = torch.zeros(batch, size * size, dtype=torch.float64, device=self.device)
        indices = self._unknowns[:, :, None] * size + self._unknowns[:, None, :]
        tangents.index_add_(1, indices.reshape(-1), cells.reshape(batch, -1))
        return tangents.reshape(batch, size, size)

    def multiply(self, tangents: Tensor, x: Array) -> Array:
        """Tangent times x, both (B, N, 3), on all nodes, including the fixed ones."""
        product: Array = (tangents @ self._tensor(x).reshape(len(x), -1, 1)).reshape(x.shape).cpu().numpy()
        return product

    def reactions(self, tangents: Tensor, x: Array) -> Array:
        """Tangent times x (B, N, 3) on the fixed nodes, (B, F, 3)."""
        return self.multiply(tangents, x)[:, self.fixed]

    def thread_limit(self, batch: int) -> AbstractContextManager[None]:
        """Context without effect: torch keeps its number of threads."""
        return nullcontext()

    def _reduced(self, tangents: Tensor, diagonal: Array) -> Tensor:
        """Tangents plus a diagonal (B, n) on the unknowns, (B, n, n)."""
        free = torch.from_numpy(self.free_index).to(self.device)
        return tangents[:, free][:, :, free] + torch.diag_embed(self._tensor(diagonal))

    def allocate(self, batch: int) -> Factors:
        """Storage for the factors of a batch."""
        n = len(self.free_index)
        storage = torch.zeros(batch, n, n, dtype=torch.float64, device=self.device)
        return Factors(storage, np.zeros(batch, dtype=bool))

    def factor(self, factors: Factors, rows: Array, tangents: Tensor, diagonal: Array) -> NDArray[np.bool_]:
        """Factor tangents plus a diagonal (R, n) into `rows` of the storage; True where positive definite."""
        lower, info = torch.linalg.cholesky_ex(self._reduced(tangents, diagonal))
        factors.storage[torch.from_numpy(rows)] = lower
        factors.ready[rows] = (info == 0).cpu().numpy()
        return factors.ready[rows]

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right-hand sides (R, C, n) with the factors in `rows`."""
        lower = factors.storage[torch.from_numpy(rows)]
        solution: Array = torch.cholesky_solve(self._tensor(right).mT, lower).mT.cpu().numpy()
        return solution

    def solve_once(self, tangents: Tensor, diagonal: Array, right: Array) -> Array:
        """Solutions (B, C, n) with tangents, possibly indefinite, plus a diagonal (B, n)."""
        reduced = self._reduced(tangents, diagonal)
        solution: Array = torch.linalg.solve(reduced, self._tensor(right).mT).mT.cpu().numpy()
        return solution
