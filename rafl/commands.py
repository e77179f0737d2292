"""What `rafl-fit` and `rafl-eval` do once their options are checked: call the library, print and write the results."""

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch
import typer
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from rafl.common.command_line import create_table, failure, next_command, progress
from rafl.common.errors import InputError, SimulationError
from rafl.common.files import require_writable, written_files
from rafl.common.kernels import announce_compilation
from rafl.common.names import require_names
from rafl.common.text_tables import spreadsheet_csv, spreadsheet_text
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset, read_datasets
from rafl.evaluation.evaluation_file import EVALUATION_FILE, Evaluation, write_evaluation
from rafl.evaluation.metrics import (
    Comparison,
    Transfer,
    beyond_training,
    compare_skipping_failures,
    error_table,
    held_out_errors,
    latex_table,
    motion_table,
    split_table,
)
from rafl.evaluation.page_data import PageData
from rafl.evaluation.page_file import page_file
from rafl.fitting.auto import SELECTION_FILE, selection_sentences
from rafl.fitting.distributed import OtherProcessError, rank
from rafl.fitting.fit import fit as fit_model
from rafl.fitting.methods import DEFAULT_EPOCHS
from rafl.fitting.quantities import METHOD_QUANTITIES
from rafl.fitting.run_folder import FittedModel, Report, load_model
from rafl.fitting.sysid import parameter_sentences
from rafl.simulation.device import require_device

LABELS = {"missing": "residual targets not met"}  # of columns of the history, where its name says too little
TORCH_THREADS = 1  # the network is small; the other cores run the element kernels


def fit(
    paths: list[Path], out: Path | None, method: str, tensorboard: bool, resume: bool, options: dict[str, Any]
) -> None:
    """Train a model, print its progress, and say what was written.

    Args:
        paths: dataset files to train on.
        out: run folder; None for runs/DATASET-METHOD.
        method: one of `rafl.fitting.methods.METHODS`.
        tensorboard: whether to write the history for TensorBoard too.
        resume: whether to continue the run in the folder.
        options: further keyword arguments of `rafl.fit`.

    Raises:
        InputError: the datasets, the run folder or the options do not fit the method.
        typer.Exit: a simulation failed, or another process that torchrun started has ended; code 1.
    """
    require_device(options["device"], "--device")
    torch.set_num_threads(TORCH_THREADS)
    first = rank() == 0  # of the processes that torchrun started
    if first:
        announce_compilation()
    run = out or Path("runs") / _run_name(read_dataset(paths[0]).name, method)
    require_writable(run)
    open_writer = partial(_summary_writer(), run) if tensorboard and first else None
    with progress(first) as bar:
        searches = method == "auto" or method in METHOD_QUANTITIES  # of several stages
        task = bar.add_task("epoch", total=None if searches else options["epochs"] or DEFAULT_EPOCHS[method])
        report = _epoch_report(bar, task, open_writer)
        notify = partial(typer.echo, err=True)
        try:
            model = fit_model(paths, run, method, resume=resume, report=report, notify=notify, **options)
        except (SimulationError, OtherProcessError) as error:
            raise failure(f"error: {error}", 1) from None
    if not first:
        return
    typer.echo(_describe(model))
    if (run / SELECTION_FILE).exists():
        for line in selection_sentences(pd.read_csv(run / SELECTION_FILE), model):
            typer.echo(line)
    if (run / "parameters.csv").exists():
        through_model = any(read_dataset(path).registered_through_model for path in paths)
        for line in parameter_sentences(pd.read_csv(run / "parameters.csv"), through_model):
            typer.echo(line)
    typer.echo(f"wrote {run}/ (model.pt, history.csv, config.yaml)")
    typer.echo(next_command("rafl-eval", run, *paths))


def _run_name(dataset: str, method: str) -> str:
    require_names([dataset], "dataset (or give --out)")
    return f"{dataset}-{method}"


