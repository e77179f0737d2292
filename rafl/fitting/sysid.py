"""System identification by exact gradients (paper, SysID baseline): E and nu, E alone, or damping too."""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.data.objective import training_loss
from rafl.fitting.run_folder import (
    FORMAT,
    FittedModel,
    Settings,
    load_tensors,
    save_model,
    save_tensors,
    understood,
    write_history,
)
from rafl.fitting.train_field import Report, batches, mean_error, prepared, training_items, validation_batches

Array = NDArray[Any]

NEARLY_INCOMPRESSIBLE = 0.499  # nu where E alone is sought, as the paper has it
STARTS = (0.6, 1.7)  # times the assumed E, where the search begins again
# Leading frames that the search begins with, as shares of all and at least so many: over many swings the best is
# hidden behind others, where a simulation is whole swings ahead or behind.
SHARES, LEAST_FRAMES = (0.15, 0.4), 8
ROUNDS = 3  # iterations with each of these
STRIDE = 0.2  # of a variable: the first step
NORMAL = 1.959964  # 95 % of a normal distribution lie within as many standard deviations
WALL = 1e6  # the loss where a simulation fails
TINY = 1e-30  # a loss that is none
STEP = 1e-3  # of a variable, for the curvature's finite differences of the exact gradient


@dataclass(frozen=True)
class Quantity:
    """One number to identify, and the variable in whose scale the search is even.

    Attributes:
        name: in `rafl.simulation.parameters.Parameters`.
        low, high: bounds.
        kind: `log`: its logarithm; `gap`: the logarithm of 1/2 minus it; `root`: the root of its share of `usual`.
        unit: for messages.
    """

    name: str
    low: float
    high: float
    kind: str
    unit: str
    usual: float = 1.0

    def variable(self, value: float) -> float:
        """Of a value."""
        if self.kind == "log":
            return float(np.log(value))
        return float(np.log(0.5 - value)) if self.kind == "gap" else float(np.sqrt(value / self.usual))

    def value(self, variable: Any) -> Any:
        """Of a variable, a float or a tensor."""
        exp = torch.exp if isinstance(variable, Tensor) else np.exp
        if self.kind == "log":
            return exp(variable)
        return 0.5 - exp(variable) if self.kind == "gap" else self.usual * variable**2

    @property
    def bounds(self) -> tuple[float, float]:
        """Of the variable."""
        a, b = self.variable(self.low), self.variable(self.high)
        return min(a, b), max(a, b)


MODULUS = Quantity("youngs_modulus", 2e4, 1e7, "log", "Pa")
POISSON = Quantity("poissons_ratio", 0.3, 0.499, "gap", "")
VISCOSITY = Quantity("viscosity", 0.0, 1e4, "root", "Pa s", usual=100.0)
SOUGHT = {"sysid": (MODULUS, POISSON), "sysid-e": (MODULUS,), "sysid-damping": (MODULUS, POISSON, VISCOSITY)}


