"""Memory of the viscous stress: Kelvin-Voigt viscosity and any number of Maxwell branches, as one quadratic form.

A branch of modulus G and relaxation time tau, a spring and a dashpot in series beside the elastic law, adds the second
Piola-Kirchhoff stress 2 G A, where dA/dt = dE/dt - A / tau and E is the Green strain. If E is linear over h,

    A = e A0 + c (E - E0),   e = exp(-h / tau),   c = (1 - e) tau / h,

exactly (Taylor, Pister and Goudreau, 1970). Viscosity eta adds 2 eta dE/dt, by the second-order backward difference of
the last three strains. All together add 2 (g E - memory) with one modulus g and one memory per strain, however many
branches there are. The same holds for the hourglass vectors of `rafl.fem.enhanced.hourglass` in the place of E.

The strains are those at the solutions of the steps, which lie `Integrator.fraction` of a step after its start.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rafl.fem.learned.viscosity import learned_viscosity


@dataclass(frozen=True)
class ViscousMemory:
    """History of the viscous stress of a batch of bodies.

    Attributes:
        viscosity: eta [Pa s], (B).
        points: number of integration points P of a cell; its strains are 6 P components, then hourglass vectors.
        branch_moduli, branch_times: G [Pa] and tau [s] of K branches, (B, K).
        strain: Green strains, then hourglass vectors [m], at the latest solution, (B, E, Z).
        earlier_strain, interval: those at the solution before, and the time between the two [s]; None at the start.
        branch_strain: A of every branch at the latest solution, (K, B, E, Z).
        dissipation: weights of a learned viscosity times mu [Pa], (B, K), see `rafl.fem.learned.viscosity`, or None.
    """

    viscosity: Tensor
    points: int
    branch_moduli: Tensor
    branch_times: Tensor
    strain: Tensor
    earlier_strain: Tensor | None = None
    interval: float = 0.0
    branch_strain: Tensor | None = None
    dissipation: Tensor | None = None

    def _viscosity(self) -> Tensor:
        """Viscosity over the coming interval [Pa s], (B, E, P) or (B, 1, 1)."""
        eta = self.viscosity[:, None, None]
        if self.dissipation is None:
            return eta
        strain = self._at_points(self.strain)
        rate = torch.zeros_like(strain)
        if self.earlier_strain is not None:
            rate = (strain - self._at_points(self.earlier_strain)) / self.interval
        return eta + learned_viscosity(self.dissipation, strain, rate)

    def _at_points(self, strain: Tensor) -> Tensor:
        """Green strains at the points, (B, E, P, 6)."""
        return strain[..., : 6 * self.points].reshape(*strain.shape[:2], self.points, 6)

    def _over_strains(self, at_points: Tensor) -> Tensor:
        """Values at the points (B, E, P), repeated for every strain, (B, E, Z)."""
        if at_points.shape[1:] == (1, 1):
            return at_points
        vectors = self.strain.shape[-1] - 6 * self.points  # of `enhanced` integration, which has one point
        return torch.cat([at_points.repeat_interleave(6, -1), at_points[..., :1].expand(-1, -1, vectors)], dim=-1)

    def _decay(self, h: float) -> tuple[Tensor, Tensor]:
        """e and c of every branch over an interval h [s], each (K, B, 1, 1)."""
        ratio = (h / self.branch_times).mT[..., None, None]
        return torch.exp(-ratio), -torch.expm1(-ratio) / ratio

    def stress_terms(self, h: float) -> tuple[Tensor, Tensor]:
        """Viscous modulus g [Pa], (B, E, P), and memory [Pa], (B, E, Z), at a solution h [s] after the latest one."""
        eta = self._viscosity()
        if self.earlier_strain is None:
            own, latest, earlier = 1.0 / h, 1.0 / h, 0.0
            rate_memory = latest * self.strain
        else:
            before = self.interval
            own = (2.0 * h + before) / (h * (h + before))
            latest, earlier = (h + before) / (h * before), -h / (before * (h + before))
            rate_memory = latest * self.strain + earlier * self.earlier_strain
        modulus, memory = own * eta, self._over_strains(eta) * rate_memory
        if self.branch_times.shape[1]:
            e, c = self._decay(h)
            moduli = self.branch_moduli.mT[..., None, None]
            modulus = modulus + (moduli * c).sum(0)
            memory = memory + (moduli * c).sum(0) * self.strain
            if self.branch_strain is not None:
                memory = memory - (moduli * e * self.branch_strain).sum(0)
        return modulus.expand(*self.strain.shape[:2], self.points), memory

    def after(self, strain: Tensor, h: float) -> "ViscousMemory":
        """The history after a solution with strains (B, E, Z), h [s] after the latest one."""
        branch_strain = None
        if self.branch_times.shape[1]:
            e, c = self._decay(h)
            branch_strain = c * (strain - self.strain)
            if self.branch_strain is not None:
                branch_strain = branch_strain + e * self.branch_strain
        return replace(self, strain=strain, earlier_strain=self.strain, interval=h, branch_strain=branch_strain)
