"""The first frame as the paper's prior work finds it: a sequence of virtual forces over time, by Adam.

Slow, and kept to compare `rafl.capture.registration.initial` with.
"""

import numpy as np
import torch
from rafl.capture.registration.initial import FirstFrame, InitialState
from rafl.capture.registration.rigid import IDENTITY
from torch import Tensor

from rafl.simulation.rollout import Start, rollout

STEPS = 150  # of the simulation that leads from rest to the first frame
HELD = 10  # of these, at the end, in which the markers are to stand where they were seen
ITERATIONS = 300
RATE = 5e-3  # Adam's [N]
LOSS_SCALE, PENALTY = 1e3, 1e-4  # of squared distances [1/m^2]; of squared forces [m^2/N^2]


def fit_by_sequence(frame: FirstFrame, iterations: int = ITERATIONS) -> InitialState:
    """Nodal forces for every step of a simulation from rest, whose end is the first frame.

    Raises:
        SimulationError: a simulation failed.
    """
    simulator, nodes = frame.simulator, torch.from_numpy(frame.nodes)
    rest = torch.from_numpy(simulator.equilibrium(simulator.weight[None], what=f"{frame.what}: at rest"))
    none = torch.zeros_like(rest)
    start = Start(rest, none, none, none[..., 0], (frame.what,))
    seen = torch.from_numpy(frame.seen)
    target, weight = (torch.from_numpy(x[frame.seen]) for x in (frame.target, frame.sigma))
    weight = (weight.median() / weight) ** 2
    sequence = torch.zeros((STEPS, len(nodes), 3), dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([sequence], lr=RATE)
    best = np.inf
    found: tuple[Tensor, Tensor] = (rest[0], none[0])
    for _ in range(iterations):
        steps = iter(range(STEPS))

        def pull(q: Tensor, v: Tensor, external: Tensor, steps: object = steps) -> Tensor:
            return torch.zeros_like(q).index_copy(1, nodes, sequence[next(steps)][None])

        optimiser.zero_grad()
        q = rollout(simulator, start, STEPS, pull)[0][:, 0]
        gap = frame.markers.positions(q[-HELD:])[:, seen] - target
        loss = LOSS_SCALE * ((weight * gap**2).sum() + PENALTY * (sequence**2).sum()) / HELD
        if loss.item() < best:
            best = loss.item()
            force = torch.zeros_like(rest[0]).index_copy(0, nodes, sequence[-1].detach())
            found = (q[-1].detach().clone(), force)
        loss.backward()
        optimiser.step()
    left = (frame.markers.positions(found[0])[seen] - target).numpy()[frame.observed]
    residual = float(np.sqrt((left**2).mean() * 3.0))
    return InitialState(found[0].numpy(), found[1].numpy(), residual, IDENTITY)
