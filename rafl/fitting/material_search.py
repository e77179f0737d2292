"""The search for a material: the loss, its exact gradient and its Gauss-Newton matrix, minimised within bounds."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, frame_errors, loss_curvature, recording_losses
from rafl.fitting.quantities import FIXED_POISSONS_RATIO, MODULUS, POISSON, Quantity, material_values
from rafl.fitting.run_folder import (
    FORMAT,
    FittedModel,
    Settings,
    expect_content,
    load_tensors,
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
from rafl.simulation.parameters import Parameters
from rafl.simulation.rollout import rollout

Array = NDArray[Any]

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
# The Gauss-Newton matrix is that of a few recordings: of the least, the largest and medium motion. It is computed again
# where a variable has moved by more than `CURVATURE_RANGE`, since it changes slowly; the gradient is always exact.
CURVATURE_RECORDINGS = 3
CURVATURE_RANGE = 0.25
MIN_RELATIVE_CURVATURE = 1e-12  # of the Gauss-Newton matrix; directions of less are taken as undetermined
# Largest decrease of the loss that Newton's method still expects where a search ended at a minimum, relative to it.
MAX_EXPECTED_DECREASE = 1e-3


@dataclass(frozen=True)
class Evaluation:
    """The loss at some variables (n), for R training recordings.

    Attributes:
        losses: of every recording, see `rafl.data.objective.recording_losses`, (R).
        gradients: of every recording's loss, exact, (R, n).
        curvature: Gauss-Newton matrix of the mean loss, (n, n).
        curvature_at: variables where the matrix was computed, (n).
        prior: loss, gradient (n) and curvature (n), a diagonal, that the prior adds.
    """

    losses: list[float]
    gradients: list[list[float]]
    curvature: list[list[float]]
    curvature_at: list[float]
    prior: tuple[float, list[float], list[float]] = (0.0, [], [])

    @property
    def loss(self) -> float:
        """Mean loss of the recordings, and the prior's."""
        return float(np.mean(self.losses)) + self.prior[0]

    @property
    def gradient(self) -> Array:
        """Of the loss, (n)."""
        mean: Array = np.mean(self.gradients, axis=0)
        return mean + np.array(self.prior[1]) if self.prior[1] else mean

    @property
    def matrix(self) -> Array:
        """Gauss-Newton matrix of the loss, prior included, (n, n)."""
        own = np.array(self.curvature)
        return own + np.diag(self.prior[2]) if self.prior[2] else own

    @property
    def equivalent_residuals(self) -> tuple[Array, Array]:
        """Residuals r (n + 1) and slopes J (n + 1, n) with r^2 / 2 = loss, J^T r = gradient and J^T J = matrix."""
        values, vectors = np.linalg.eigh(self.matrix)
        roots = np.sqrt(np.maximum(values, MIN_RELATIVE_CURVATURE * max(values[-1], MIN_LOSS)))
        along = vectors.T @ self.gradient / roots
        # Rounding and the differences may leave less loss than the gradient implies.
        along *= min(1.0, np.sqrt(2.0 * self.loss / max(along @ along, MIN_LOSS)))
        rest = np.sqrt(max(2.0 * self.loss - along @ along, 0.0))
        return np.append(along, rest), np.vstack([roots[:, None] * vectors.T, np.zeros(len(roots))])


@dataclass
class History:
    """The rows of `history.csv` of a run, over all its searches."""

    run: Path
    report: Report
    rows: list[dict[str, float]] = field(default_factory=list)

    def append(self, row: dict[str, float]) -> None:
        """Append a row, write the file and report the row."""
        self.rows.append({"epoch": len(self.rows), **row})
        write_history(self.run, self.rows)
        self.report(self.rows[-1])


