"""System identification: Young's modulus and Poisson's ratio by exact gradients (paper, SysID baseline)."""

from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize

from rafl.dataset import Dataset
from rafl.errors import SimulationError
from rafl.fit import Report, batches, mean_error, shortened, training_items, validation_batches
from rafl.objective import training_loss
from rafl.run import FittedModel, Settings, read_history, save_model, write_history

MODULUS = (2e4, 1e7)  # Pa
POISSON = (0.3, 0.499)


def _variables(youngs_modulus: float, poissons_ratio: float) -> np.ndarray:
    """(log E, log(1/2 - nu)): what stiffness and bulk stiffness are powers of."""
    return np.log([youngs_modulus, 0.5 - poissons_ratio])


def _identified(x: np.ndarray) -> dict[str, float]:
    return {"youngs_modulus": float(np.exp(x[0])), "poissons_ratio": float(0.5 - np.exp(x[1]))}


def identify_material(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Fit E and nu to the training recordings by L-BFGS-B from the datasets' assumed material.

    Where `history.csv` stands in `run` already, the search goes on from its last row.

    Raises:
        InputError: no recording to train on.
        SimulationError: the assumed material itself cannot be simulated.
    """
    cut = [shortened(dataset, settings.frames) for dataset in datasets]
    train, validate = batches(training_items(cut), settings.by_sigma), validation_batches(cut)
    count = sum(len(recordings.names) for recordings in train)
    history = read_history(run)
    losses: dict[bytes, float] = {}

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        parameters = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        values = {"youngs_modulus": parameters[0].exp(), "poissons_ratio": 0.5 - parameters[1].exp()}
        total = torch.zeros((), dtype=torch.float64)
        try:
            for recordings in train:
                simulated, forces = recordings.simulate(parameters=recordings.dataset.simulator.parameters(**values))
                total = total + training_loss(recordings, simulated, forces) * len(recordings.names) / count
        except SimulationError:
            if not losses:
                raise
            return 1e6, np.zeros(2)  # a trial step too far: the line search comes back
        total.backward()
        assert parameters.grad is not None
        losses[x.tobytes()] = total.item()
        return total.item(), parameters.grad.numpy().copy()

    def record(x: np.ndarray) -> None:
        row = {
            "epoch": len(history),
            "loss": losses[x.tobytes()] if x.tobytes() in losses else objective(x)[0],
            "validation_mm": 1e3 * mean_error(validate, FittedModel("sysid", material=_identified(x))),
            **_identified(x),
        }
        history.append(row)
        write_history(run, history)
        report(row)

    assumed = datasets[0].simulator.material
    if history:
        start = _variables(history[-1]["youngs_modulus"], history[-1]["poissons_ratio"])
    else:
        start = _variables(assumed.youngs_modulus, float(np.clip(assumed.poissons_ratio, *POISSON)))
        record(start)

    def relative(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = objective(x)
        return value / history[0]["loss"], slope / history[0]["loss"]

    stiffest, softest = _variables(MODULUS[1], POISSON[0]), _variables(MODULUS[0], POISSON[1])
    result = minimize(
        relative,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(softest[0], stiffest[0]), (softest[1], stiffest[1])],
        callback=record,
        options={"maxiter": max(settings.epochs - len(history) + 1, 0), "ftol": 1e-7, "gtol": 1e-7},
    )
    model = FittedModel("sysid", material=_identified(result.x))
    save_model(run, model)
    return model
