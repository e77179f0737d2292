"""One specimen's mechanics: mesh, material, clamp, gravity, and how time is stepped."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import SimulationError
from rafl.fem.constitutive_state import Resistance
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.compiled_engine import Compiled
from rafl.simulation.engine import Engine
from rafl.simulation.newton import minimise
from rafl.simulation.parameters import Parameters
from rafl.simulation.reference_engine import Plain
from rafl.simulation.time_integration import INTEGRATORS
from rafl.solvers.linear import Factors

Array = NDArray[Any]

GRAVITY = (0.0, 0.0, -9.80709)
ARITHMETIC = ("compiled", "plain")
UPRIGHT = 0.02  # of gravity: what its component across a plane of symmetry may be


@dataclass(frozen=True)
class Simulator:
    """One specimen: a mesh of one material, held at some nodes, under gravity.

    Attributes:
        mesh: the rest shape.
        material: elasticity, density, damping, and how mass is lumped.
        fixed: indices of the held nodes, (F).
        time_step: dt between frames [s].
        gravity: [m/s^2], (3).
        integrator: one of `rafl.simulation.time_integration.INTEGRATORS`.
        substeps: steps of the integrator within dt.
        arithmetic: `compiled` kernels on the processor, or `plain` tensors on `device`, which say the
            same and are meant to be read, and to run on graphics cards.
        device: of `plain` arithmetic, as torch names it.

    Raises:
        ValueError: a name or number that is none of these.
    """

    mesh: HexMesh
    material: Material
    fixed: NDArray[np.int64]
    time_step: float = 0.01
    gravity: tuple[float, float, float] = GRAVITY
    integrator: str = "implicit-euler"
    substeps: int = 1
    arithmetic: str = "compiled"
    device: str = "cpu"

    def __post_init__(self) -> None:
        for key, known in (("integrator", tuple(INTEGRATORS)), ("arithmetic", ARITHMETIC)):
            if getattr(self, key) not in known:
                raise ValueError(f"expected {key} to be one of {', '.join(known)}, got {getattr(self, key)!r}")
        if self.device != "cpu" and self.arithmetic != "plain":
            raise ValueError(f"expected arithmetic to be plain on device {self.device!r}, got {self.arithmetic!r}")
        if not (self.time_step > 0 and self.substeps >= 1):
            raise ValueError(f"expected time_step > 0 and substeps >= 1, got {self.time_step} and {self.substeps}")

    @property
    def stepping(self) -> dict[str, Any]:
        """How time is stepped, by the names of this class."""
        return {"integrator": self.integrator, "substeps": self.substeps}

    @cached_property
    def engine(self) -> Engine:
        """Energy, gradient, tangent and linear solves."""
        material = self.material
        if self.arithmetic == "plain":
            return Plain(self.mesh, material.law, material.integration, self.fixed, self.device)
        return Compiled(self.mesh, material.law, material.integration, self.fixed)

    @cached_property
    def node_volume(self) -> Array:
        """What, times density, is each node's mass [m^3], (N,)."""
        return self.material.node_volume(self.mesh)

    @property
    def node_mass(self) -> Array:
        """Nodal masses [kg], (N,)."""
        return self.material.density * self.node_volume

    @property
    def mirrors(self) -> NDArray[np.bool_]:
        """Whether the specimen, as it is held and as gravity pulls, is its own mirror image across each axis, (3)."""
        across = np.abs(self.gravity) <= UPRIGHT * np.linalg.norm(self.gravity)
        return self.mesh.mirrors(self.fixed) & across

    @property
    def weight(self) -> Array:
        """Nodal gravity forces [N], (N, 3)."""
        return self.node_mass[:, None] * np.asarray(self.gravity)

    def parameters(self, **replacing: Any) -> Parameters:
        """Material and gravity as tensors, some replaced by name, for `rafl.simulation.rollout`."""
        return Parameters.of(self.material, self.gravity, **replacing)

    def resistance(self, batch: int) -> Resistance:
        """The material's elasticity, without damping, for a batch."""
        return Resistance(self.parameters().moduli(self.material.law, batch).numpy())

    def elastic_gradient(self, q: Array) -> Array:
        """Derivative of the elastic energy by q [N], (B, N, 3); minus the internal force."""
        return self.engine.terms(q, self.resistance(len(q)), tangent=False)[1]

    def minimise(
        self,
        start: Array,
        inertia: Array,
        target: Array,
        force: Array,
        resistance: Resistance,
        what: str,
        factors: Factors | None = None,
    ) -> Array:
        """`rafl.simulation.newton.minimise` with this specimen's arithmetic."""
        with self.engine.threads(len(start)):
            return minimise(self.engine, start, inertia, target, force, resistance, what, factors)

    def equilibrium(
        self, force: Array, start: Array | None = None, what: str = "equilibrium", resistance: Resistance | None = None
    ) -> Array:
        """Static equilibrium [m], (B, N, 3), under nodal forces (B, N, 3) [N], gravity included.

        Held nodes stay where `start` (B, N, 3) has them, or at rest. Where Newton's method fails at
        once the load is put on in steps, more of them where it must be.

        Raises:
            SimulationError: not even in 64 steps.
        """
        resistance = resistance or self.resistance(len(force))
        none = np.zeros(force.shape[:2])
        begin = np.broadcast_to(self.mesh.vertices, force.shape).copy() if start is None else start
        try:
            return self.minimise(begin, none, begin, force, resistance, what)
        except SimulationError:
            pass
        shape = np.broadcast_to(self.mesh.vertices, force.shape).copy()
        steps = 8
        while True:
            try:
                q = shape
                for share in np.linspace(1.0 / steps, 1.0, steps):
                    q = q.copy()
                    q[:, self.fixed] = (1.0 - share) * shape[:, self.fixed] + share * begin[:, self.fixed]
                    q = self.minimise(q, none, q, share * force, resistance, f"{what} at {share:.0%} of the load")
                return q
            except SimulationError:
                if steps >= 64:
                    raise
                steps *= 2

    def solve_tangent(self, q: Array, right: Array) -> Array:
        """Solve K x = right on the free nodes, K the exact static tangent at q; zero on the held ones.

        q (B, N, 3); right (B, N, 3) [N] or, with further columns, (B, N, 3, C).
        """
        tangents = self.engine.terms(q, self.resistance(len(q)), tangent=True)[2]
        free = self.engine.free_index
        columns = right.reshape(len(q), -1, int(np.prod(right.shape[3:])))  # (B, 3 N, C)
        solution = self.engine.solve_once(
            tangents, np.zeros((len(q), len(free))), np.ascontiguousarray(columns[:, free].transpose(0, 2, 1))
        )
        out = np.zeros_like(columns)
        out[:, free] = solution.transpose(0, 2, 1)
        return out.reshape(right.shape)