class MaterialSearch:
    """The objective over some quantities, its evaluations so far, and the history.

    Args:
        datasets: with the training recordings.
        settings: of the fit.
        quantities: to search for.
        history: of the run.
        checkpoint: file of earlier evaluations, which are not repeated.
        prior_weight: of the prior of learned quantities in the loss, see `prior`.
    """

    def __init__(
        self,
        datasets: list[Dataset],
        settings: Settings,
        quantities: tuple[Quantity, ...],
        history: History,
        checkpoint: Path,
        prior_weight: float = 0.0,
    ) -> None:
        used = prepare_datasets(datasets, settings)
        self.training = batches_by_dataset(training_items(used), settings.by_sigma)
        self.validation = validation_batches(used)
        self.quantities, self.settings, self.history = quantities, settings, history
        self.prior_weight = prior_weight
        self.simulator = used[0].simulator
        self.frames = 0  # number of frames to simulate
        self.evaluations: dict[tuple[float, ...], Evaluation] = {}  # by frames and variables
        self._latest: tuple[int, Evaluation] | None = None  # frames and evaluation whose matrix may serve again
        self.checkpoint = checkpoint
        if checkpoint.exists():
            saved = load_tensors(checkpoint, "a checkpoint of this run")
            with expect_content("a checkpoint of this version", checkpoint):
                self.evaluations = {tuple(key): Evaluation(*values) for key, *values in saved["known"]}

    @property
    def recording_names(self) -> list[str]:
        """Names of the training recordings, in the order of `Evaluation.losses`."""
        return [name for recordings in self.training for name in recordings.names]

    def use_frames(self, fraction: float) -> None:
        """Set the fraction of the frames that is simulated."""
        longest = max(len(recordings.markers) for recordings in self.training)
        self.frames = min(max(int(fraction * longest), MIN_FRAMES), longest)

    def solve(self) -> Array:
        """The best variables, from several starting points: first by the leading frames, finally by all."""
        points = self.starting_points()
        for fraction in FRAME_FRACTIONS:
            self.use_frames(fraction)
            results = (self.descend(point, ITERATIONS_PER_STAGE) for point in points)
            points = [min(results, key=lambda result: result[0])[1]]
        self.use_frames(1.0)
        return self.descend(points[0], max(self.settings.epochs - ITERATIONS_PER_STAGE * len(FRAME_FRACTIONS), 1))[1]

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

    def parameters(self, x: Tensor, recordings: Recordings) -> Parameters:
        """Parameters of variables x (n) or, by trajectory, (n, B)."""
        return recordings.dataset.simulator.parameters(**material_values(self.identified(x)))

    def model(self, x: Array) -> FittedModel:
        """The model with the material of variables x."""
        values = material_values(self.identified(x))
        material = {
            name: value.tolist() if isinstance(value, Tensor) else float(value) for name, value in values.items()
        }
        return FittedModel(self.settings.method, material=material, time_integration=self.simulator.time_integration)

    def evaluate(self, x: Array) -> Evaluation:
        """The loss at variables x, from the checkpoint or else simulated; very high where a simulation fails."""
        key = (float(self.frames), *(float(value) for value in x))
        if key not in self.evaluations:
            try:
                self.evaluations[key] = self._simulate(x)
            except SimulationError:
                if not self.evaluations:
                    raise
                n, count = len(x), len(self.recording_names)
                return Evaluation([FAILURE_LOSS] * count, [[0.0] * n] * count, np.eye(n).tolist(), x.tolist())
            content = [[list(each), *vars(known).values()] for each, known in self.evaluations.items()]
            save_tensors(self.checkpoint, {"format": FORMAT, "method": self.settings.method, "known": content})
        self._latest = self.frames, self.evaluations[key]
        return self.evaluations[key]

    def _simulate(self, x: Array) -> Evaluation:
        losses: list[float] = []
        gradients: list[list[float]] = []
        positions: list[Tensor] = []
        cut = [recordings.first_frames(self.frames) for recordings in self.training]
        for recordings in cut:
            variables = torch.tensor(x, dtype=torch.float64)[:, None].repeat(1, len(recordings.names)).requires_grad_()
            simulated, _ = recordings.simulate(parameters=self.parameters(variables, recordings))
            own = recording_losses(recordings, simulated)
            torch.autograd.backward(own.sum())
            assert variables.grad is not None
            losses += own.tolist()
            gradients += variables.grad.T.tolist()
            positions.append(simulated.detach())
        curvature, at = self._known_curvature(x)
        if curvature is None:
            share = max(CURVATURE_RECORDINGS // len(cut), 1)
            parts = [self._gauss_newton_matrix(x, each, q, share) for each, q in zip(cut, positions, strict=True)]
            weights = [len(recordings.names) for recordings in cut]
            curvature, at = np.average(parts, axis=0, weights=weights).tolist(), x.tolist()
        return Evaluation(losses, gradients, curvature, at, self.prior(x))

    def _known_curvature(self, x: Array) -> tuple[list[list[float]] | None, list[float]]:
        """The latest matrix and where it was computed, if that was near x with as many frames."""
        if self._latest is None or self._latest[0] != self.frames:
            return None, []
        known = self._latest[1]
        near = np.abs(x - np.array(known.curvature_at)).max() <= CURVATURE_RANGE
        return (known.curvature, known.curvature_at) if near else (None, [])

    def prior(self, x: Array) -> tuple[float, list[float], list[float]]:
        """Loss, gradient (n) and diagonal of the curvature (n) of the prior: prior_weight / 2 times the sum of squares
        of the learned quantities' variables."""
        if not self.prior_weight:
            return 0.0, [], []
        weight = self.prior_weight * np.array([float(quantity.learned) for quantity in self.quantities])
        return 0.5 * float(weight @ x**2), (weight * x).tolist(), weight.tolist()

    def _gauss_newton_matrix(self, x: Array, recordings: Recordings, simulated: Tensor, count: int) -> Array:
        """Mean over `count` recordings of the Gauss-Newton matrix (n, n); all differences are simulated as one batch.

        simulated: markers of all recordings at x, (T, B, M, 3).
        """
        chosen = _spread_by_motion(recordings, count)
        few = recordings.select(chosen)
        changed = torch.from_numpy(x + DIFFERENCE_STEP * np.eye(len(x)))  # (n, n), one set of variables a row
        batch = len(few.names)
        variables = changed.T.repeat_interleave(batch, dim=1)  # every set with every recording, (n, n batch)
        simulator, start = few.dataset.simulator, few.dataset.start(few.names * len(x))
        with torch.no_grad():
            parameters = self.parameters(variables, few)
            positions, _ = rollout(simulator, start, len(few.markers) - 1, parameters=parameters)
            markers = few.dataset.markers.positions(positions)
        shape = (len(markers), len(x), batch, *markers.shape[2:])
        slope = (markers.reshape(shape) - simulated[:, None, chosen]) / DIFFERENCE_STEP
        matrix: Array = loss_curvature(few, slope).numpy()
        return matrix

    def descend(self, start: Array, evaluations: int) -> tuple[float, Array]:
        """Minimise by trust-region least squares within bounds from a starting point; the loss and the variables."""
        if not self.history.rows:
            self.record(start)

        def slopes(x: Array) -> Array:
            if (x != start).any():  # called where a step was accepted
                self.record(x)
            return self.evaluate(x).equivalent_residuals[1]

        lows, highs = self.bounds
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

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the variables, (n) each."""
        lows, highs = zip(*(q.bounds for q in self.quantities), strict=True)
        return np.array(lows), np.array(highs)

    def record(self, x: Array) -> None:
        """Append a row to the history."""
        error = 1e3 * mean_error(self.validation, self.model(x))
        shown = {q.name: float(q.value(x[k])) for k, q in enumerate(self.quantities) if not q.learned}
        if POISSON not in self.quantities:
            shown = {POISSON.name: FIXED_POISSONS_RATIO, **shown}
        self.history.append({"loss": self.evaluate(x).loss, "validation_mm": error, **shown})

    def inside(self, x: Array) -> NDArray[np.int64]:
        """Indices of the variables that are not at a bound."""
        lows, highs = self.bounds
        margin = 1e-3 * (highs - lows)
        return np.flatnonzero((lows + margin < x) & (x < highs - margin))

    def covariance(self, x: Array) -> Array:
        """Covariance of the variables at a minimum x, (n, n); NaN where a variable is at its bound, or at no minimum.

        Marker errors are assumed independent and as large as the residuals of the fit; the Gauss-Newton matrix then
        gives the information matrix.
        """
        inside = self.inside(x)
        covariance = np.full((len(x), len(x)), np.nan)
        found = self.evaluate(x)
        matrix, gradient = found.matrix[np.ix_(inside, inside)], found.gradient[inside]
        if len(inside) and np.linalg.eigvalsh(matrix)[0] > MIN_RELATIVE_CURVATURE * np.trace(matrix):
            inverse = np.linalg.inv(matrix)
            if gradient @ inverse @ gradient <= 2.0 * MAX_EXPECTED_DECREASE * found.loss:
                observed = sum(float((recordings.weight[1:] > 0).sum()) for recordings in self.training)
                covariance[np.ix_(inside, inside)] = 2.0 * found.loss / max(observed - len(x), 1.0) * inverse
        return covariance

    def parameter_table(self, x: Array) -> str:
        """CSV text with each value, its 95 % interval and its correlations with the others; learned weights last.

        A value at its bound has no interval. No value has one if the search ended before a minimum.
        """
        covariance = self.covariance(x)
        sigma = np.sqrt(np.diag(covariance))
        names = [q.name for q in self.quantities]
        lines = ["name,unit,value,low_95,high_95," + ",".join(f"correlation_{name}" for name in names)]
        signs = [1.0 if item.kind != "gap" else -1.0 for item in self.quantities]
        for k, q in enumerate(self.quantities):
            ends = sorted(float(q.value(x[k] + sign * NORMAL_QUANTILE_95 * sigma[k])) for sign in (-1.0, 1.0))
            correlation = [signs[k] * signs[j] * covariance[k, j] / (sigma[k] * sigma[j]) for j in range(len(x))]
            cells = [float(q.value(x[k])), *ends, *correlation]
            lines.append(f"{q.name},{q.unit}," + ",".join("" if np.isnan(cell) else f"{cell:.6g}" for cell in cells))
        return "\n".join(lines) + "\n"

    def left_out_errors(self, x: Array, groups: list[list[int]]) -> list[float]:
        """Mean marker error [m] of every group of training recordings, predicted without it; x is a minimum of all.

        groups: indices into `recording_names`. A group's variables are those after one Gauss-Newton step towards the
        minimum of the other recordings, within the bounds.
        """
        found, count = self.evaluate(x), len(self.recording_names)
        gradients, inside = np.array(found.gradients), self.inside(x)
        lows, highs = self.bounds
        variables = np.repeat(x[:, None], count, axis=1)
        prior = np.array(found.prior[2]) if found.prior[2] else np.zeros(len(x))
        for group in groups:
            left = 1.0 - len(group) / count
            matrix = left * np.array(found.curvature) + np.diag(prior)
            scale = np.sqrt(np.maximum(np.diag(matrix), MIN_LOSS))
            matrix += np.diag(MIN_RELATIVE_CURVATURE * scale**2)
            slope = found.gradient - gradients[group].sum(0) / count
            moved = x.copy()
            moved[inside] -= np.linalg.solve(matrix[np.ix_(inside, inside)], slope[inside])
            variables[:, group] = np.clip(moved, lows, highs)[:, None]
        errors = np.concatenate(self._errors(variables))
        return [float(errors[group].mean()) for group in groups]

    def _errors(self, variables: Array) -> list[Array]:
        """Mean error [m] of the training recordings of every dataset, with variables by recording (n, R)."""
        errors, first = [], 0
        for recordings in self.training:
            own = torch.from_numpy(np.ascontiguousarray(variables[:, first : first + len(recordings.names)]))
            first += len(recordings.names)
            with torch.no_grad():
                simulated, _ = recordings.simulate(parameters=self.parameters(own, recordings))
            errors.append(np.array([each.mean() for each in frame_errors(recordings, simulated)]))
        return errors


def _spread_by_motion(recordings: Recordings, count: int) -> list[int]:
    """Indices of `count` recordings at even ranks of the largest motion of a marker, the extremes included."""
    moved = torch.linalg.norm(recordings.markers - recordings.markers[0], dim=-1) * recordings.valid
    moved = (moved * recordings.valid[0]).amax((0, 2))
    order = torch.argsort(moved).tolist()
    ranks = np.unique(np.round(np.linspace(len(order) - 1, 0, min(count, len(order)))).astype(int))
    return sorted(order[rank] for rank in ranks)