def identify_material(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Fit material numbers to the training recordings by L-BFGS-B within bounds, from several starts.

    The search begins at the datasets' assumed material and at softer and stiffer ones, with the recordings' first
    frames; the best goes on with more and more of them. `parameters.csv` in the run says how sure each number is and
    which trade off against one another. What a killed run had tried is read from its checkpoint and not simulated
    again.

    Raises:
        InputError: no recording to train on.
        SimulationError: the assumed material itself cannot be simulated.
    """
    search = _Search(datasets, settings, run, report)
    starts = search.begins()
    for share in SHARES:
        search.see(share)
        starts = [min((search.descend(start, ROUNDS) for start in starts), key=lambda result: result[0])[1]]
    search.see(1.0)
    _, found = search.descend(starts[0], max(settings.epochs - ROUNDS * len(SHARES), 1))
    model = search.model(found)
    save_model(run, model)
    write_text(run / "parameters.csv", search.certainty(found))
    return model


class _Search:
    """The objective, what it has been asked so far, and the history."""

    def __init__(self, datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> None:
        cut = prepared(datasets, settings)
        self.train, self.validate = batches(training_items(cut), settings.by_sigma), validation_batches(cut)
        self.quantities, self.settings, self.run, self.report = SOUGHT[settings.method], settings, run, report
        self.simulator = cut[0].simulator
        self.frames = 0  # that are simulated
        self.history: list[dict[str, float]] = []
        self.known: dict[tuple[float, ...], tuple[float, list[float]]] = {}  # by frames and variables
        self.file = run / "checkpoint.pt"
        if self.file.exists():
            saved = load_tensors(self.file, "a checkpoint of this run")
            with understood("what was tried", self.file):
                self.known = {tuple(asked): (loss, slope) for asked, loss, slope in saved["known"]}

    def see(self, share: float) -> None:
        """Simulate a share of the frames from now on."""
        longest = max(len(recordings.markers) for recordings in self.train)
        self.frames = min(max(int(share * longest), LEAST_FRAMES), longest)

    def begins(self) -> list[Array]:
        """Where to begin: the assumed material first."""
        assumed = {q: max(float(getattr(self.simulator.material, q.name)), q.low) for q in self.quantities}
        own = np.array([np.clip(q.variable(value), *q.bounds) for q, value in assumed.items()])
        if self.settings.method == "sysid-damping":
            own[2] = max(own[2], VISCOSITY.variable(VISCOSITY.usual))
        result = [own]
        for factor in STARTS:
            other = own.copy()
            other[0] = np.clip(own[0] + np.log(factor), *MODULUS.bounds)
            result.append(other)
        return result

    def values(self, x: Any) -> dict[str, Any]:
        """Parameters by name, of variables."""
        found = {q.name: q.value(x[k]) for k, q in enumerate(self.quantities)}
        return {"poissons_ratio": NEARLY_INCOMPRESSIBLE, **found} if len(found) == 1 else found

    def model(self, x: Array) -> FittedModel:
        """With the material of variables x."""
        material = {name: float(value) for name, value in self.values(x).items()}
        return FittedModel(self.settings.method, material=material, stepping=self.simulator.stepping)

    def __call__(self, x: Array) -> tuple[float, Array]:
        """Loss and its gradient; a high wall where a simulation fails, so that the line search comes back."""
        try:
            loss, slope = self._asked(x)
        except SimulationError:
            if not self.known:
                raise
            return WALL, np.zeros(len(x))
        return loss, np.array(slope)

    def _asked(self, x: Array) -> tuple[float, list[float]]:
        """Loss and its gradient, simulated where they are not known yet."""
        key = (float(self.frames), *(float(value) for value in x))
        if key not in self.known:
            self.known[key] = self._simulate(x)
            content = [[list(asked), loss, slope] for asked, (loss, slope) in self.known.items()]
            save_tensors(self.file, {"format": FORMAT, "method": self.settings.method, "known": content})
        return self.known[key]

    def _simulate(self, x: Array) -> tuple[float, list[float]]:
        variables = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        values = self.values(variables)
        count = sum(len(recordings.names) for recordings in self.train)
        total = torch.zeros((), dtype=torch.float64)
        for recordings in (each.first(self.frames) for each in self.train):
            simulated, forces = recordings.simulate(parameters=recordings.dataset.simulator.parameters(**values))
            total = total + training_loss(recordings, simulated, forces) * len(recordings.names) / count
        total.backward()
        assert variables.grad is not None
        return total.item(), variables.grad.tolist()

    def descend(self, start: Array, iterations: int) -> tuple[float, Array]:
        """L-BFGS-B from a start; the loss reached, and where."""
        scale = max(self(start)[0], TINY)

        def relative(y: Array) -> tuple[float, Array]:
            loss, slope = self(y * STRIDE)
            return loss / scale, slope * STRIDE / scale

        if not self.history:
            self.record(start, 0)
        found = minimize(
            relative,
            start / STRIDE,
            jac=True,
            method="L-BFGS-B",
            bounds=[(q.bounds[0] / STRIDE, q.bounds[1] / STRIDE) for q in self.quantities],
            callback=lambda y: self.record(y * STRIDE, int(self.history[-1]["epoch"]) + 1),
            options={"maxiter": iterations, "ftol": 1e-9, "gtol": 1e-8},
        )
        return scale * float(found.fun), found.x * STRIDE

    def record(self, x: Array, number: int) -> None:
        """A row of the history."""
        model = self.model(x)
        assert model.material is not None
        error = 1e3 * mean_error(self.validate, model)
        self.history.append({"epoch": number, "loss": self(x)[0], "validation_mm": error, **model.material})
        write_history(self.run, self.history)
        self.report(self.history[-1])

    def certainty(self, x: Array) -> str:
        """As CSV: each value with its 95 % interval, and how they trade off against one another.

        Markers' errors are taken as independent, of the size of what the fit leaves; the curvature of the loss then
        is the information. A number at its bound has no interval; none has one where a material beside the best
        cannot be simulated, or where the search ended short of a minimum.
        """
        inside = [k for k, q in enumerate(self.quantities) if q.bounds[0] + STEP < x[k] < q.bounds[1] - STEP]
        covariance = np.full((len(x), len(x)), np.nan)
        curvature = self._curvature(x, inside)
        if curvature is not None and np.linalg.eigvalsh(curvature)[0] > 0.0:
            seen = sum(float((recordings.weight[1:] > 0).sum()) for recordings in self.train)
            own = 2.0 * self(x)[0] / max(seen - len(x), 1.0) * np.linalg.pinv(curvature)
            covariance[np.ix_(inside, inside)] = own
        sigma = np.sqrt(np.diag(covariance))
        names = [q.name for q in self.quantities]
        lines = ["name,unit,value,low_95,high_95," + ",".join(f"correlation_{name}" for name in names)]
        for k, q in enumerate(self.quantities):
            ends = sorted(float(q.value(x[k] + sign * NORMAL * sigma[k])) for sign in (-1.0, 1.0))
            signs = [1.0 if item.kind != "gap" else -1.0 for item in self.quantities]
            correlation = [signs[k] * signs[j] * covariance[k, j] / (sigma[k] * sigma[j]) for j in range(len(x))]
            cells = [float(q.value(x[k])), *ends, *correlation]
            lines.append(f"{q.name},{q.unit}," + ",".join("" if np.isnan(cell) else f"{cell:.6g}" for cell in cells))
        return "\n".join(lines) + "\n"

    def _curvature(self, x: Array, chosen: list[int]) -> Array | None:
        """Second derivatives of the loss by the chosen variables; None of none, or where a simulation fails."""
        columns = []
        for k in chosen:
            h = STEP * np.eye(len(x))[k]
            try:
                ahead, behind = (np.array(self._asked(place)[1]) for place in (x + h, x - h))
            except SimulationError:
                return None
            columns.append((ahead - behind)[chosen] / (2.0 * STEP))
        return 0.5 * (np.array(columns) + np.array(columns).T) if columns else None


def spoken(table: pd.DataFrame) -> list[str]:
    """What `parameters.csv`, read as a data frame, says, in sentences."""
    lines = []
    for row in table.to_dict("records"):
        unit = f" {row['unit']}" if isinstance(row["unit"], str) else ""
        interval = f"95 % interval {row['low_95']:.5g} to {row['high_95']:.5g}"
        interval = (
            interval
            if np.isfinite(row["low_95"])
            else "no interval: at its bound, short of the best fit, or beside a material that cannot be simulated"
        )
        lines.append(f"{row['name']} = {row['value']:.5g}{unit} ({interval})")
    for a, b in itertools.combinations(range(len(table)), 2):
        c = float(table[f"correlation_{table['name'][b]}"][a])
        if abs(c) > 0.9:
            lines.append(
                f"{table['name'][a]} and {table['name'][b]} trade off against one another (correlation {c:+.3f}): the "
                "recordings tell them apart poorly"
            )
    return lines
