"""The search for a material: the loss, its exact gradient and its Gauss-Newton matrix, minimised within bounds."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.common.arrays import ArrayFormat, check_shape, check_values
from rafl.common.errors import SimulationError
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, frame_errors, loss_curvature, recording_losses
from rafl.fitting.gauss_newton import (
    EARLY,
    EXACT,
    MIN_RELATIVE_CURVATURE,
    Evaluation,
    Minimum,
    Prior,
    bounded_step,
    descend,
)
from rafl.fitting.quantities import FIXED_POISSONS_RATIO, POISSON, Quantity, material_values
from rafl.fitting.run_folder import (
    FORMAT,
    FittedModel,
    History,
    Settings,
    expect_content,
    load_tensors,
    save_tensors,
)
from rafl.fitting.train_field import (
    batches_by_dataset,
    mean_error,
    prepare_datasets,
    training_items,
    validation_batches,
)
from rafl.simulation.parameters import Parameters
from rafl.simulation.rollout import rollout

Array = NDArray[Any]

START_FACTORS = (1.0, 0.6, 1.7)  # times the assumed E
# Further starting points have this Poisson's ratio, that of nearly incompressible rubber: where elements lock, the loss
# may have a minimum on either side.
START_POISSONS_RATIO = 0.499
# Each early stage of the search simulates a fraction of the frames, and a minimum number. Over many oscillations the
# loss has other minima, where the simulation is whole oscillations ahead or behind.
FRAME_FRACTIONS = (0.15, 0.4)
MIN_FRAMES = 8
EVALUATIONS_PER_STAGE = 4
NORMAL_QUANTILE_95 = 1.959964  # a normal distribution has 95 % within this many sigmas
FAILURE_LOSS = 1e6  # loss where a simulation fails
DIFFERENCE_STEP = 1e-4  # of a variable, for the derivatives of the markers in the Gauss-Newton matrix
# The Gauss-Newton matrix is that of up to so many recordings, from the largest to the least motion, and of so many
# simulations at most, as long as one recording remains.
CURVATURE_RECORDINGS, CURVATURE_SIMULATIONS = 3, 24


class MaterialSearch:
    """The objective over some quantities, its evaluations so far, and the history.

    Args:
        datasets: with the training recordings.
        settings: of the fit.
        quantities: to search for.
        history: of the run, with the processes that search together.
        checkpoint: file of earlier evaluations, which are not repeated.
        prior: of the variables; none by default.
    """

    def __init__(
        self,
        datasets: list[Dataset],
        settings: Settings,
        quantities: tuple[Quantity, ...],
        history: History,
        checkpoint: Path,
        prior: Prior | None = None,
    ) -> None:
        used = prepare_datasets(datasets, settings)
        self.training = batches_by_dataset(training_items(used), settings)
        self.validation = validation_batches(used)
        self.quantities, self.settings = quantities, settings
        self.history, self.group = history, history.group
        # A frame that was found through the assumed material moves with it, which the recordings' loss does not show.
        self.intervals_known = not any(dataset.registered_through_model for dataset in used)
        self.prior = prior or Prior.flat(len(quantities))
        self.simulator = used[0].simulator
        self.frames = 0  # number of frames to simulate
        self.checkpoint = checkpoint
        saved = self.group.on_main(self._read_checkpoint)
        self.evaluations = {tuple(key): Evaluation(*values) for key, *values in saved["known"]}
        self.curvatures = {tuple(key): np.array(value) for key, value in saved["curvatures"]}

    def _read_checkpoint(self) -> dict[str, list[list[Any]]]:
        """Evaluations (`known`) and Gauss-Newton matrices (`curvatures`), each after its frames and variables.

        Both are empty if there is no checkpoint yet.

        Raises:
            InputError: the file is damaged, or holds other contents.
        """
        if not self.checkpoint.exists():
            return {"known": [], "curvatures": []}
        saved = load_tensors(self.checkpoint, "a checkpoint of this run")
        count, size = len(self.recording_names), len(self.quantities)
        shapes = {"known": [(1 + size,), (count,), (count, size)], "curvatures": [(1 + size,), (size, size)]}
        with expect_content("a checkpoint of this version", self.checkpoint):
            return {
                name: [
                    [_numbers(part, shape).tolist() for part, shape in zip(item, own, strict=True)]
                    for item in saved[name]
                ]
                for name, own in shapes.items()
            }

    @property
    def recording_names(self) -> list[str]:
        """Names of the training recordings, in the order of `Evaluation.losses`."""
        return [name for recordings in self.training for name in recordings.names]

    def use_frames(self, fraction: float) -> None:
        """Set the fraction of the frames that is simulated."""
        longest = max(len(recordings.markers) for recordings in self.training)
        self.frames = min(max(int(fraction * longest), MIN_FRAMES), longest)

    def solve(self, tolerance: float = EXACT) -> Minimum:
        """The best minimum, from several starting points: first by the leading frames, finally by all."""
        start = self.solve_leading_frames()
        self.use_frames(1.0)
        return self.descend(start, self.settings.epochs, tolerance)

    def solve_leading_frames(self) -> Array:
        """The best variables for the leading frames.

        The search starts from the assumed Poisson's ratio and from a high one, each with the best of several E.
        """
        self.use_frames(FRAME_FRACTIONS[0])
        points = [min(points, key=lambda x: self.evaluate(x).loss) for points in self.starting_points()]
        for fraction in FRAME_FRACTIONS:
            self.use_frames(fraction)
            results = [self.descend(point, EVALUATIONS_PER_STAGE, EARLY) for point in points]
            points = [result.x for result in results]
        return min(results, key=lambda result: result.loss).x

    def starting_points(self) -> list[list[Array]]:
        """Variables to start from, by Poisson's ratio; those of the assumed material come first."""
        assumed = [max(float(getattr(self.simulator.material, q.name, 0.0)), q.low, q.start) for q in self.quantities]
        own = np.array([np.clip(q.variable(x), *q.bounds) for q, x in zip(self.quantities, assumed, strict=True)])
        groups = [own]
        if POISSON in self.quantities:
            groups.append(own.copy())
            groups[1][self.quantities.index(POISSON)] = POISSON.variable(START_POISSONS_RATIO)
        steps = np.log(START_FACTORS)[:, None] * np.eye(len(own))[0]
        return [[np.clip(group + step, *self.bounds) for step in steps] for group in groups]

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
        key = self._key(x)
        if key not in self.evaluations:
            try:
                self.evaluations[key] = self._simulate(x)
            except SimulationError:
                if not self.evaluations:
                    raise
                count = len(self.recording_names)
                return Evaluation([FAILURE_LOSS] * count, [[0.0] * len(x)] * count)
            self._save()
        return self.evaluations[key]

    def _key(self, x: Array) -> tuple[float, ...]:
        return (float(self.frames), *(float(value) for value in x))

    def _save(self) -> None:
        """Write the checkpoint."""
        if not self.group.is_main:
            return
        known = [[list(key), *vars(value).values()] for key, value in self.evaluations.items()]
        curvatures = [[list(key), value.tolist()] for key, value in self.curvatures.items()]
        content: dict[str, object] = {"format": FORMAT, "method": self.settings.method}
        save_tensors(self.checkpoint, content | {"known": known, "curvatures": curvatures})

    def _simulate(self, x: Array) -> Evaluation:
        def compute(recordings: Recordings, rows: list[int]) -> Array:
            variables = torch.tensor(x, dtype=torch.float64)[:, None].repeat(1, len(rows)).requires_grad_()
            simulated, _ = recordings.simulate(parameters=self.parameters(variables, recordings))
            losses = recording_losses(recordings, simulated)
            torch.autograd.backward(losses.sum())
            assert variables.grad is not None
            return np.column_stack([losses.detach().numpy(), variables.grad.numpy().T])

        cut = [recordings.first_frames(self.frames) for recordings in self.training]
        table = self.group.by_recording(cut, 1 + len(x), compute)
        return Evaluation(table[:, 0].tolist(), table[:, 1:].tolist())

    def curvature(self, x: Array) -> Array:
        """Gauss-Newton matrix of the recordings' mean loss at x, (n, n), by differences, from a few recordings."""
        key = self._key(x)
        if key not in self.curvatures:
            recordings = min(CURVATURE_RECORDINGS, CURVATURE_SIMULATIONS // len(x))
            share = max(recordings // len(self.training), 1)
            cut = [recordings.first_frames(self.frames) for recordings in self.training]
            parts = [self._gauss_newton_matrix(x, recordings, share) for recordings in cut]
            self.curvatures[key] = np.average(parts, axis=0, weights=[len(recordings.names) for recordings in cut])
            self._save()
        return self.curvatures[key]

    def _gauss_newton_matrix(self, x: Array, recordings: Recordings, count: int) -> Array:
        """Mean Gauss-Newton matrix (n, n), from `count` recordings; all differences are simulated as one batch.

        The others are taken to have the same matrix, in proportion to their mean squared motion. Processes share the
        simulations of the batch.
        """
        motion = recordings.square_motion
        chosen = spread_by_size(motion, count)
        few = recordings.select(chosen)
        sets = x + DIFFERENCE_STEP * np.vstack([np.zeros(len(x)), np.eye(len(x))])
        batch = len(few.names)
        variables = torch.from_numpy(sets.T).repeat_interleave(batch, dim=1)  # every set with every recording
        frames, _, *of_markers = few.markers.shape
        markers = torch.zeros(frames, len(sets) * batch, *of_markers, dtype=torch.float64)
        columns = self.group.share(range(len(sets) * batch))
        with self.group.fail_together(), torch.no_grad():
            if columns:
                start = few.dataset.start([few.names[k % batch] for k in columns])
                parameters = self.parameters(variables[:, columns], few)
                positions, _ = rollout(few.dataset.simulator, start, frames - 1, parameters=parameters)
                markers[:, columns] = few.dataset.markers.positions(positions)
        self.group.sum_over_processes([markers])
        markers = markers.reshape(frames, len(sets), batch, *of_markers)
        slope = (markers[:, 1:] - markers[:, :1]) / DIFFERENCE_STEP
        own: Array = loss_curvature(few, markers[:, 0], slope).numpy()
        return own * float(motion.mean() / motion[chosen].mean()) if motion[chosen].mean() > 0.0 else own

    def descend(self, start: Array, evaluations: int, tolerance: float = EXACT) -> Minimum:
        """Minimise within bounds from a starting point; see `rafl.fitting.gauss_newton.descend`."""
        if not self.history.rows:
            self.record(start)
        return descend(self, start, self.bounds, self.prior, evaluations, tolerance)

    def agree(self, x: Array) -> Array:
        """Variables as process 0 has computed them, in all processes."""
        shared = torch.from_numpy(x.copy())
        self.group.copy_from_main([shared])
        found: Array = shared.numpy()
        return found

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the variables, (n) each."""
        lows, highs = zip(*(q.bounds for q in self.quantities), strict=True)
        return np.array(lows), np.array(highs)

    def record(self, x: Array) -> None:
        """Append a row to the history; the errors are those of the frames that the search simulates."""
        validation = [recordings.first_frames(self.frames) for recordings in self.validation]
        error = 1e3 * mean_error(validation, self.model(x), self.group)
        shown = {q.name: float(q.value(x[k])) for k, q in enumerate(self.quantities) if not q.learned}
        if POISSON not in self.quantities:
            shown = {POISSON.name: FIXED_POISSONS_RATIO, **shown}
        self.history.append({"loss": self.evaluate(x).loss, "validation_mm": error, **shown})

    def inside(self, x: Array) -> NDArray[np.int64]:
        """Indices of the variables that are not at a bound."""
        lows, highs = np.array([q.inside for q in self.quantities]).T
        return np.flatnonzero((lows < x) & (x < highs))

    def covariance(self, minimum: Minimum) -> Array:
        """Covariance of the variables, (n, n).

        NaN where a variable is at its bound, where the search ended early, and where the recordings' frame was found
        through the assumed material.

        Marker errors are assumed independent and as large as the residuals of the fit; the Gauss-Newton matrix then
        gives the information matrix.
        """
        inside = self.inside(minimum.x)
        covariance = np.full((len(minimum.x), len(minimum.x)), np.nan)
        found = self.evaluate(minimum.x)
        matrix = (minimum.curvature + found.loss * np.diag(self.prior.curvature))[np.ix_(inside, inside)]
        gradient = (found.gradient + found.loss * self.prior.slope(minimum.x))[inside]
        if (
            self.intervals_known
            and len(inside)
            and np.linalg.eigvalsh(matrix)[0] > MIN_RELATIVE_CURVATURE * np.trace(matrix)
        ):
            inverse = np.linalg.inv(matrix)
            if gradient @ inverse @ gradient <= 2.0 * EXACT * found.loss:
                freedom = max(self.observed - len(minimum.x), 1.0)
                covariance[np.ix_(inside, inside)] = 2.0 * found.loss / freedom * inverse
        return covariance

    @property
    def observed(self) -> float:
        """Number of coordinates that were observed."""
        return sum(float(recordings.compared_coordinates.sum()) for recordings in self.training)

    def parameter_table(self, minimum: Minimum) -> str:
        """CSV text with each value, its 95 % interval and its correlations with the others.

        Intervals end at the bounds. A value at its bound has none, and no value has one if the search ended before a
        minimum.
        """
        x, covariance = minimum.x, self.covariance(minimum)
        sigma = np.sqrt(np.diag(covariance))
        names = [q.name for q in self.quantities]
        lines = ["name,unit,value,low_95,high_95," + ",".join(f"correlation_{name}" for name in names)]
        signs = [1.0 if item.kind != "log-gap" else -1.0 for item in self.quantities]
        for k, q in enumerate(self.quantities):
            margin = NORMAL_QUANTILE_95 * sigma[k]
            ends = sorted(float(q.value(np.clip(x[k] + sign * margin, *q.bounds))) for sign in (-1.0, 1.0))
            correlation = [signs[k] * signs[j] * covariance[k, j] / (sigma[k] * sigma[j]) for j in range(len(x))]
            cells = [float(q.value(x[k])), *ends, *correlation]
            lines.append(f"{q.name},{q.unit}," + ",".join("" if np.isnan(cell) else f"{cell:.6g}" for cell in cells))
        return "\n".join(lines) + "\n"

    def left_out_errors(self, minimum: Minimum, groups: list[list[int]]) -> list[float]:
        """Mean marker error [m] of every group of training recordings, predicted without it.

        groups: indices into `recording_names`. A group's variables are those after one Gauss-Newton step from the
        minimum of all recordings towards that of the others, within the bounds.
        """
        x, found, count = minimum.x, self.evaluate(minimum.x), len(self.recording_names)
        gradients = np.array(found.gradients)
        left_over = found.gradient + found.loss * self.prior.slope(x)  # zero at an exact minimum
        lows, highs = self.bounds
        variables = np.repeat(x[:, None], count, axis=1)
        for group in groups:
            matrix = (1.0 - len(group) / count) * minimum.curvature + found.loss * np.diag(self.prior.curvature)
            slope = (len(group) * left_over - gradients[group].sum(0)) / count
            step = bounded_step(matrix, slope, lows - x, highs - x)
            variables[:, group] = np.clip(x + step, lows, highs)[:, None]
        errors = self._errors(variables)
        return [float(errors[group].mean()) for group in groups]

    def _errors(self, variables: Array) -> Array:
        """Mean error of the training recordings [m], (R), with variables by recording (n, R)."""

        def compute(recordings: Recordings, rows: list[int]) -> Array:
            own = torch.from_numpy(np.ascontiguousarray(variables[:, rows]))
            with torch.no_grad():
                simulated, _ = recordings.simulate(parameters=self.parameters(own, recordings))
            return np.array([[each.mean()] for each in frame_errors(recordings, simulated)])

        return self.group.by_recording(self.training, 1, compute)[:, 0]


def spread_by_size(sizes: Array, count: int) -> list[int]:
    """Indices of `count` values at even ranks, the largest included, and the smallest too if there are two or more."""
    order = np.argsort(sizes)
    ranks = np.round(np.linspace(len(order) - 1, 0, min(count, len(order)))).astype(int)
    return sorted(order[np.unique(ranks)].tolist())


def _numbers(content: Any, shape: tuple[int, ...]) -> Array:
    """Finite numbers of a checkpoint as an array.

    Raises:
        ValueError: other content, or another shape.
    """
    array = np.array(content)
    check_shape("numbers", array, ArrayFormat(shape), {})
    check_values("numbers", array, ArrayFormat(shape))
    return array.astype(float)
