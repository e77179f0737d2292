"""Implicit Euler and static equilibrium by Newton's method, and the linear solves of their adjoint."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_banded
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from threadpoolctl import ThreadpoolController

from rafl.assembly import element_terms, multiply, scatter_band, scatter_gradient
from rafl.material import Material
from rafl.mesh import HexMesh

Array = NDArray[Any]

GRAVITY = (0.0, 0.0, -9.80709)
TOLERANCE = 1e-9  # largest nodal residual accepted [N]
MAX_ITERATIONS = 200

# BLAS threads on matrices this narrow cost ten times what they save.
_BLAS = ThreadpoolController()


class SimulationError(Exception):
    """A step or an equilibrium that could not be solved: says which, how far it came, what to try."""


@dataclass(frozen=True)
class Simulator:
    """One specimen: a mesh of one material, held at some nodes, under gravity.

    Attributes:
        mesh: the rest shape.
        material: elasticity, density and how mass is lumped.
        fixed: indices of the held nodes, (F).
        time_step: dt [s].
        gravity: [m/s^2], (3).
    """

    mesh: HexMesh
    material: Material
    fixed: NDArray[np.int64]
    time_step: float = 0.01
    gravity: tuple[float, float, float] = GRAVITY

    @cached_property
    def node_mass(self) -> Array:
        """Nodal masses [kg], (N,)."""
        return self.material.node_mass(self.mesh)

    @cached_property
    def weight(self) -> Array:
        """Nodal gravity forces [N], (N, 3)."""
        return self.node_mass[:, None] * np.asarray(self.gravity)

    @cached_property
    def unknown(self) -> NDArray[np.int64]:
        """Position of each node's first unknown in the band ordering, -1 where held, (N,).

        Vertex order and reverse Cuthill-McKee are both tried; the narrower band wins.
        """
        nodes = len(self.mesh.vertices)
        free = np.ones(nodes, dtype=bool)
        free[self.fixed] = False
        natural = np.flatnonzero(free)
        rows = np.repeat(self.mesh.hexes, 8, axis=1).ravel()
        columns = np.tile(self.mesh.hexes, (1, 8)).ravel()
        graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(nodes, nodes)).tocsr()
        permuted = natural[reverse_cuthill_mckee(graph[natural][:, natural].tocsr(), symmetric_mode=True)]

        def numbered(order: NDArray[np.int64]) -> NDArray[np.int64]:
            unknown = np.full(nodes, -1, dtype=np.int64)
            unknown[order] = 3 * np.arange(len(order))
            return unknown

        return min((numbered(natural), numbered(permuted)), key=self._half_bandwidth)

    def _half_bandwidth(self, unknown: NDArray[np.int64]) -> int:
        of_cell = unknown[self.mesh.hexes]
        highest = of_cell.max(axis=1)
        lowest = np.where(of_cell < 0, np.iinfo(np.int64).max, of_cell).min(axis=1)
        held = highest < 0
        return int((highest - lowest)[~held].max()) + 2

    @cached_property
    def _band_shape(self) -> tuple[int, int]:
        return self._half_bandwidth(self.unknown) + 1, 3 * int((self.unknown >= 0).sum())

    @cached_property
    def free_index(self) -> NDArray[np.int64]:
        """Flat indices into (N * 3) of the unknowns, in band order."""
        order = np.argsort(self.unknown)[(self.unknown < 0).sum() :]
        return (3 * order[:, None] + np.arange(3)).ravel()

    def _terms(self, q: Array, mu: Array, lam: Array, *, project: bool, tangent: bool) -> tuple[Array, Array, Array]:
        """Energy (B), nodal gradient (B, N, 3) and cell stiffnesses (B, E, 24, 24) of positions q."""
        batch, cells = len(q), len(self.mesh.hexes)
        energy = np.empty((batch, cells))
        force = np.empty((batch, cells, 8, 3))
        stiffness = np.empty((batch, cells, 24, 24) if tangent else (batch, cells, 0, 0))
        rule = self.mesh.quadrature
        element_terms(
            q, self.mesh.hexes, rule.gradient, rule.volume, mu, lam, project, tangent,
            energy, force, stiffness,
        )  # fmt: skip
        gradient = np.zeros_like(q)
        for t in range(batch):
            scatter_gradient(force[t], self.mesh.hexes, gradient[t])
        return energy.sum(axis=1), gradient, stiffness

    def elastic_gradient(self, q: Array, mu: Array, lam: Array) -> Array:
        """Derivative of the elastic energy by q [N], (B, N, 3); minus the internal force."""
        return self._terms(q, mu, lam, project=False, tangent=False)[1]

    def _band(self, stiffness: Array, inertia: Array) -> Array:
        band = np.zeros(self._band_shape)
        scatter_band(stiffness, self.mesh.hexes, self.unknown, band)
        band[0] += np.repeat(inertia, 3)[self.free_index]
        return band

    def minimise(
        self,
        start: Array,
        inertia: Array,
        target: Array,
        force: Array,
        mu: Array,
        lam: Array,
        what: str = "step",
    ) -> Array:
        """Positions minimising sum inertia/2 |q - target|^2 - force . q + elastic energy.

        Newton's method with a backtracking line search, each trajectory of the batch on its own, to a
        residual of 1e-9 N. Where the tangent is indefinite it is projected to positive definite.

        Args:
            start: first guess, held nodes where they shall be [m], (B, N, 3).
            inertia: [kg/s^2], (B, N); zero for a static equilibrium.
            target: [m], (B, N, 3).
            force: nodal forces [N], (B, N, 3).
            mu, lam: Lame parameters of each trajectory [Pa], (B,).
            what: named in the error.

        Returns:
            Positions [m], (B, N, 3).

        Raises:
            SimulationError: no convergence; names trajectory, residual and what to try.
        """
        q = start.copy()
        active = np.arange(len(q))
        free = self.free_index

        def objective(rows: NDArray[np.int64], at: Array) -> tuple[Array, Array, Array]:
            energy, gradient, stiffness = self._terms(at, mu[rows], lam[rows], project=False, tangent=True)
            gap = at - target[rows]
            pull = inertia[rows][:, :, None] * gap
            energy = energy + 0.5 * (pull * gap).sum(axis=(1, 2)) - (force[rows] * at).sum(axis=(1, 2))
            return energy, (gradient + pull - force[rows]).reshape(len(rows), -1)[:, free], stiffness

        energy, residual, stiffness = objective(active, q)
        for _ in range(MAX_ITERATIONS):
            largest = np.abs(residual).max(axis=1)
            if not np.isfinite(largest).all():
                break
            running = largest > TOLERANCE
            if not running.any():
                return q
            active, energy = active[running], energy[running]
            residual, stiffness = residual[running], stiffness[running]
            step = np.empty_like(residual)
            with _BLAS.limit(limits=1, user_api="blas"):
                for row, t in enumerate(active):
                    factor, info = lapack.dpbtrf(self._band(stiffness[row], inertia[t]), lower=1)
                    if info != 0:
                        only = slice(t, t + 1)
                        _, _, definite = self._terms(q[only], mu[only], lam[only], project=True, tangent=True)
                        band = self._band(definite[0], inertia[t])
                        band[0] += 1e-9 * band[0].max()
                        factor, info = lapack.dpbtrf(band, lower=1)
                    if info != 0:
                        raise SimulationError(
                            f"{what}: trajectory {t}: the tangent cannot be factored (residual "
                            f"{largest.max():.3g} N); hold more nodes or check the material"
                        )
                    step[row] = -lapack.dpbtrs(factor, residual[row], lower=1)[0]
            length = np.ones(len(active))
            slope = (step * residual).sum(axis=1)
            done = np.zeros(len(active), dtype=bool)
            new_energy, new_residual, new_stiffness = energy.copy(), residual.copy(), stiffness.copy()
            for _ in range(40):
                rows = np.flatnonzero(~done)
                if not len(rows):
                    break
                trial = q[active[rows]].reshape(len(rows), -1)
                trial[:, free] += length[rows, None] * step[rows]
                trial = trial.reshape(len(rows), -1, 3)
                e, r, k = objective(active[rows], trial)
                # Close to the minimum energies differ by rounding only: the residual decides there.
                slack = 1e-13 * (np.abs(energy[rows]) + 1e-9)
                lower = e <= energy[rows] + 1e-4 * length[rows] * slope[rows]
                close = (e <= energy[rows] + slack) & (np.abs(r).max(axis=1) < np.abs(residual[rows]).max(axis=1))
                for i in np.flatnonzero(lower | close):
                    row = rows[i]
                    q[active[row]] = trial[i]
                    new_energy[row], new_residual[row], new_stiffness[row] = e[i], r[i], k[i]
                    done[row] = True
                length[~done] *= 0.5
            if not done.all():
                break
            energy, residual, stiffness = new_energy, new_residual, new_stiffness
        largest = np.abs(residual).max(axis=1)
        worst = int(np.argmax(np.where(np.isfinite(largest), largest, np.inf)))
        raise SimulationError(
            f"{what}: trajectory {active[worst]} did not converge (residual "
            f"{largest[worst]:.3g} N, wanted {TOLERANCE:.0e} N); "
            "try a smaller time step or load"
        )

    def step(self, q: Array, v: Array, force: Array, mu: Array, lam: Array, mass: Array, what: str = "step") -> Array:
        """One implicit Euler step (paper, eq. 1) of a batch; returns the new positions (B, N, 3).

        Args:
            q, v: positions [m] and velocities [m/s], (B, N, 3).
            force: external nodal forces, gravity included [N], (B, N, 3).
            mu, lam: [Pa], (B,).
            mass: nodal masses [kg], (B, N).
        """
        dt = self.time_step
        start = q + dt * v
        start[:, self.fixed] = q[:, self.fixed]
        inertia = mass / dt**2
        target = q + dt * v + dt**2 * force / mass[:, :, None]
        return self.minimise(start, inertia, target, np.zeros_like(q), mu, lam, what)

    def equilibrium(self, force: Array, start: Array | None = None, what: str = "equilibrium") -> Array:
        """Static equilibrium [m], (B, N, 3), under nodal forces (B, N, 3) [N], gravity included.

        Where Newton's method fails at once from `start` (B, N, 3), the load is put on in steps.
        """
        batch = len(force)
        mu, lam = (np.full(batch, value) for value in self.material.lame)
        none = np.zeros(force.shape[:2])
        q = np.broadcast_to(self.mesh.vertices, force.shape).copy() if start is None else start
        try:
            return self.minimise(q, none, q, force, mu, lam, what)
        except SimulationError:
            q = np.broadcast_to(self.mesh.vertices, force.shape).copy()
            for share in np.linspace(0.125, 1.0, 8):
                q = self.minimise(q, none, q, share * force, mu, lam, f"{what} at {share:.0%} of the load")
            return q

    def tangent(self, q: Array, mu: Array, lam: Array) -> Array:
        """The cells' true (unprojected) tangents at q, lower blocks only, (B, E, 24, 24) [N/m]."""
        return self._terms(q, mu, lam, project=False, tangent=True)[2]

    def tangent_product(self, tangent: Array, x: Array) -> Array:
        """Tangent times x, both (B, N, 3); all nodes, the held ones too."""
        out = np.zeros_like(x)
        for t in range(len(x)):
            multiply(tangent[t], self.mesh.hexes, x[t], out[t])
        return out

    def tangent_solve(self, tangent: Array, inertia: Array, right: Array) -> Array:
        """Solve (inertia + tangent) x = right on the free nodes; zero on the held ones.

        tangent from `tangent`, inertia (B, N), right (B, N, 3) or, with further columns, (B, N, 3, C).
        """
        columns = right.reshape(*right.shape[:3], -1)
        out = np.zeros_like(columns)
        free = self.free_index
        with _BLAS.limit(limits=1, user_api="blas"):
            for t in range(len(right)):
                load = columns[t].reshape(-1, columns.shape[-1])[free]
                band = self._band(tangent[t], inertia[t])
                factor, info = lapack.dpbtrf(band, lower=1)
                if info == 0:
                    solution = lapack.dpbtrs(factor, load, lower=1)[0]
                else:
                    width = len(band) - 1
                    full = np.zeros((2 * width + 1, band.shape[1]))
                    full[width:] = band
                    for k in range(1, width + 1):
                        full[width - k, k:] = band[k, :-k]
                    solution = solve_banded((width, width), full, load)
                out[t].reshape(-1, columns.shape[-1])[free] = solution
        return out.reshape(right.shape)
