"""System identification by exact gradients (paper, SysID baseline): E, nu, viscosity, loss factor, Maxwell branches."""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, loss_curvature, training_loss
from rafl.fem.maxwell import branch_shares, branch_times
from rafl.fitting.run_folder import (
    FORMAT,
    FittedModel,
    Settings,
    expect_content,
    load_tensors,
    save_model,
    save_tensors,
    write_history,
)
from rafl.fitting.train_field import (
    Report,
    batches_by_dataset,
    mean_error,
    prepare_datasets,
    training_items,
    validation_batches,
)
from rafl.simulation.rollout import rollout

Array = NDArray[Any]

FIXED_POISSONS_RATIO = 0.499  # nearly incompressible; where only E is identified, as in the paper
START_FACTORS = (0.6, 1.7)  # times the assumed E: further starting points
# Each early stage of the search simulates a fraction of the frames, and a minimum number. Over many oscillations the
# loss has other minima, where the simulation is whole oscillations ahead or behind.
FRAME_FRACTIONS = (0.15, 0.4)
MIN_FRAMES = 8
ITERATIONS_PER_STAGE = 3
NORMAL_QUANTILE_95 = 1.959964  # a normal distribution has 95 % within this many sigmas
FAILURE_LOSS = 1e6  # loss where a simulation fails
MIN_LOSS = 1e-30  # smallest divisor, for a loss of zero
DIFFERENCE_STEP = 1e-4  # of a variable, for the derivatives of the markers in the Gauss-Newton matrix
MIN_RELATIVE_CURVATURE = 1e-12  # of the Gauss-Newton matrix; directions of less are taken as undetermined
# Largest decrease of the loss that Newton's method still expects where a search ended at a minimum, relative to it.
MAX_EXPECTED_DECREASE = 1e-3
MIN_REPORTED_CORRELATION = 0.9


@dataclass(frozen=True)
class Quantity:
    """A parameter to identify, and the transformed variable in which the search is evenly scaled.

    Attributes:
        name: in `rafl.simulation.parameters.Parameters`, `tan_delta`, or `branch_share_1` and so on.
        low, high: bounds.
        kind: the variable is, for a value p, `log`: log p; `gap`: log (1/2 - p); `linear`: p / scale.
        unit: for messages.
        scale: of `linear`, in the unit of the value.
        start: value to start from if the assumed material has none, or less.
    """

    name: str
    low: float
    high: float
    kind: str
    unit: str
    scale: float = 1.0
    start: float = 0.0

    def variable(self, value: float) -> float:
        """The variable of a value."""
        if self.kind == "log":
            return float(np.log(value))
        return float(np.log(0.5 - value)) if self.kind == "gap" else value / self.scale

    def value(self, variable: Any) -> Any:
        """The value of a variable, a float or a tensor."""
        exp = torch.exp if isinstance(variable, Tensor) else np.exp
        if self.kind == "log":
            return exp(variable)
        return 0.5 - exp(variable) if self.kind == "gap" else self.scale * variable

    @property
    def bounds(self) -> tuple[float, float]:
        """Lower and upper bound of the variable."""
        a, b = self.variable(self.low), self.variable(self.high)
        return min(a, b), max(a, b)


MODULUS = Quantity("youngs_modulus", 2e4, 1e7, "log", "Pa")
POISSON = Quantity("poissons_ratio", 0.3, 0.4995, "gap", "")
VISCOSITY = Quantity("viscosity", 0.0, 1e4, "linear", "Pa s", scale=100.0, start=100.0)
LOSS_FACTOR = Quantity("tan_delta", 0.0, 0.5, "linear", "", scale=0.1, start=0.1)
LOSS_FREQUENCIES = (0.5, 50.0)  # [Hz]; from the slowest swings of large specimens to half of 100 frames/s
BRANCH_TIMES = branch_times(*LOSS_FREQUENCIES)  # [s]
SHARES = tuple(
    Quantity(f"branch_share_{k + 1}", 0.0, 1.0, "linear", "", scale=0.1, start=0.05) for k in range(len(BRANCH_TIMES))
)
METHOD_QUANTITIES = {
    "sysid": (MODULUS, POISSON),
    "sysid-e": (MODULUS,),
    "sysid-damping": (MODULUS, POISSON, VISCOSITY),
    "sysid-loss": (MODULUS, POISSON, LOSS_FACTOR),
    "sysid-branches": (MODULUS, POISSON, VISCOSITY, *SHARES),
}


