"""Network of the supervised baseline: from the state of the whole mesh to nodal forces (paper, SRL baseline)."""

import torch
from torch import Tensor, nn

from rafl.common.errors import InputError
from rafl.simulation.rollout import ResidualForce
from rafl.simulation.simulator import Simulator

WIDTH, BLOCKS, LAYERS = 512, 5, 3  # units per layer, residual blocks, layers per block
MIN_RELATIVE_DEVIATION = 0.05  # smallest sigma for normalisation, relative to the largest of its kind


class _Block(nn.Module):
    """Residual block: layers of one width, whose output is added to the input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for _ in range(LAYERS):
            layers += [nn.Linear(width, width), nn.LayerNorm(width), nn.ELU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        output: Tensor = x + self.layers(x)
        return output


def network_input(q: Tensor, v: Tensor, rest: Tensor) -> Tensor:
    """Network input (S, 6 N), single precision, from positions and velocities (S, N, 3) and rest positions (N, 3)."""
    return torch.cat([(q - rest).flatten(1), v.flatten(1)], dim=1).float()


class GlobalResidual(nn.Module):
    """Network from displacements and velocities of all N vertices to a force on each; bound to one mesh.

    With displacements as input, a stretched mesh at rest is the same state as the training mesh at rest, and the errors
    on stretched beams are those of the paper. With positions as input they are up to six times as large. Inputs and
    outputs are normalised by their means and sigmas over the training states.

    Args:
        nodes: number of vertices N.
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

    def set_normalisation(self, motion: Tensor, forces: Tensor) -> None:
        """Set means and sigmas from training inputs (S, 6 N) and forces (S, 3 N)."""
        displacements, velocities = motion.chunk(2, dim=1)
        # The lower bound keeps the normalisation from amplifying components that hardly vary.
        sizes = [
            values.std(0).clamp_min(MIN_RELATIVE_DEVIATION * float(values.std(0).max()))
            for values in (displacements, velocities, forces)
        ]
        self.motion_mean.copy_(motion.mean(0))
        self.motion_size.copy_(torch.cat(sizes[:2]))
        self.force_mean.copy_(forces.mean(0))
        self.force_size.copy_(sizes[2])

    def forward(self, motion: Tensor) -> Tensor:
        """Normalised forces (S, 3 N) from inputs (S, 6 N)."""
        output: Tensor = self.network((motion - self.motion_mean) / self.motion_size)
        return output

    def on(self, simulator: Simulator) -> ResidualForce:
        """The force of the network on a specimen: (q, v, external force) -> nodal forces [N], all (B, N, 3).

        Raises:
            InputError: the mesh has another number of vertices.
        """
        found = len(simulator.mesh.vertices)
        if found != self.nodes:
            raise InputError(
                f"srl: expected the training mesh of {self.nodes} vertices, found {found}; train on this mesh, or use "
                "method rafl, which works on any mesh"
            )

        rest = torch.from_numpy(simulator.mesh.vertices)

        def force(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
            forces: Tensor = self(network_input(q, v, rest)) * self.force_size + self.force_mean
            return forces.double().reshape(q.shape)

        return force
