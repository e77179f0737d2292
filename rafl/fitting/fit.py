"""Fit a model by any method: check the inputs, open the run folder, train."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from rafl.common.errors import InputError
from rafl.common.files import new_folders, sha256
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_datasets
from rafl.data.objective import Objective
from rafl.fitting.distributed import process_group
from rafl.fitting.methods import DEFAULT_EPOCHS, METHODS, check_inputs, check_measurements
from rafl.fitting.run_folder import (
    HISTORY_FILE,
    SETTINGS_FILE,
    FittedModel,
    Report,
    Settings,
    read_settings,
    write_settings,
)
from rafl.fitting.train_field import pretraining_unavailable, training_items
from rafl.fitting.warm_start import MAX_VERTICES
from rafl.simulation.device import CPU, require_device


def fit(
    datasets: str | Path | Sequence[str | Path],
    run: str | Path,
    method: str = "auto",
    *,
    resume: bool = False,
    report: Report | None = None,
    notify: Callable[[str], None] = warnings.warn,
    epochs: int | None = None,
    learning_rate: float = 1e-3,
    weight_decay: float = 1e-5,
    patience: int = 20,
    frames: int = 0,
    seed: int = 0,
    batch: int = 1,
    force_penalty: float = 1e-8,
    warm_start: int = 20,
    start: str | Path | None = None,
    by_sigma: bool = False,
    objective: Objective = "",
    integrator: str = "",
    limit_energy: bool = True,
    device: str = CPU,
) -> FittedModel:
    """Fit a model to the `train` recordings of datasets and keep the one with the least `val` error.

    The processes that torchrun started share the recordings. All return the model; process 0 writes and reports.

    Args:
        datasets: dataset files, or one.
        run: folder for model.pt, history.csv, config.yaml and the checkpoint; must not hold a run yet.
        method: `auto` (the simplest of several models that predicts left-out recordings best, see
            `rafl.fitting.auto.fit_auto`), `constitutive` (material with a learned strain energy and viscosity), `rafl`
            (residual acceleration field), `srl` (supervised baseline), `sysid` (E and nu), `sysid-e` (E at nu = 0.499),
            `sysid-damping` (E, nu and viscosity), `sysid-loss` (E, nu and loss factor) or `sysid-branches` (E, nu
            and Maxwell branches).
        resume: continue the interrupted run in the folder, if there is one; the settings must be the same.
        report: called with every row of the history.
        notify: called with a message for every setting that has no effect.
        epochs: maximum number of passes over the recordings; by method if None.
        learning_rate: initial learning rate of Adam.
        weight_decay: of Adam.
        patience: epochs without a better validation error before training stops.
        frames: number of leading frames that training simulates; 0 for all.
        seed: of the weights and of the order of the recordings.
        batch: recordings per update.
        force_penalty: the paper's lambda_1 [m^2/N^2].
        warm_start: passes of pre-training on residual targets.
        start: run folder to fine-tune, or a `sysid` run whose material the field corrects.
        by_sigma: weight markers by their uncertainty.
        objective: compare `image`, the pixels that the cameras measured, or `3d`, the positions; empty for pixels
            where the datasets have them.
        integrator: `implicit-euler` or `generalised-alpha`; that of the datasets if empty.
        limit_energy: whether the energy that a field adds to a motion is limited by what it added in training.
        device: `cpu`, or a graphics card: `cuda`, or `cuda:1`. A run may be resumed on another device.

    Raises:
        InputError: there is no such device; or a file, the run folder or an option does not suit the method.
        SimulationError: the simulator did not converge; the message names recording and step.
        OtherProcessError: another process that torchrun started has ended.
    """
    paths = [Path(path) for path in ([datasets] if isinstance(datasets, str | Path) else datasets)]
    with process_group() as group, ExitStack() as stack:
        with group.fail_together():
            require_device(device)
            loaded = [dataset.on_device(device) for dataset in read_datasets(paths)]
            settings = Settings(
                method=method,
                datasets=tuple(str(path.resolve()) for path in paths),
                epochs=epochs or DEFAULT_EPOCHS.get(method, 1),
                learning_rate=learning_rate,
                weight_decay=weight_decay,
                patience=patience,
                frames=frames,
                seed=seed,
                batch=batch,
                force_penalty=force_penalty,
                warm_start=warm_start,
                start=str(Path(start).resolve()) if start else "",
                by_sigma=by_sigma,
                objective=objective,
                integrator=integrator,
                limit_energy=limit_energy,
                sha256=tuple(map(sha256, paths)),
            )
            check_inputs(method, loaded, Path(start) if start else None, integrator)
            check_measurements(loaded, settings)
            if group.is_main:
                stack.enter_context(open_run(Path(run), settings, resume))
                _notify_unused_settings(loaded, settings, notify, group.count)
        used = report if report is not None and group.is_main else lambda row: None
        return METHODS[method](loaded, settings, Path(run), used, group)


def _notify_unused_settings(
    datasets: list[Dataset], settings: Settings, notify: Callable[[str], None], processes: int
) -> None:
    """Report pixels that are not compared, processes that get no recording, and pre-training that cannot be done."""
    with_pixels = [[item.has_pixels for item in dataset.trajectories.values()] for dataset in datasets]
    in_space = settings.objective == "3d"
    if settings.by_sigma and not in_space and all(all(each) for each in with_pixels):
        notify("--by-sigma has no effect: pixels are weighted by their covariance; it is for --objective 3d")
    for dataset, each in zip(datasets, with_pixels, strict=True):
        if any(each) and not all(each) and not in_space:
            notify(
                f"{dataset.name}: some recordings have no pixels; where they are compared together with others, "
                "all are by their 3-D positions; build the dataset again from tracks"
            )
    recordings = len(training_items(datasets))
    if settings.method == "rafl" and processes > settings.batch:
        notify(f"{processes} processes share a batch of {settings.batch}: raise --batch to use them all")
    elif processes > recordings:
        notify(f"{processes} processes share {recordings} training recordings: start fewer, for some have none")
    if settings.method == "rafl" and pretraining_unavailable(datasets, settings):
        notify(f"no pre-training: it needs implicit-euler, 1 substep, no viscosity and at most {MAX_VERTICES} vertices")


@contextmanager
def open_run(run: Path, settings: Settings, resume: bool) -> Iterator[None]:
    """Create a run folder, or reopen one to resume its run, if there is one. Two runs never share a folder.

    A new folder is removed if the run fails before it has saved anything to resume from.

    Raises:
        InputError: the folder already holds a run or, when resuming, a run with other settings or other datasets.
    """
    if resume and (run / SETTINGS_FILE).exists():
        earlier = read_settings(run)
        if not earlier.sha256:  # of an earlier version
            earlier = replace(earlier, sha256=settings.sha256)
        changed = [
            path
            for path, *hashes in zip(earlier.datasets, earlier.sha256, settings.sha256, strict=False)
            if len(set(hashes)) > 1
        ]
        if changed and earlier == replace(settings, sha256=earlier.sha256):
            raise InputError(
                f"expected the dataset that the run in {run} began with, found that {changed[0]} has changed; choose "
                "another --out, or remove the folder to fit again"
            )
        if earlier != settings:
            raise InputError(
                f"expected the settings and datasets in {run}/config.yaml to resume, found others; use the same, or "
                "choose another --out"
            )
        yield
        return
    if (run / SETTINGS_FILE).exists():
        raise InputError(
            f"{run} already holds a run; choose another --out, continue it with --resume, or remove the folder"
        )
    with new_folders(run):
        write_settings(run, settings)
        try:
            yield
        except BaseException:
            if not any(run.glob("*.pt")):
                for name in (SETTINGS_FILE, HISTORY_FILE):
                    (run / name).unlink(missing_ok=True)
            raise
