"""System identification: Young's modulus and Poisson's ratio by exact gradients (paper, SysID baseline)."""

from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize

from rafl.dataset import Dataset
from rafl.fit import Report, mean_error, shortened, training_recordings
from rafl.objective import training_loss
from rafl.run import FittedModel, Settings, read_history, save_model, write_history
from rafl.simulator import SimulationError

LOG_MODULUS = (np.log(2e4), np.log(1e7))
POISSON = (0.3, 0.499)


def identify_material(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Fit (log E, nu) of the training recordings by L-BFGS-B from the datasets' assumed material.

    Where `history.csv` stands in `run` already, the search goes on from its last row.

    Raises:
        InputError: no recording to train on.
        SimulationError: the assumed material itself cannot be simulated.
    """
    train, validate = training_recordings([shortened(dataset, settings.frames) for dataset in datasets])
    history = read_history(run)
    evaluations = 0

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal evaluations
        evaluations += 1
        parameters = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        material = (parameters[0].exp(), parameters[1])
        total = torch.zeros((), dtype=torch.float64)
        try:
            for recordings in train:
                simulated, forces = recordings.simulate(material=material)
                total = total + training_loss(recordings, simulated, forces) / len(train)
        except SimulationError:
            if evaluations == 1:
                raise
            return 1e6, np.zeros(2)  # a trial step too far: the line search comes back
        total.backward()
        assert parameters.grad is not None
        return total.item(), parameters.grad.numpy().copy()

    def record(x: np.ndarray) -> None:
        model = FittedModel("sysid", material=(float(np.exp(x[0])), float(x[1])))
        row = {
            "epoch": len(history),
            "loss": objective(x)[0],
            "validation_mm": 1e3 * mean_error(validate, model),
            "youngs_modulus": float(np.exp(x[0])),
            "poissons_ratio": float(x[1]),
        }
        history.append(row)
        write_history(run, history)
        report(row)

    assumed = datasets[0].simulator.material
    first = {"youngs_modulus": assumed.youngs_modulus, "poissons_ratio": assumed.poissons_ratio}
    last = history[-1] if history else first
    start = np.array([np.log(last["youngs_modulus"]), np.clip(last["poissons_ratio"], *POISSON)])
    if not history:
        record(start)

    # Tenths of nu and of log E are of like effect; L-BFGS-B wants its variables so.
    scale = np.array([1.0, 0.1])

    def scaled(y: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = objective(y * scale)
        return value / history[0]["loss"], slope * scale / history[0]["loss"]

    result = minimize(
        scaled,
        start / scale,
        jac=True,
        method="L-BFGS-B",
        bounds=[LOG_MODULUS, (POISSON[0] / scale[1], POISSON[1] / scale[1])],
        callback=lambda y: record(y * scale),
        options={"maxiter": max(settings.epochs - len(history) + 1, 0), "ftol": 1e-7, "gtol": 1e-6},
    )
    best = result.x * scale
    model = FittedModel("sysid", material=(float(np.exp(best[0])), float(best[1])))
    save_model(run, model)
    return model