def material_values(identified: dict[str, Any]) -> dict[str, Any]:
    """Values by their name in `rafl.simulation.parameters.Parameters` from those of quantities.

    Values of quantities are floats or tensors (..); shares of K branches are (.., K).
    """
    values = {"poissons_ratio": FIXED_POISSONS_RATIO, **identified}
    tan_delta = values.pop(LOSS_FACTOR.name, None)
    shares = [values.pop(share.name) for share in SHARES if share.name in values]
    if tan_delta is not None:
        values["branch_shares"] = branch_shares(torch.as_tensor(tan_delta, dtype=torch.float64), *LOSS_FREQUENCIES)
    elif shares:
        values["branch_shares"] = torch.stack([torch.as_tensor(share, dtype=torch.float64) for share in shares], dim=-1)
    if "branch_shares" in values:
        values["branch_times"] = torch.tensor(BRANCH_TIMES, dtype=torch.float64)
    return values


def identify_material(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Fit material parameters to the training recordings by least squares within bounds, from several starting points.

    Gradients are exact; the Gauss-Newton matrix is from differences of simulations that run as one batch.

    The search starts from the datasets' assumed material and from a softer and a stiffer one, on the first frames of
    the recordings. The best result continues with more frames, and finally with all. `parameters.csv` in the run
    holds the values, their 95 % intervals and their correlations. A resumed run reads earlier simulations from its
    checkpoint and does not repeat them.

    Raises:
        InputError: no training recordings.
        SimulationError: the assumed material itself cannot be simulated.
    """
    search = _Search(datasets, settings, run, report)
    points = search.starting_points()
    for fraction in FRAME_FRACTIONS:
        search.use_frames(fraction)
        results = (search.descend(point, ITERATIONS_PER_STAGE) for point in points)
        points = [min(results, key=lambda result: result[0])[1]]
    search.use_frames(1.0)
    _, best = search.descend(points[0], max(settings.epochs - ITERATIONS_PER_STAGE * len(FRAME_FRACTIONS), 1))
    model = search.model(best)
    save_model(run, model)
    write_text(run / "parameters.csv", search.parameter_table(best))
    return model


class _Search:
    """The objective, its evaluations so far, and the history."""

    def __init__(self, datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> None:
        used = prepare_datasets(datasets, settings)
        self.training = batches_by_dataset(training_items(used), settings.by_sigma)
        self.validation = validation_batches(used)
        self.quantities = METHOD_QUANTITIES[settings.method]
        self.settings, self.run, self.report = settings, run, report
        self.simulator = used[0].simulator
        self.frames = 0  # number of frames to simulate
        self.history: list[dict[str, float]] = []
        self.evaluations: dict[tuple[float, ...], Evaluation] = {}  # by frames and variables
        self.checkpoint = run / "checkpoint.pt"
        if self.checkpoint.exists():
            saved = load_tensors(self.checkpoint, "a checkpoint of this run")
            with expect_content("a checkpoint of this version", self.checkpoint):
                self.evaluations = {tuple(key): Evaluation(*values) for key, *values in saved["known"]}

    def use_frames(self, fraction: float) -> None:
        """Set the fraction of the frames that is simulated."""
        longest = max(len(recordings.markers) for recordings in self.training)
        self.frames = min(max(int(fraction * longest), MIN_FRAMES), longest)

    def starting_points(self) -> list[Array]:
        """Variables to start from; those of the assumed material come first."""
        assumed = [max(float(getattr(self.simulator.material, q.name, 0.0)), q.low, q.start) for q in self.quantities]
        own = np.array([np.clip(q.variable(x), *q.bounds) for q, x in zip(self.quantities, assumed, strict=True)])
        points = [own]
        for factor in START_FACTORS:
            other = own.copy()
            other[0] = np.clip(own[0] + np.log(factor), *MODULUS.bounds)
            points.append(other)
        return points

    def identified(self, x: Any) -> dict[str, Any]:
        """Values of the quantities, by name, of variables x."""
        return {q.name: q.value(x[k]) for k, q in enumerate(self.quantities)}

    def model(self, x: Array) -> FittedModel:
        """The model with the material of variables x."""
        values = material_values(self.identified(x))
        material = {
            name: value.tolist() if isinstance(value, Tensor) else float(value) for name, value in values.items()
        }
        return FittedModel(self.settings.method, material=material, time_integration=self.simulator.time_integration)

    def evaluate(self, x: Array) -> "Evaluation":
        """The loss at variables x, from the checkpoint or else simulated; very high where a simulation fails."""
        key = (float(self.frames), *(float(value) for value in x))
        if key not in self.evaluations:
            try:
                self.evaluations[key] = self._simulate(x)
            except SimulationError:
                if not self.evaluations:
                    raise
                return Evaluation(FAILURE_LOSS, [0.0] * len(x), np.eye(len(x)).tolist())
            content = [[list(each), *vars(known).values()] for each, known in self.evaluations.items()]
            save_tensors(self.checkpoint, {"format": FORMAT, "method": self.settings.method, "known": content})
        return self.evaluations[key]

    def _simulate(self, x: Array) -> "Evaluation":
        count = sum(len(recordings.names) for recordings in self.training)
        variables = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        total = torch.zeros((), dtype=torch.float64)
        matrix = np.zeros((len(x), len(x)))
        for recordings in (each.first_frames(self.frames) for each in self.training):
            values = material_values(self.identified(variables))
            simulated, forces = recordings.simulate(parameters=recordings.dataset.simulator.parameters(**values))
            share = len(recordings.names) / count
            total = total + training_loss(recordings, simulated, forces) * share
            matrix += share * self._gauss_newton_matrix(x, recordings, simulated.detach())
        torch.autograd.backward(total)
        assert variables.grad is not None
        return Evaluation(total.item(), variables.grad.tolist(), matrix.tolist())

    def _gauss_newton_matrix(self, x: Array, recordings: Recordings, simulated: Tensor) -> Array:
        """Second derivatives of the loss, without those of the markers, (n, n); all differences in one batch."""
        changed = torch.from_numpy(x + DIFFERENCE_STEP * np.eye(len(x)))
        values = material_values(self.identified(changed.T))
        batch = len(recordings.names)
        # Every parameter set with every recording: (n) or (n, K) becomes (n batch) or (n batch, K).
        shared = ("branch_times", *(("poissons_ratio",) if POISSON not in self.quantities else ()))
        parameters = {key: x.repeat_interleave(batch, 0) for key, x in values.items() if key not in shared}
        simulator = recordings.dataset.simulator
        start = recordings.dataset.start(recordings.names * len(x))
        with torch.no_grad():
            positions, _ = rollout(
                simulator, start, len(recordings.markers) - 1, parameters=simulator.parameters(**(values | parameters))
            )
            markers = recordings.dataset.markers.positions(positions)
        shape = (len(markers), len(x), batch, *markers.shape[2:])
        slope = (markers.reshape(shape) - simulated[:, None]) / DIFFERENCE_STEP
        return loss_curvature(recordings, slope).numpy()

    def descend(self, start: Array, evaluations: int) -> tuple[float, Array]:
        """Minimise by trust-region least squares within bounds from a starting point; the loss and the variables."""
        if not self.history:
            self.record(start, 0)

        def slopes(x: Array) -> Array:
            if (x != start).any():  # called where a step was accepted
                self.record(x, int(self.history[-1]["epoch"]) + 1)
            return self.evaluate(x).equivalent_residuals[1]

        lows, highs = zip(*(q.bounds for q in self.quantities), strict=True)
        result = least_squares(
            lambda x: self.evaluate(x).equivalent_residuals[0],
            start,
            slopes,
            bounds=(lows, highs),
            x_scale="jac",
            ftol=1e-9,
            xtol=1e-7,
            gtol=1e-12,
            max_nfev=evaluations,
        )
        return self.evaluate(result.x).loss, result.x

    def record(self, x: Array, number: int) -> None:
        """Append a row to the history, write it and report it."""
        error = 1e3 * mean_error(self.validation, self.model(x))
        values = {"poissons_ratio": FIXED_POISSONS_RATIO, **{k: float(v) for k, v in self.identified(x).items()}}
        self.history.append({"epoch": number, "loss": self.evaluate(x).loss, "validation_mm": error, **values})
        write_history(self.run, self.history)
        self.report(self.history[-1])

    def parameter_table(self, x: Array) -> str:
        """CSV text with each value, its 95 % interval and its correlations with the others.

        Marker errors are assumed independent and as large as the residuals of the fit; the Gauss-Newton matrix then
        gives the information matrix. A value at its bound has no interval. No value has one if the search ended before
        a minimum.
        """
        lows, highs = (np.array(ends) for ends in zip(*(q.bounds for q in self.quantities), strict=True))
        margin = 1e-3 * (highs - lows)
        inside = np.flatnonzero((lows + margin < x) & (x < highs - margin))
        covariance = np.full((len(x), len(x)), np.nan)
        found = self.evaluate(x)
        matrix, gradient = np.array(found.curvature)[np.ix_(inside, inside)], np.array(found.gradient)[inside]
        if len(inside) and np.linalg.eigvalsh(matrix)[0] > MIN_RELATIVE_CURVATURE * np.trace(matrix):
            inverse = np.linalg.inv(matrix)
            if gradient @ inverse @ gradient <= 2.0 * MAX_EXPECTED_DECREASE * found.loss:
                observed = sum(float((recordings.weight[1:] > 0).sum()) for recordings in self.training)
                covariance[np.ix_(inside, inside)] = 2.0 * found.loss / max(observed - len(x), 1.0) * inverse
        sigma = np.sqrt(np.diag(covariance))
        names = [q.name for q in self.quantities]
        lines = ["name,unit,value,low_95,high_95," + ",".join(f"correlation_{name}" for name in names)]
        for k, q in enumerate(self.quantities):
            ends = sorted(float(q.value(x[k] + sign * NORMAL_QUANTILE_95 * sigma[k])) for sign in (-1.0, 1.0))
            signs = [1.0 if item.kind != "gap" else -1.0 for item in self.quantities]
            correlation = [signs[k] * signs[j] * covariance[k, j] / (sigma[k] * sigma[j]) for j in range(len(x))]
            cells = [float(q.value(x[k])), *ends, *correlation]
            lines.append(f"{q.name},{q.unit}," + ",".join("" if np.isnan(cell) else f"{cell:.6g}" for cell in cells))
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Evaluation:
    """The loss at some variables (n).

    Attributes:
        loss: see `rafl.data.objective.training_loss`.
        gradient: exact, (n).
        curvature: Gauss-Newton matrix, (n, n).
    """

    loss: float
    gradient: list[float]
    curvature: list[list[float]]

    @property
    def equivalent_residuals(self) -> tuple[Array, Array]:
        """Residuals r (n + 1) and slopes J (n + 1, n) with r^2 / 2 = loss, J^T r = gradient and J^T J = curvature."""
        values, vectors = np.linalg.eigh(np.array(self.curvature))
        roots = np.sqrt(np.maximum(values, MIN_RELATIVE_CURVATURE * max(values[-1], MIN_LOSS)))
        along = vectors.T @ np.array(self.gradient) / roots
        # Rounding and the differences may leave less loss than the gradient implies.
        along *= min(1.0, np.sqrt(2.0 * self.loss / max(along @ along, MIN_LOSS)))
        rest = np.sqrt(max(2.0 * self.loss - along @ along, 0.0))
        return np.append(along, rest), np.vstack([roots[:, None] * vectors.T, np.zeros(len(roots))])


def parameter_sentences(table: pd.DataFrame) -> list[str]:
    """Sentences about the identified parameters; `table` is `parameters.csv`, read as a data frame."""
    lines = []
    for row in table.to_dict("records"):
        unit = f" {row['unit']}" if isinstance(row["unit"], str) else ""
        interval = f"95 % interval {row['low_95']:.5g} to {row['high_95']:.5g}"
        if not np.isfinite(row["low_95"]):
            interval = "no interval: the value is at its bound, or the search ended before a minimum"
        lines.append(f"{row['name']} = {row['value']:.5g}{unit} ({interval})")
    for a, b in itertools.combinations(range(len(table)), 2):
        c = float(table[f"correlation_{table['name'][b]}"][a])
        if abs(c) > MIN_REPORTED_CORRELATION:
            lines.append(
                f"{table['name'][a]} and {table['name'][b]} are correlated ({c:+.3f}): the recordings hardly "
                "distinguish them"
            )
    return lines
