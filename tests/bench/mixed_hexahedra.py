"""Quadratic hexahedra with discontinuous linear pressure (Q2/P1) for neo-Hookean rubber, on scikit-fem.

An element that shares no code with `rafl`, does not lock when nearly incompressible, and converges quadratically where
the solution is smooth; see Boffi, Brezzi and Fortin, Mixed Finite Element Methods and Applications (2013), section 8.6.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, kron
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, eigsh, splu

Array = NDArray[np.float64]

GAUSS_POINTS = 3  # along each axis; exact for the stiffness of a box at rest
CELLS_PER_CHUNK = 400  # whose 81 x 81 tangents are computed at once
MAX_ITERATIONS = 25  # of Newton's method at one load
FIRST_LOAD_STEPS, MAX_LOAD_STEPS = 4, 64
MAX_CG_ITERATIONS = 40  # about the time of new factors
STEP_TOLERANCE = 1e-4  # of a Newton step's residual
MAX_GROWTH = 1e6  # of the residual, beyond which Newton's method diverges
TOLERANCE = 1e-8  # of the residual, relative to the whole load

PERMUTATION = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    PERMUTATION[_i, _j, _k], PERMUTATION[_k, _j, _i] = 1.0, -1.0


class NotConvergedError(Exception):
    """Newton's method failed at one load."""


