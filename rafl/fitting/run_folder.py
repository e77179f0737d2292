"""A run folder: the fitted model, its settings, its history and where to resume."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import yaml

from rafl.common.errors import InputError
from rafl.common.files import require_file, whole_file, write_text
from rafl.common.yaml_files import check_format, yaml_content
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.global_residual import GlobalResidual
from rafl.simulation.parameters import Parameters
from rafl.simulation.rollout import ResidualForce
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS

FORMAT = "rafl-run/1"


@dataclass(frozen=True)
class FittedModel:
    """What a fit leaves: a residual field, identified material parameters, or both, and how time was stepped with them.

    Attributes:
        method: one of `rafl.fitting.methods.METHODS`.
        field: the residual acceleration field, for `rafl`.
        material: identified values by their name in `rafl.simulation.parameters.Parameters`, for `sysid` and its kin, and for a
            field that was trained on top of such.
        network: from the whole state to nodal forces, for `srl`.
        stepping: `integrator` and `substeps` of the simulator that it was fitted in; a specimen's own where None.
    """

    method: str
    field: ResidualField | None = None
    material: dict[str, float] | None = None
    network: GlobalResidual | None = None
    stepping: dict[str, Any] | None = None

    def simulator(self, own: Simulator) -> Simulator:
        """A specimen's simulator, stepping as the one that this was fitted in."""
        return own if self.stepping in (None, own.stepping) else replace(own, **self.stepping)

    def residual(self, simulator: Simulator) -> ResidualForce | None:
        """The residual force on a specimen, if this model has one.

        Raises:
            InputError: a mesh that the model cannot act on.
        """
        residual = self.field or self.network
        return residual.on(simulator) if residual is not None else None

    def parameters(self, simulator: Simulator) -> Parameters:
        """What to simulate a specimen with: its own material, or the identified one."""
        return simulator.parameters(**(self.material or {}))


@dataclass(frozen=True)
class Settings:
    """How a model was fitted; `config.yaml` in the run folder.

    Attributes:
        method: `rafl` or `sysid`.
        datasets: absolute paths of the dataset files.
        epochs: passes over the training recordings, at most.
        learning_rate: Adam's, at the start of the cosine decay.
        weight_decay: Adam's.
        patience: epochs without a better validation error before training stops.
        frames: leading frames of each recording that training simulates (all when 0); a warm start follows all.
        seed: of the initial weights and the order of recordings.
        batch: recordings an update.
        force_penalty: the paper's lambda_1 [m^2/N^2].
        warm_start: passes over the forces that follow the recordings step by step, before the first simulation.
        start: run folder whose field or material training goes on from; empty for new weights and the datasets' own.
        by_sigma: whether markers count by their uncertainty.
        integrator: by which the simulator steps; empty for that of `start` or else of the datasets.
    """

    method: str
    datasets: tuple[str, ...]
    epochs: int
    learning_rate: float
    weight_decay: float
    patience: int
    frames: int
    seed: int
    batch: int = 1
    force_penalty: float = 1e-8
    warm_start: int = 0
    start: str = ""
    by_sigma: bool = False
    integrator: str = ""


def write_settings(run: Path, settings: Settings) -> None:
    """Write `config.yaml`."""
    content = {"format": FORMAT, **asdict(settings), "datasets": list(settings.datasets)}
    write_text(run / "config.yaml", yaml.safe_dump(content, sort_keys=False))


def read_settings(run: Path) -> Settings:
    """Read `config.yaml`.

    Raises:
        InputError: not a run folder, or a newer one.
    """
    path = run / "config.yaml"
    content = yaml_content(path, "a run folder's settings (written by rafl-fit)", FORMAT)
    del content["format"]
    try:
        return Settings(**{**content, "datasets": tuple(content["datasets"])})
    except (TypeError, KeyError) as error:
        raise InputError(f"expected settings written by rafl-fit in {path}: {error}; fit again") from None


def save_tensors(path: Path, content: dict[str, object]) -> None:
    """Save tensors and plain values, whole or not at all."""
    with whole_file(path) as temporary:
        torch.save(content, temporary)


def load_tensors(path: Path, what: str) -> dict:
    """Load what `save_tensors` wrote; nothing in the file is executed.

    Raises:
        InputError: missing, of another kind or damaged.
    """
    require_file(path, what)
    try:
        content = torch.load(path, weights_only=True)
    except Exception as error:  # torch raises many kinds here; all mean the same to the user
        reason = str(error).splitlines()[0]
        raise InputError(f"expected {what} in {path}, which cannot be read: {reason:.120}; fit again") from None
    if not isinstance(content, dict) or "method" not in content:
        raise InputError(f"expected {what} in {path}, found something else; fit again")
    check_format(str(content.get("format", "")), FORMAT, path)
    return content


@contextmanager
def understood(what: str, path: Path) -> Iterator[None]:
    """Where what `load_tensors` found is taken apart: other contents than expected are the file's fault.

    Raises:
        InputError: something is missing, or weights have other names or shapes.
    """
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = str(error).splitlines()[-1].strip() if str(error) else type(error).__name__
        raise InputError(f"expected {what} in {path}, found other contents: {reason:.120}; fit again") from None


def save_model(run: Path, model: FittedModel) -> None:
    """Write `model.pt`."""
    content: dict[str, object] = {"format": FORMAT, "method": model.method}
    if model.field is not None:
        content["field"] = model.field.state_dict()
    if model.material is not None:
        content["material"] = dict(model.material)
    if model.stepping is not None:
        content["stepping"] = dict(model.stepping)
    if model.network is not None:
        content |= {"nodes": model.network.nodes, "network": model.network.state_dict()}
    save_tensors(run / "model.pt", content)


def load_model(run: Path) -> FittedModel:
    """Read `model.pt`.

    Raises:
        InputError: missing, damaged, or written by a newer version.
    """
    content = load_tensors(run / "model.pt", "a fitted model (written by rafl-fit)")
    material = content.get("material")
    if not (material is None or isinstance(material, dict)):
        raise InputError(f"expected identified values by name in {run / 'model.pt'}, found a list; fit again")
    stepping = content.get("stepping")
    if stepping is not None and not _steps(stepping):
        raise InputError(
            f"expected an integrator and substeps in {run / 'model.pt'}, found {stepping!r:.80}; fit again"
        )
    network = field = None
    with understood("weights of this version", run / "model.pt"):
        if "network" in content:
            network = GlobalResidual(content["nodes"])
            network.load_state_dict(content["network"])
        if "field" in content:
            field = ResidualField()
            field.restore(content["field"])
    return FittedModel(content["method"], field, material, network, stepping)


def _steps(found: Any) -> bool:
    """Whether this is what `Simulator.stepping` says."""
    if not (isinstance(found, dict) and set(found) == {"integrator", "substeps"}):
        return False
    return found["integrator"] in INTEGRATORS and isinstance(found["substeps"], int) and found["substeps"] >= 1


def stale(errors: Sequence[float], patience: int) -> bool:
    """Whether the last `patience` of the validation errors so far, one an epoch, brought nothing better."""
    return len(errors) - 1 - int(np.argmin(errors)) >= patience


def write_history(run: Path, rows: list[dict[str, float]]) -> None:
    """Write `history.csv`, a row an epoch."""
    write_text(run / "history.csv", pd.DataFrame(rows).to_csv(index=False))
