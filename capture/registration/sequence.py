"""The first frame as in the paper's prior work: a sequence of virtual forces over time, optimised with Adam.

It is slow and serves as the reference for `rafl.capture.registration.initial`.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.initial import InitialState
from rafl.capture.registration.rigid import IDENTITY
from rafl.simulation.rollout import Start, rollout

SIMULATION_STEPS = 150  # from rest to the first frame
MATCHED_STEPS = 10  # last steps, in which the markers should match the recorded ones
ITERATIONS = 300
LEARNING_RATE = 5e-3  # of Adam [N]
LOSS_SCALE, FORCE_PENALTY = 1e3, 1e-4  # of squared distances [1/m^2]; of squared forces [m^2/N^2]


def fit_by_sequence(frame: FirstFrame, iterations: int = ITERATIONS) -> InitialState:
    """Fit nodal forces for every step of a simulation from rest that ends in the first frame.

    Raises:
        SimulationError: a simulation failed.
    """
    simulator, nodes = frame.simulator, torch.from_numpy(frame.nodes)
    rest = torch.from_numpy(simulator.equilibrium(simulator.weight[None], label=f"{frame.recording}: at rest"))
    zero = torch.zeros_like(rest)
    start = Start(rest, zero, zero, zero[..., 0], (frame.recording,))
    measured = torch.from_numpy(frame.measured)
    target, weight = (torch.from_numpy(x[frame.measured]) for x in (frame.target, frame.sigma))
    weight = (weight[weight.isfinite()].median() / weight) ** 2
    axes = torch.from_numpy(frame.axes[frame.measured]) if frame.axes is not None else torch.eye(3, dtype=torch.float64)
    sequence = torch.zeros((SIMULATION_STEPS, len(nodes), 3), dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([sequence], lr=LEARNING_RATE)
    best = np.inf
    found: tuple[Tensor, Tensor] = (rest[0], zero[0])
    for _ in range(iterations):
        step_numbers = iter(range(SIMULATION_STEPS))

        def external_force(q: Tensor, v: Tensor, external: Tensor, steps: Iterator[int] = step_numbers) -> Tensor:
            return torch.zeros_like(q).index_copy(1, nodes, sequence[next(steps)][None])

        optimiser.zero_grad()
        q = rollout(simulator, start, SIMULATION_STEPS, external_force)[0][:, 0]
        residual = (axes @ (frame.markers.positions(q[-MATCHED_STEPS:])[:, measured] - target)[..., None])[..., 0]
        loss = LOSS_SCALE * ((weight * residual**2).sum() + FORCE_PENALTY * (sequence**2).sum()) / MATCHED_STEPS
        if loss.item() < best:
            best = loss.item()
            force = torch.zeros_like(rest[0]).index_copy(0, nodes, sequence[-1].detach())
            found = (q[-1].detach().clone(), force)
        torch.autograd.backward(loss)
        optimiser.step()
    final = frame.along_axes((frame.markers.positions(found[0])[measured] - target).numpy())[frame.observed_axes]
    rms_distance = float(np.sqrt((final**2).mean() * 3.0))
    unknown = np.full(len(frame.target), np.nan)
    return InitialState(found[0].numpy(), found[1].numpy(), rms_distance, IDENTITY, unknown, "a sequence of forces")
