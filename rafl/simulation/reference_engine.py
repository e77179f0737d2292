"""Reference engine in plain torch tensors, on any device; `rafl.simulation.compiled_engine` is tested against it.

It is not optimised. Its matrices are dense, so it suits specimens of a few thousand unknowns.
"""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.constitutive_state import DAMPING, ConstitutiveState
from rafl.fem.enhanced.hourglass import MODES, HourglassModes
from rafl.fem.laws import LAWS
from rafl.fem.learned_energy import reference_learned_energy
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import QuadratureRule
from rafl.fem.strain import green_strain, green_strain_adjoint, scatter
from rafl.simulation import reference_hourglass
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
        self.integration = integration
        self.law = law
        self.device = torch.device(device)
        self.quadrature = QuadratureRule.from_scheme(mesh, integration)
        points = self.quadrature.points
        self._gradient, self._volume = self._tensor(points.gradient), self._tensor(points.volume)
        self._shares = self._tensor(self.quadrature.point_shares)
        self.hourglass_modes = HourglassModes(mesh)
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
        if state.energy_weights is not None:
            learned = reference_learned_energy(s, self._tensor(state.energy_weights), self._shares[:, 0])
            energy, first, second, flip = (a + b for a, b in zip((energy, first, second, flip), learned, strict=True))
        P = U @ torch.diag_embed(first) @ V.mT
        H = self._tangent(U, s, V, first, second, flip, project) if tangent else None
        for term in (self._viscous_stress(F, state, tangent, project), self._damping_stress(q, moduli, state)):
            if term is not None:
                energy, P = energy + term[0], P + term[1]
                H = None if H is None else H + term[2]
        force = torch.einsum("ep,bepij,epnj->beni", self._volume, P, self._gradient)
        gradient = torch.zeros(q.shape, dtype=torch.float64, device=self.device)
        gradient.index_add_(1, self._hexes.reshape(-1), force.reshape(len(q), -1, 3))
        total = torch.einsum("ep,bep->b", self._volume, energy)
        cells = None
        if H is not None:
            cells = torch.einsum("ep,epnj,bepijkl,epml->benimk", self._volume, self._gradient, H, self._gradient)
        if state.hourglass is not None:
            hourglass = self._hourglass_terms(q, U @ V.mT, state, tangent, project)
            total = total + hourglass[0]
            gradient.index_add_(1, self._hexes.reshape(-1), hourglass[1].reshape(len(q), -1, 3))
            cells = None if cells is None else cells + hourglass[2]
        return total.cpu().numpy(), gradient.cpu().numpy(), self._assembled(cells, len(q))

    def _cell_arguments(self, q: Array, rotation: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """First arguments of `rafl.simulation.reference_hourglass`: positions, gradients, gamma and rotation."""
        batch = len(q)
        constant = (self._gradient[:, 0], self._tensor(self.hourglass_modes.gamma))
        gradient, gamma = (x.expand(batch, *x.shape) for x in constant)
        return self._tensor(q)[:, self._hexes], gradient, gamma, rotation[:, :, 0]

    def _hourglass_terms(
        self, q: Array, rotation: Tensor, state: ConstitutiveState, tangent: bool, project: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Energy (B), nodal forces (B, E, 8, 3) and tangents (B, E, 8, 3, 8, 3) of the hourglass modes."""
        assert state.hourglass is not None
        index, shape = self.hourglass_modes.shape_index, (len(q), len(self._hexes))
        elastic, viscous, damping = (
            self._tensor(matrix)[:, index]
            for matrix in (state.hourglass.elastic, state.hourglass.viscous, state.hourglass.damping)
        )
        modulus, memory = elastic.new_zeros(shape), elastic.new_zeros(*shape, MODES)
        if state.hourglass_memory is not None:
            assert state.viscous_modulus is not None
            modulus = self._tensor(state.viscous_modulus[..., 0])
            memory = self._tensor(state.hourglass_memory)
        cells = self._cell_arguments(q, rotation)
        arguments = (*cells, elastic, viscous, modulus, memory)
        energy = reference_hourglass.energies(*arguments).sum(1)
        force = reference_hourglass.forces(*arguments)
        H = force.new_zeros(0)
        if tangent and project:
            jacobian = reference_hourglass.vector_jacobian(*cells)
            total = elastic + modulus[..., None, None] * viscous
            H = torch.einsum("zeani,zeab,zebmk->zenimk", jacobian, total, jacobian)
        elif tangent:
            H = reference_hourglass.tangents(*arguments)
        if state.velocity_offset is not None:
            velocity = state.velocity_factor * self._tensor(q) - self._tensor(state.velocity_offset)
            gamma = self._tensor(self.hourglass_modes.gamma)
            rate = torch.einsum("ekn,beni->beki", gamma, velocity[:, self._hexes]).reshape(*shape, MODES)
            along = torch.einsum("becd,bed->bec", damping, rate)
            energy = energy + 0.5 / state.velocity_factor * (rate * along).sum((1, 2))
            force = force + torch.einsum("ekn,beki->beni", gamma, along.reshape(*shape, 4, 3))
            if tangent:
                blocks = damping.reshape(*shape, 4, 3, 4, 3)
                H = H + state.velocity_factor * torch.einsum("ekn,zekilj,elm->zenimj", gamma, blocks, gamma)
        return energy, force, H

    def strains(self, q: Array, direction: Array) -> tuple[Array, Array]:
        """As of `rafl.simulation.compiled_engine.CompiledEngine.strains`."""
        found = green_strain(self.mesh, self.quadrature.points, q, direction)
        parts = [x.reshape(*x.shape[:2], -1) for x in found]
        if self.integration == "enhanced":
            cells = self._cell_arguments(q, self._rotation(q))
            along = torch.einsum(
                "beani,beni->bea", reference_hourglass.vector_jacobian(*cells), self._tensor(direction)[:, self._hexes]
            )
            local = (reference_hourglass.vectors(*cells), along)
            parts = [np.concatenate([x, y.cpu().numpy()], axis=-1) for x, y in zip(parts, local, strict=True)]
        return parts[0], parts[1]

    def strains_adjoint(self, q: Array, by_strain: Array) -> Array:
        """As of `rafl.simulation.compiled_engine.CompiledEngine.strains_adjoint`."""
        points = len(self.quadrature.points.shape)
        shape = (*by_strain.shape[:2], points, 6)
        out = green_strain_adjoint(self.mesh, self.quadrature.points, q, by_strain[..., : 6 * points].reshape(shape))
        if self.integration == "enhanced":
            jacobian = reference_hourglass.vector_jacobian(*self._cell_arguments(q, self._rotation(q)))
            force = torch.einsum("beani,bea->beni", jacobian, self._tensor(by_strain[..., 6 * points :]))
            out = out + scatter(force.cpu().numpy(), self.mesh.hexes, q.shape[1])
        return out

    def _rotation(self, q: Array) -> Tensor:
        """Polar rotation of the deformation gradient at every point, (B, E, P, 3, 3)."""
        U, _, V = signed_svd(torch.einsum("beni,epnj->bepij", self._tensor(q)[:, self._hexes], self._gradient))
        return U @ V.mT

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

    def _viscous_stress(
        self, F: Tensor, state: ConstitutiveState, tangent: bool, project: bool
    ) -> tuple[Tensor, Tensor, Tensor] | None:
        """Energy, stress P = F 2 (g E - memory) and tangent dP / dF, or None without viscosity."""
        if state.memory is None:
            return None
        assert state.viscous_modulus is not None
        shares = self._shares[:, 0, None, None]
        g = self._tensor(state.viscous_modulus)[..., None, None]
        identity = torch.eye(3, dtype=torch.float64, device=self.device)
        memory = F.new_zeros(F.shape)
        components = self._tensor(state.memory)
        for k, (i, j) in enumerate(STRAIN_COMPONENTS):
            memory[..., i, j] = memory[..., j, i] = components[..., k]
        half = shares * (g * 0.5 * (F.mT @ F - identity) - memory)
        S = 2.0 * half
        energy = (half**2 / g.clamp_min(1e-300)).sum((-2, -1))
        if not tangent:
            return energy, F @ S, F.new_zeros(0)
        modulus = (shares * g)[..., None, None]
        H = modulus * (
            torch.einsum("...im,...kj->...ijkm", F, F) + torch.einsum("...in,...kn,jm->...ijkm", F, F, identity)
        )
        if not project:
            H = H + torch.einsum("ik,...jm->...ijkm", identity, S)
        return energy, F @ S, H

    def _damping_stress(
        self, q: Array, moduli: Tensor, state: ConstitutiveState
    ) -> tuple[Tensor, Tensor, Tensor] | None:
        """Energy, stress P and tangent dP / dF of stiffness damping, or None without it."""
        if state.velocity_offset is None:
            return None
        weighted = moduli[:, list(DAMPING), None, None] * self._shares.T[:, None]
        mu, lam = (x[..., None, None] for x in weighted.unbind(1))
        identity = torch.eye(3, dtype=torch.float64, device=self.device)
        velocity = state.velocity_factor * self._tensor(q) - self._tensor(state.velocity_offset)
        L = torch.einsum("beni,epnj->bepij", velocity[:, self._hexes], self._gradient)
        D, trace = 0.5 * (L + L.mT), L.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        P = 2.0 * mu * D + lam * trace * identity
        energy = (mu / state.velocity_factor * D**2).sum((-2, -1))
        energy = energy + (0.5 * lam / state.velocity_factor * trace**2)[..., 0, 0]
        mu, lam = mu[..., None, None] * state.velocity_factor, lam[..., None, None] * state.velocity_factor
        H = mu * (torch.einsum("ik,jm->ijkm", identity, identity) + torch.einsum("im,jk->ijkm", identity, identity))
        return energy, P, H + lam * torch.einsum("ij,km->ijkm", identity, identity)

    def _assembled(self, cells: Tensor | None, batch: int) -> Tensor:
        """Global tangents (B, 3 N, 3 N) [N/m] of those of the cells (B, E, 8, 3, 8, 3); (0, 3 N, 3 N) without them."""
        size = 3 * len(self.mesh.vertices)
        if cells is None:
            return torch.zeros(0, size, size, dtype=torch.float64, device=self.device)
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
