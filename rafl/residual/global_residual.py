"""The supervised baseline's network: from the whole state to a force on every vertex (paper, SRL baseline)."""

import torch
from torch import Tensor, nn

from rafl.common.errors import InputError
from rafl.simulation.rollout import ResidualForce
from rafl.simulation.simulator import Simulator

WIDTH, BLOCKS, LAYERS = 512, 5, 3
LEAST_SIZE = 0.05


class _Block(nn.Module):
    """Layers of one width whose sum is added to what came in."""

    def __init__(self, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for _ in range(LAYERS):
            layers += [nn.Linear(width, width), nn.LayerNorm(width), nn.ELU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


def motion_of(q: Tensor, v: Tensor, rest: Tensor) -> Tensor:
    """The network's input (S, 6 N), single precision, from positions and velocities (S, N, 3) and the rest (N, 3)."""
    return torch.cat([(q - rest).flatten(1), v.flatten(1)], dim=1).float()


class GlobalResidual(nn.Module):
    """From displacements and velocities of all N vertices to a force on each; of no use on another mesh.

    So a stretched mesh at rest is the same state as the one trained on, and the paper's errors on stretched beams come
    out; with positions in their place they are up to six times as large. Inputs and outputs are normalised by their
    means and standard deviations over the training states.
    """

    motion_mean: Tensor
    motion_size: Tensor
    force_mean: Tensor
    force_size: Tensor

    def __init__(self, nodes: int) -> None:
        super().__init__()
        self.nodes = nodes
        self.network = nn.Sequential(
            nn.Linear(6 * nodes, WIDTH), *[_Block(WIDTH) for _ in range(BLOCKS)], nn.Linear(WIDTH, 3 * nodes)
        )
        for name, size in (("motion_mean", 6), ("motion_size", 6), ("force_mean", 3), ("force_size", 3)):
            start = torch.zeros if name.endswith("mean") else torch.ones
            self.register_buffer(name, start(size * nodes))

    def normalise(self, motion: Tensor, forces: Tensor) -> None:
        """Take means and standard deviations from training states (S, 6 N) and forces (S, 3 N)."""
        displacements, velocities = motion.chunk(2, dim=1)
        # What hardly moves must not be blown up: a twentieth of the liveliest is the least size of its kind.
        sizes = [
            values.std(0).clamp_min(LEAST_SIZE * float(values.std(0).max()))
            for values in (displacements, velocities, forces)
        ]
        self.motion_mean.copy_(motion.mean(0))
        self.motion_size.copy_(torch.cat(sizes[:2]))
        self.force_mean.copy_(forces.mean(0))
        self.force_size.copy_(sizes[2])

    def forward(self, motion: Tensor) -> Tensor:
        """Normalised forces (S, 3 N) of states (S, 6 N)."""
        return self.network((motion - self.motion_mean) / self.motion_size)

    def on(self, simulator: Simulator) -> ResidualForce:
        """(q, v, external force) -> nodal forces [N], all (B, N, 3).

        Raises:
            InputError: a mesh of another number of vertices.
        """
        found = len(simulator.mesh.vertices)
        if found != self.nodes:
            raise InputError(
                f"srl: expected the mesh it was trained on, of {self.nodes} vertices, found {found}; train it on this "
                "mesh, or use method rafl, which works on any"
            )

        rest = torch.from_numpy(simulator.mesh.vertices)

        def force(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
            return (self(motion_of(q, v, rest)) * self.force_size + self.force_mean).double().reshape(q.shape)

        return force