def _epoch_report(bar: Progress, task: TaskID, open_writer: Callable[[], Any] | None) -> Report:
    """A function that prints one row of the history and passes it to TensorBoard, whose file the first row opens."""
    writer: Any = None

    def report(row: dict[str, float]) -> None:
        nonlocal writer
        kind = "epoch" if "epoch" in row else "warm_start"
        bar.update(task, completed=row.get("epoch", 0))
        values = ", ".join(
            f"{LABELS.get(key, key)} {value:.5g}" for key, value in row.items() if key != kind and value == value
        )
        label = "epoch" if kind == "epoch" else "pre-training"
        bar.console.print(f"{label} {row[kind]:3.0f}: {values}", highlight=False, soft_wrap=True)
        if open_writer is not None:
            writer = writer or open_writer()
            for key, value in row.items():
                writer.add_scalar(f"{kind}/{key}", value, int(row[kind]))
            writer.flush()

    return report


def _summary_writer() -> Any:
    """TensorBoard's class of writers.

    Raises:
        InputError: the package tensorboard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter  # an optional package
    except ImportError:
        raise InputError(
            "--tensorboard: expected the package tensorboard, found none; pip install tensorboard, or leave the option "
            "out (history.csv holds the same values)"
        ) from None
    return SummaryWriter


def _describe(model: FittedModel) -> str:
    """One line about a fitted model."""
    if model.network is not None:
        return f"trained a supervised residual network for meshes of {model.network.nodes} vertices"
    parts = [] if model.field is None else ["trained a residual acceleration field"]
    if model.material is not None:
        e, nu, viscosity, shares = (
            torch.as_tensor(model.material.get(key, ()))
            for key in ("youngs_modulus", "poissons_ratio", "viscosity", "branch_shares")
        )
        identified = f"identified E = {e / 1e3:.1f} kPa, nu = {nu:.4f}"
        if viscosity.numel() and viscosity > 0.0:
            identified += f", viscosity = {viscosity:.0f} Pa s"
        if shares.numel():
            identified += f", branches of {', '.join(f'{share:.3f}' for share in shares.tolist())} mu"
        if model.material.get("energy_weights"):
            identified += ", with a learned strain energy and viscosity"
        parts.append(identified)
    integration = f", time integration {model.time_integration['integrator']}" if model.time_integration else ""
    return " on ".join(parts) + integration


def evaluate(runs: list[Path], files: list[Path], folder: Path, report: bool, device: str) -> None:
    """Simulate every recording with the baseline simulator and every model; write tables and a report.

    Args:
        runs: run folders of the models.
        files: dataset files.
        folder: where errors.csv, motions.csv, errors.tex, evaluation.h5 and report.html are written.
        report: whether evaluation.h5 and report.html are written.
        device: of the simulations.

    Raises:
        InputError: there is no such device, a run or a dataset cannot be read, or a model is applicable to none of the
            datasets.
        typer.Exit: a simulation failed; code 1.
    """
    require_device(device, "--device")
    torch.set_num_threads(TORCH_THREADS)
    announce_compilation()
    require_writable(folder)
    models = _models_by_name(runs)
    datasets = [dataset.on_device(device) for dataset in read_datasets(files)]
    try:
        comparisons, failed = _compare_all(datasets, models)
    except SimulationError as error:
        raise failure(f"error: {error}", 1) from None
    recordings, splits, motions = error_table(comparisons), split_table(comparisons), motion_table(comparisons)
    evaluation = Evaluation(comparisons, "; ".join(f"{name}: {_describe(model)}" for name, model in models.items()))
    texts = {
        "errors.csv": spreadsheet_csv(recordings),
        "motions.csv": spreadsheet_csv(motions),
        "errors.tex": latex_table(splits),
    }
    if report:
        texts["report.html"] = page_file(PageData.of_evaluation(evaluation, f"Evaluation {folder.resolve().name}"))
    transfer = Transfer.of(splits)
    if transfer.errors.shape[1] > 1:
        errors = transfer.errors.rename(index=spreadsheet_text, columns=spreadsheet_text)
        texts["transfer.csv"] = errors.to_csv(float_format="%.6f")
    with written_files({folder / name: text for name, text in texts.items()}):
        if report:
            write_evaluation(folder / EVALUATION_FILE, evaluation)
    Console(width=100).print(_error_table(splits))
    for sentence in beyond_training(comparisons, models):
        typer.echo(f"warning: {sentence}", err=True)
    for name, count in transfer.negative_transfers.items():
        simulated = transfer.datasets_simulated[name]
        failing = f"; its simulation fails on {failed[name]} more" if name in failed else ""
        typer.echo(f"{name}: worse than the baseline simulator on {count} of {simulated} datasets{failing}")
    typer.echo(f"wrote {folder}/errors.csv, motions.csv, errors.tex{f', {EVALUATION_FILE}' if report else ''}")
    held_out = held_out_errors(comparisons)
    if held_out:
        values = ", ".join(f"{name} {1e3 * error:.3f} mm" for name, error in held_out.items())
        typer.echo(f"held-out marker error: {values}")
    else:
        typer.echo("no recording has split `test`, so this error is not of held-out recordings", err=True)
    if report:
        typer.echo(f"report: {folder / 'report.html'} (open it in a browser; rafl-review {folder} shows all frames)")


def _error_table(splits: pd.DataFrame) -> Table:
    table = create_table("dataset", "split", "recordings", "method", "error [mm]")
    for row in splits.itertuples():
        value = f"{row.mean_mm:.3f} +- {row.std_mm:.3f}"
        table.add_row(str(row.dataset), str(row.split), str(row.recordings), str(row.method), value)
    return table


def _compare_all(datasets: list[Dataset], models: dict[str, FittedModel]) -> tuple[list[Comparison], Counter[str]]:
    """Compare every dataset with the models that are applicable to it.

    Returns:
        The comparisons, and for every model the number of datasets on which its simulation failed.

    Raises:
        SimulationError: the baseline simulator fails, or a model fails on every dataset to which it is applicable.
    """
    applicable = _applicable_models(datasets, models)
    comparisons: list[Comparison] = []
    failed: Counter[str] = Counter()
    with progress() as bar:
        for k, dataset in enumerate(bar.track(datasets, description="simulating")):
            compared, failures = compare_skipping_failures(dataset, applicable[k])
            comparisons += compared
            for name, error in failures.items():
                failed[name] += 1
                if failed[name] == sum(name in own for own in applicable):
                    raise SimulationError(f"{name} on {dataset.name}: {error}")
                typer.echo(f"left out on {dataset.name}: {name}: {error}", err=True)
    return comparisons, failed


def _applicable_models(datasets: list[Dataset], models: dict[str, FittedModel]) -> list[dict[str, FittedModel]]:
    """The models that are applicable to the mesh of each dataset. Prints which are left out, and why.

    Raises:
        InputError: a model is applicable to none of the datasets.
    """
    applicable = [dict(models) for _ in datasets]
    for name, model in models.items():
        left_out = {}
        for dataset, own in zip(datasets, applicable, strict=True):
            try:
                model.residual(dataset.simulator)
            except InputError as error:
                left_out[dataset.name] = error
                own.pop(name)
        if len(left_out) == len(datasets):
            raise next(iter(left_out.values()))
        for where, reason in left_out.items():
            typer.echo(f"left out on {where}: {reason}", err=True)
    return applicable


def _models_by_name(runs: list[Path]) -> dict[str, FittedModel]:
    """Models by method, or by method and folder where several runs share a method."""
    models = [load_model(run) for run in runs]
    methods = [model.method for model in models]
    return {
        model.method if methods.count(model.method) == 1 else f"{model.method} ({run.name})": model
        for run, model in zip(runs, models, strict=True)
    }