def factor(matrix: csc_array) -> SuperLU:
    """Factors of a symmetric matrix."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def solve(matrix: csc_array, right: Array, factors: SuperLU | None) -> tuple[SuperLU, Array]:
    """Solution of matrix x = right by conjugate gradients with the factors of a similar matrix, or by new factors.

    Returns:
        The factors to use next, and the solution.
    """
    if factors is not None:
        inverse = LinearOperator(matrix.shape, factors.solve, dtype=float)
        solution, failed = cg(matrix, right, rtol=STEP_TOLERANCE, maxiter=MAX_CG_ITERATIONS, M=inverse)
        if not failed:
            return factors, solution
    factors = factor(matrix)
    return factors, factors.solve(right)


@dataclass(frozen=True)
class Linearisation:
    """A body near one state.

    Attributes:
        gradient: derivative of the elastic energy with respect to the displacements [N], (n, 3).
        tangent: of the free unknowns [N/m], with the pressures eliminated.
        strain: moments of J - 1 with the pressure functions [m^3/2], (E, 4).
        moments: their derivative with respect to the displacements of the cell's nodes [m^1/2], (E, 4, 81).
    """

    gradient: Array
    tangent: csc_array
    strain: Array
    moments: Array


@dataclass(frozen=True)
class MixedHexahedra:
    """A body of psi = mu/2 (|F|^2 - 3) - mu (J - 1) + (mu + lambda)/2 (J - 1)^2, fixed at its face of smallest x.

    The lambda term sees the projection of J - 1 onto the linear functions of each cell: the pressure of the mixed
    form, eliminated cell by cell. The mu terms stay at the points; projecting a part of them would make cells unstable.

    Attributes:
        vertices: rest positions [m], (N, 3).
        hexes: corners of each cell in scikit-fem's order, (E, 8).
        mirrored: whether the face of smallest y is a plane of symmetry.
        mu, lam: Lame parameters [Pa].
        density: [kg/m^3].
    """

    vertices: Array
    hexes: NDArray[np.int64]
    mirrored: bool
    mu: float
    lam: float
    density: float

    @cached_property
    def basis(self) -> skfem.Basis:
        """Scalar triquadratic functions and Gauss points."""
        mesh = skfem.MeshHex(np.ascontiguousarray(self.vertices.T), np.ascontiguousarray(self.hexes.T))
        return skfem.Basis(mesh, skfem.ElementHex2(), intorder=2 * GAUSS_POINTS - 1)

    @property
    def nodes(self) -> Array:
        """Positions of the nodes at rest [m], (n, 3)."""
        return np.asarray(self.basis.doflocs.T)

    @cached_property
    def free(self) -> NDArray[np.int64]:
        """Unknowns (3 * node + component) that are neither clamped nor held by symmetry."""
        x, y, _ = self.nodes.T
        held = np.zeros((len(x), 3), dtype=bool)
        held[x < x.min() + 1e-9] = True
        if self.mirrored:
            held[y < y.min() + 1e-9, 1] = True
        return np.flatnonzero(~held.ravel())

    @cached_property
    def _gradients(self) -> Array:
        """Rest-frame gradients of the shape functions [1/m], (E, G points, 27, 3)."""
        return np.stack([field[0].grad for field in self.basis.basis]).transpose(2, 3, 0, 1)

    @cached_property
    def _cell_dofs(self) -> NDArray[np.int64]:
        return np.asarray(self.basis.element_dofs.T)

    @cached_property
    def _pressure_functions(self) -> Array:
        """Linear functions of each cell, orthonormal in its volume [m^-3/2], (E, G, 4)."""
        points = np.asarray(self.basis.global_coordinates()).transpose(1, 2, 0)
        size = np.ptp(self.vertices[self.hexes], axis=1)[:, None]
        centred = (points - points.mean(axis=1, keepdims=True)) / size
        linear = np.concatenate([np.ones_like(centred[..., :1]), centred], axis=-1)
        gram = np.einsum("eg,ega,egb->eab", self.basis.dx, linear, linear)
        return np.einsum("ega,eba->egb", linear, np.linalg.inv(np.linalg.cholesky(gram)))

    @cached_property
    def mass(self) -> csc_array:
        """Consistent mass matrix [kg] of all unknowns."""

        @skfem.BilinearForm
        def form(u: Array, v: Array, _w: object) -> Array:
            return self.density * u * v

        return csc_array(kron(form.assemble(self.basis), np.eye(3), format="csc"))

    def weight(self, gravity: float) -> Array:
        """Nodal forces of the weight along -z [N], (n, 3)."""
        force = np.zeros((len(self.nodes), 3))
        force[:, 2] = -gravity * (self.mass[2::3, 2::3] @ np.ones(len(self.nodes)))
        return force

    def evaluate(self, u: Array, pressure: Array) -> "Linearisation":
        """Forces and tangent at displacements u [m], (n, 3), and pressures of the cells [Pa m^3/2], (E, 4)."""
        chunks = [
            self._cell_terms(u, pressure, slice(first, first + CELLS_PER_CHUNK))
            for first in range(0, len(self.hexes), CELLS_PER_CHUNK)
        ]
        force, stiffness, strain, moments = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
        gradient = np.zeros(u.shape)
        np.add.at(gradient, self._cell_dofs, force)
        unknowns = (3 * self._cell_dofs[:, :, None] + np.arange(3)).reshape(len(self.hexes), 81).astype(np.int32)
        rows, columns = np.repeat(unknowns, 81, axis=1).ravel(), np.tile(unknowns, (1, 81)).ravel()
        tangent = coo_array((stiffness.ravel(), (rows, columns)), shape=(u.size,) * 2).tocsc()
        return Linearisation(gradient, tangent[self.free][:, self.free], strain, moments)

    def _cell_terms(self, u: Array, pressure: Array, cells: slice) -> tuple[Array, Array, Array, Array]:
        """Force (C, 27, 3), tangent (C, 81, 81), volume change (C, 4) and its derivative (C, 4, 81) of some cells."""
        N, weight, basis = self._gradients[cells], self.basis.dx[cells], self._pressure_functions[cells]
        F = np.eye(3) + np.einsum("eni,egnj->egij", u[self._cell_dofs[cells]], N, optimize=True)
        minors = np.einsum("ijk,abc,egjb->egiakc", PERMUTATION, PERMUTATION, F, optimize=True)  # d^2 J / dF dF
        cofactor = 0.5 * np.einsum("egiakc,egkc->egia", minors, F)
        strain = np.einsum("egia,egia->eg", cofactor, F) / 3.0 - 1.0
        projected = np.einsum("eg,ega,eg->ea", weight, basis, strain)
        in_balance, assumed = (
            self.mu * (strain - 1.0) + np.einsum("ega,ea->eg", basis, values)
            for values in (self.lam * projected, pressure[cells])
        )
        stress = weight[..., None, None] * (self.mu * F + in_balance[..., None, None] * cofactor)
        force = np.einsum("egij,egnj->eni", stress, N, optimize=True)
        count, points = weight.shape
        volume_change = np.einsum("egia,egna->egni", cofactor, N, optimize=True).reshape(count, points, 81)
        moments = np.einsum("eg,ega,egm->eam", weight, basis, volume_change, optimize=True)
        stiffness = self.lam * moments.transpose(0, 2, 1) @ moments
        stiffness += (self.mu * weight[..., None] * volume_change).transpose(0, 2, 1) @ volume_change
        C = (weight * assumed)[..., None, None, None, None] * minors  # d P_ia / d F_kc, but for the terms above
        C += self.mu * np.einsum("eg,ik,ac->egiakc", weight, np.eye(3), np.eye(3))
        product = np.einsum("egiakc,egnc->egiank", C, N, optimize=True)
        left = N.transpose(0, 2, 1, 3).reshape(count, 27, -1)  # (C, 27, G 3)
        right = product.transpose(0, 1, 3, 2, 4, 5).reshape(count, points * 3, -1)  # (C, G 3, 3 27 3)
        return force, stiffness + (left @ right).reshape(count, 81, 81), projected, moments

    def interpolate(self, u: Array, nodes: Array) -> Array:
        """Displacements u (n, 3) [m] of this body at other material points (P, 3) [m]."""
        return np.asarray(self.basis.probes(np.ascontiguousarray(nodes.T)) @ u)

    def equilibrium(self, force: Array, start: Array | None = None) -> Array:
        """Displacements [m] under nodal forces [N], both (n, 3): from `start`, or in load steps from rest.

        Raises:
            NotConvergedError: with 64 load steps.
        """
        limit = TOLERANCE * np.abs(force).sum()
        no_pressure = np.zeros((len(self.hexes), 4))
        if start is not None:
            with suppress(NotConvergedError):
                return self._newton(start, no_pressure, force, limit)[0]
        steps = FIRST_LOAD_STEPS
        while True:
            try:
                u, pressure = np.zeros_like(force), no_pressure
                for share in np.linspace(1.0 / steps, 1.0, steps):
                    u, pressure = self._newton(u, pressure, share * force, limit)
                return u
            except NotConvergedError:
                if steps >= MAX_LOAD_STEPS:
                    raise
                steps *= 2

    def _newton(self, u: Array, pressure: Array, force: Array, limit: float) -> tuple[Array, Array]:
        """Newton's method for displacements and pressures: linear in both, so large rotations need few steps."""
        smallest, factors = np.inf, None
        for _ in range(MAX_ITERATIONS):
            terms = self.evaluate(u, pressure)
            residual = (force - terms.gradient).ravel()[self.free]
            size = np.abs(residual).sum()
            if size < limit:
                return u, pressure
            smallest = min(smallest, size)
            if not size < MAX_GROWTH * smallest:
                break
            factors, solution = solve(terms.tangent, residual, factors)
            step = np.zeros(u.size)
            step[self.free] = solution
            step = step.reshape(u.shape)
            change = np.einsum("eam,em->ea", terms.moments, step[self._cell_dofs].reshape(len(pressure), 81))
            u, pressure = u + step, self.lam * (terms.strain + change)
        raise NotConvergedError(f"residual {size:.3g} N, limit {limit:.3g} N")

    def first_frequency(self) -> float:
        """First natural frequency about the straight unloaded state [Hz]."""
        stiffness = self.evaluate(np.zeros_like(self.nodes), np.zeros((len(self.hexes), 4))).tangent
        mass = self.mass[self.free][:, self.free]
        inverse = LinearOperator(mass.shape, factor(stiffness).solve, dtype=float)
        start = np.ones(len(self.free))
        value = eigsh(stiffness, 1, mass, sigma=0.0, OPinv=inverse, v0=start, return_eigenvectors=False)
        return float(np.sqrt(value[0])) / (2.0 * np.pi)
