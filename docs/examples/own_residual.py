"""A residual model of one's own: a drag whose coefficient is learned from a recording."""

import torch
from torch import Tensor, nn

import rafl


class Drag(nn.Module):
    """Nodal forces [N] against the velocity, by a learned rate [1/s]."""

    def __init__(self, node_mass: Tensor) -> None:
        super().__init__()
        self.node_mass = node_mass  # [kg], (N)
        self.log_rate = nn.Parameter(torch.zeros((), dtype=torch.float64))

    def forward(self, q: Tensor, v: Tensor, external: Tensor) -> Tensor:
        """The force (B, N, 3) [N] at positions q [m], velocities v [m/s] and external forces [N]."""
        return -torch.exp(self.log_rate) * self.node_mass[:, None] * v


dataset = rafl.read_dataset("beam.h5")
simulator = dataset.simulator
names = dataset.split("train")[:1]
recorded = torch.from_numpy(dataset.trajectories[names[0]].markers)[:20, None]  # (T, 1, M, 3)

drag = Drag(torch.from_numpy(simulator.node_mass))
optimiser = torch.optim.Adam(drag.parameters(), lr=0.3)
for _ in range(3):
    positions, _ = rafl.rollout(simulator, dataset.start(names), 19, drag)
    loss = (dataset.markers.positions(positions) - recorded).nan_to_num().square().sum()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    print(f"rate {drag.log_rate.exp():.2f} 1/s, loss {1e6 * loss:.1f} mm^2")


# The same model on every mesh, beside the baseline simulator: errors [mm] by recording.
def own_model(simulator: rafl.Simulator) -> rafl.ResidualForce:
    """The drag on the mesh of a simulator."""
    on_mesh = Drag(torch.from_numpy(simulator.node_mass))
    on_mesh.log_rate = drag.log_rate
    return on_mesh


print(rafl.evaluate({"drag": own_model}, [dataset])[["recording", "method", "mean_mm"]])
prediction = rafl.predict(rafl.read_specimen("longer.yaml"), own_model, load_g=50, frames=10)
