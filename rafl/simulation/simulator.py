"""Mechanics of one specimen: mesh, material, fixed nodes, gravity and time integration."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.fem.constitutive_state import ConstitutiveState, HourglassStiffness
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.compiled_engine import CompiledEngine
from rafl.simulation.device import CPU, require_device
from rafl.simulation.engine import Engine
from rafl.simulation.newton import MAX_ITERATIONS, minimise
from rafl.simulation.parameters import Parameters
from rafl.simulation.time_integration import INTEGRATORS
from rafl.simulation.torch_engine import TorchEngine
from rafl.solvers.linear import Factors

Array = NDArray[Any]

GRAVITY = (0.0, 0.0, -9.80709)  # [m/s^2]; the value of the paper's simulator
ARITHMETIC = ("compiled", "torch")
MAX_GRAVITY_ACROSS = 0.02  # largest component of gravity normal to a symmetry plane, relative to its magnitude
FIRST_LOAD_STEPS, MAX_LOAD_STEPS = 8, 64  # of an equilibrium whose load is applied in steps


@dataclass(frozen=True)
class Simulator:
    """One specimen: a mesh of one material, fixed at some nodes, under gravity.

    Attributes:
        mesh: the rest shape.
        material: elasticity, density, damping, and how mass is lumped.
        fixed: indices of the fixed nodes, (F).
        time_step: dt between frames [s].
        gravity: [m/s^2], (3).
        integrator: one of `rafl.simulation.time_integration.INTEGRATORS`.
        substeps: number of integrator steps within dt.
        arithmetic: `compiled` kernels on the CPU, or `torch` tensors on `device`. Both compute the same; the kernels
            are faster on a CPU, and the tensors run on a graphics card too.
        device: torch device of the `torch` arithmetic.

    Raises:
        ValueError: an unknown name, or a number out of range.
    """

    mesh: HexMesh
    material: Material
    fixed: NDArray[np.int64]
    time_step: float = 0.01
    gravity: tuple[float, float, float] = GRAVITY
    integrator: str = "implicit-euler"
    substeps: int = 1
    arithmetic: str = "compiled"
    device: str = CPU

    def __post_init__(self) -> None:
        for key, known in (("integrator", tuple(INTEGRATORS)), ("arithmetic", ARITHMETIC)):
            if getattr(self, key) not in known:
                raise ValueError(f"expected {key} to be one of {', '.join(known)}, got {getattr(self, key)!r}")
        if self.device != CPU and self.arithmetic != "torch":
            raise ValueError(f"expected arithmetic to be torch on device {self.device!r}, got {self.arithmetic!r}")
        fixed, nodes = np.asarray(self.fixed), len(self.mesh.vertices)
        if not (np.issubdtype(fixed.dtype, np.integer) and ((fixed >= 0) & (fixed < nodes)).all()):
            raise ValueError(
                f"expected fixed to hold node indices from 0 to {nodes - 1}, got {fixed.dtype} {fixed!r:.60}"
            )
        if not (0 < self.time_step < np.inf and self.substeps >= 1):
            raise ValueError(f"expected time_step > 0 and substeps >= 1, got {self.time_step} and {self.substeps}")
        if not np.isfinite(self.gravity).all():
            raise ValueError(f"expected a finite gravity, got {self.gravity}")

    def on_device(self, device: str) -> "Simulator":
        """The same simulator on a device: compiled kernels on `cpu`, tensors on a graphics card (`cuda`, `cuda:1`).

        Raises:
            InputError: there is no such device.
        """
        require_device(device)
        return replace(self, arithmetic="compiled" if device == CPU else "torch", device=device)

    def with_material(self, material: Material) -> "Simulator":
        """The simulator of another material; it shares the engine, with its linear solver, if this may be the same."""
        other = replace(self, material=material)
        if (material.law, material.integration) == (self.material.law, self.material.integration):
            other.__dict__["engine"] = self.engine  # where `cached_property` looks for it
        return other

    @property
    def time_integration(self) -> dict[str, Any]:
        """Settings of the time integration, by attribute name."""
        return {"integrator": self.integrator, "substeps": self.substeps}

    @cached_property
    def engine(self) -> Engine:
        """Energy, gradient, tangent and linear solves."""
        material = self.material
        if self.arithmetic == "torch":
            return TorchEngine(self.mesh, material.law, material.integration, self.fixed, self.device)
        return CompiledEngine(self.mesh, material.law, material.integration, self.fixed)

    @cached_property
    def node_volume(self) -> Array:
        """Nodal volumes [m^3], (N,): nodal masses divided by density."""
        return self.material.node_volume(self.mesh)

    @property
    def node_mass(self) -> Array:
        """Nodal masses [kg], (N,)."""
        mass: Array = self.material.density * self.node_volume
        return mass

    @property
    def symmetry_planes(self) -> NDArray[np.bool_]:
        """Whether mesh, fixed nodes and gravity are symmetric about the mid-plane normal to each axis, (3)."""
        in_plane = np.abs(self.gravity) <= MAX_GRAVITY_ACROSS * np.linalg.norm(self.gravity)
        return self.mesh.symmetry_planes(self.fixed) & in_plane

    @property
    def weight(self) -> Array:
        """Nodal gravity forces [N], (N, 3)."""
        weight: Array = self.node_mass[:, None] * np.asarray(self.gravity)
        return weight

    def parameters(self, **replacements: Any) -> Parameters:
        """Material and gravity as tensors, some replaced by name, for `rafl.simulation.rollout`."""
        return Parameters.of(self.material, self.gravity, **replacements)

    def hourglass_stiffness(self, parameters: Parameters, batch: int) -> Tensor | None:
        """Stiffness of the hourglass modes for `enhanced` integration, else None.

        Elastic [N/m], viscous per Pa [m] and of stiffness damping [N s/m], (3, B, U, 12, 12); see
        `rafl.fem.constitutive_state.HourglassStiffness`. Differentiable by the parameters.
        """
        if self.material.integration != "enhanced":
            return None
        mu, lam = parameters.rest_lame(self.material.law, batch)
        elastic, viscous = self.engine.hourglass_modes.stiffness(mu, lam)
        beta = parameters.stiffness_damping.expand(batch)[:, None, None, None]
        return torch.stack([elastic, viscous, beta * elastic])

    def constitutive_state(self, batch: int, parameters: Parameters | None = None) -> ConstitutiveState:
        """Elastic moduli of the material, or of other parameters, without damping, for a batch."""
        parameters = parameters or self.parameters()
        energy = parameters.energy(batch)
        hourglass = self.hourglass_stiffness(parameters, batch)
        return ConstitutiveState(
            parameters.moduli(self.material.law, batch).numpy(),
            hourglass=None if hourglass is None else HourglassStiffness(*hourglass.numpy()),
            energy_weights=None if energy is None else energy.contiguous().numpy(),  # as the kernels take them
        )

    def elastic_gradient(self, q: Array, parameters: Parameters | None = None) -> Array:
        """Derivative of the elastic energy with respect to q [N], (B, N, 3), with other parameters if given."""
        return self.engine.evaluate(q, self.constitutive_state(len(q), parameters), tangent=False)[1]

    def minimise(
        self,
        start: Array,
        inertia: Array,
        target: Array,
        force: Array,
        state: ConstitutiveState,
        label: str,
        factors: Factors | None = None,
        max_iterations: int = MAX_ITERATIONS,
    ) -> Array:
        """`rafl.simulation.newton.minimise` with the engine of this specimen."""
        with self.engine.thread_limit(len(start)):
            return minimise(self.engine, start, inertia, target, force, state, label, factors, max_iterations)

    def equilibrium(
        self,
        force: Array,
        start: Array | None = None,
        label: str = "equilibrium",
        state: ConstitutiveState | None = None,
    ) -> Array:
        """Static equilibrium [m], (B, N, 3), under nodal forces (B, N, 3) [N], gravity included.

        The fixed nodes stay at their positions in `start` (B, N, 3), or at rest without it. If Newton's method fails
        under the full load, the load is applied in steps, and the number of steps is doubled until it succeeds.

        Raises:
            SimulationError: no convergence with 64 load steps.
        """
        state = state or self.constitutive_state(len(force))
        no_inertia = np.zeros(force.shape[:2])
        begin = np.broadcast_to(self.mesh.vertices, force.shape).copy() if start is None else start
        try:
            return self.minimise(begin, no_inertia, begin, force, state, label)
        except SimulationError:
            pass
        rest = np.broadcast_to(self.mesh.vertices, force.shape).copy()
        steps = FIRST_LOAD_STEPS
        while True:
            try:
                q = rest
                for share in np.linspace(1.0 / steps, 1.0, steps):
                    q = q.copy()
                    q[:, self.fixed] = (1.0 - share) * rest[:, self.fixed] + share * begin[:, self.fixed]
                    q = self.minimise(q, no_inertia, q, share * force, state, f"{label} at {share:.0%} of the load")
                return q
            except SimulationError:
                if steps >= MAX_LOAD_STEPS:
                    raise
                steps *= 2

    def solve_tangent(self, q: Array, right: Array) -> Array:
        """Solve K x = right on the free nodes, with K the exact static tangent at q; x is zero on the fixed nodes.

        q (B, N, 3) [m]; right (B, N, 3) [N] or, with C columns, (B, N, 3, C).
        """
        tangents = self.engine.evaluate(q, self.constitutive_state(len(q)), tangent=True)[2]
        free = self.engine.free_index
        columns = right.reshape(len(q), -1, int(np.prod(right.shape[3:])))  # (B, 3 N, C)
        solution = self.engine.solve_once(
            tangents, np.zeros((len(q), len(free))), np.ascontiguousarray(columns[:, free].transpose(0, 2, 1))
        )
        out = np.zeros_like(columns)
        out[:, free] = solution.transpose(0, 2, 1)
        return out.reshape(right.shape)
