"""The run folder: the fitted model, its settings, its history and the checkpoint to resume from."""

import io
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pydantic
import torch
import yaml

from rafl.common.errors import InputError
from rafl.common.files import require_file, write_bytes, write_text
from rafl.common.yaml_files import check_format, describe_validation, read_yaml_content
from rafl.data.objective import Objective
from rafl.fem.material import Material
from rafl.fitting.distributed import ALONE, ProcessGroup
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.energy_limit import LimitedForce
from rafl.residual.global_residual import GlobalResidual
from rafl.simulation.parameters import Parameters
from rafl.simulation.rollout import ResidualForce
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS

FORMAT = "rafl-run/1"
SETTINGS_FILE, HISTORY_FILE = "config.yaml", "history.csv"
MAX_EXPANSION = 3  # of a file of tensors when it is unpacked; torch does not pack them
TIME_INTEGRATION_KEY = "stepping"  # in model.pt
ENERGY_KEY, SEEN_KEY = "energy_fraction", "seen"


Report = Callable[[dict[str, float]], None]  # called with every row of the history

# A residual model of a user's own: makes the residual force on the mesh of a simulator.
ResidualModel = Callable[[Simulator], ResidualForce]


@dataclass(frozen=True)
class FittedModel:
    """The result of a fit: a residual field, identified material parameters, or both, and their time integration.

    Attributes:
        method: one of `rafl.fitting.methods.METHODS`, or `original` for the baseline simulator.
        field: the residual acceleration field, for `rafl`.
        material: identified values by their name in `rafl.simulation.parameters.Parameters`, numbers or lists, for the
            `sysid` methods and for a field that was trained on top of an identified material.
        network: from the whole state to nodal forces, for `srl`.
        time_integration: `integrator` and `substeps` of the simulator that the model was fitted in; None for the
            specimen's own.
        own: a residual model that was not fitted by this package. It is not saved.
        energy_fraction: largest work of the field relative to the energy scale of a motion, see
            `rafl.residual.energy_limit`; None for no limit.
        seen: strain and strain rate [1/s] that the training recordings reach, see `rafl.data.strain_range`; None if
            they were not determined.
    """

    method: str
    field: ResidualField | None = None
    material: dict[str, float | list[float]] | None = None
    network: GlobalResidual | None = None
    time_integration: dict[str, Any] | None = None
    own: ResidualModel | None = None
    energy_fraction: float | None = None
    seen: tuple[float, float] | None = None

    def simulator(self, own: Simulator) -> Simulator:
        """A specimen's simulator with the time integration that this model was fitted with."""
        return own if self.time_integration in (None, own.time_integration) else replace(own, **self.time_integration)

    def residual(self, simulator: Simulator) -> ResidualForce | None:
        """The residual force on a specimen, or None if this model has none. In rollouts its work is limited, if set.

        Raises:
            InputError: the model is not applicable to this mesh.
        """
        if self.own is not None:
            return self.own(simulator)
        residual = self.field or self.network
        if residual is None:
            return None
        force = residual.on(simulator)
        if self.energy_fraction is None:
            return force
        return LimitedForce(force, simulator, self.parameters(simulator), self.energy_fraction)

    def parameters(self, simulator: Simulator) -> Parameters:
        """Parameters to simulate a specimen with: the identified material, or else its own."""
        return simulator.parameters(**(self.material or {}))


@dataclass(frozen=True)
class Settings:
    """The settings of a fit, written to `config.yaml` in the run folder.

    Attributes:
        method: one of `rafl.fitting.methods.METHODS`.
        datasets: absolute paths of the dataset files.
        epochs: maximum number of passes over the training recordings.
        learning_rate: initial learning rate of Adam; it decays as a cosine.
        weight_decay: of Adam.
        patience: epochs without a better validation error before training stops.
        frames: number of leading frames of each recording that training simulates, 0 for all; pre-training uses all.
        seed: of the initial weights and the order of recordings.
        batch: recordings per update.
        force_penalty: the paper's lambda_1 [m^2/N^2].
        warm_start: passes of pre-training on residual targets, before the first simulation.
        start: run folder whose field or material training starts from; empty for new weights and the datasets' own
            material.
        by_sigma: whether to weight markers by their uncertainty.
        objective: what is compared: `image`, the pixels that the cameras measured; `3d`, positions; empty for pixels
            where a dataset has them.
        integrator: time integration of the simulator; empty for that of `start` or else of the datasets.
        limit_energy: whether the energy that a field adds is limited, see `rafl.residual.energy_limit`.
        sha256: of the dataset files, so that no run is resumed with others; empty in runs of earlier versions.
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
    objective: Objective = ""
    integrator: str = ""
    limit_energy: bool = True
    sha256: tuple[str, ...] = ()


def write_settings(run: Path, settings: Settings) -> None:
    """Write `config.yaml`."""
    content = {"format": FORMAT, **asdict(settings)}
    content |= {key: list(content[key]) for key in ("datasets", "sha256")}
    write_text(run / SETTINGS_FILE, yaml.safe_dump(content, sort_keys=False))


def read_settings(run: Path) -> Settings:
    """Read `config.yaml`.

    Raises:
        InputError: not a run folder, or one of a newer version.
    """
    path = run / SETTINGS_FILE
    content = read_yaml_content(path, "a run folder's settings (written by rafl-fit)", FORMAT)
    del content["format"]
    try:
        return pydantic.TypeAdapter(Settings).validate_python(content)
    except pydantic.ValidationError as error:
        raise InputError(
            f"expected settings written by rafl-fit in {path}: {describe_validation(error)}; fit again"
        ) from None


def save_tensors(path: Path, content: dict[str, object]) -> None:
    """Save tensors and plain values, completely or not at all."""
    stream = io.BytesIO()
    torch.save(content, stream)
    write_bytes(path, stream.getbuffer())


def load_tensors(path: Path, label: str) -> dict[str, Any]:
    """Load what `save_tensors` wrote. No code in the file is executed.

    Args:
        path: the file.
        label: description of the expected content, for error messages.

    Raises:
        InputError: the file is missing, damaged, of another kind or of a newer version.
    """
    require_file(path, label)
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
        if size > MAX_EXPANSION * path.stat().st_size:
            raise ValueError(f"its parts would take {size / 1e6:.0f} MB")
        content = torch.load(path, weights_only=True)
    except Exception as error:  # torch raises many kinds here; all mean the same to the user
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"expected {label} in {path}, which cannot be read: {reason:.120}; fit again") from None
    if not isinstance(content, dict) or not isinstance(content.get("method"), str):
        raise InputError(f"expected {label} in {path}, found something else; fit again")
    check_format(str(content.get("format", "")), FORMAT, path)
    return content


@contextmanager
def expect_content(label: str, path: Path) -> Iterator[None]:
    """Turn errors from using the content that `load_tensors` returned into an error about the file.

    Raises:
        InputError: a part is missing, or weights have other names or shapes.
    """
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = str(error).splitlines()[-1].strip() if str(error) else type(error).__name__
        raise InputError(f"expected {label} in {path}, found other contents: {reason:.120}; fit again") from None


def save_model(run: Path, model: FittedModel) -> None:
    """Write `model.pt`."""
    content: dict[str, object] = {"format": FORMAT, "method": model.method}
    if model.field is not None:
        content["field"] = model.field.state_dict()
    if model.material is not None:
        content["material"] = dict(model.material)
    if model.time_integration is not None:
        content[TIME_INTEGRATION_KEY] = dict(model.time_integration)
    if model.energy_fraction is not None:
        content[ENERGY_KEY] = model.energy_fraction
    if model.seen is not None:
        content[SEEN_KEY] = list(model.seen)
    if model.network is not None:
        content |= {"nodes": model.network.nodes, "network": model.network.state_dict()}
    save_tensors(run / "model.pt", content)


def load_model(run: str | Path) -> FittedModel:
    """Read `model.pt`.

    Raises:
        InputError: missing, damaged, or written by a newer version.
    """
    run = Path(run)
    content = load_tensors(run / "model.pt", "a fitted model (written by rafl-fit)")
    material = content.get("material")
    if not (material is None or isinstance(material, dict)):
        raise InputError(f"expected identified values by name in {run / 'model.pt'}, found a list; fit again")
    integration = content.get(TIME_INTEGRATION_KEY)
    if integration is not None and not _is_time_integration(integration):
        found = integration.get("integrator") if isinstance(integration, dict) else integration
        raise InputError(f"expected an integrator and substeps in {run / 'model.pt'}, found {found!s:.80}; fit again")
    with expect_content("a material", run / "model.pt"):
        values: dict[str, Any] = {key: tuple(x) if isinstance(x, list) else x for key, x in (material or {}).items()}
        Material(**values)
    network = field = None
    with expect_content("weights of this version", run / "model.pt"):
        if "network" in content:
            network = GlobalResidual(content["nodes"])
            network.load_state_dict(content["network"])
        if "field" in content:
            field = ResidualField()
            field.restore(content["field"])
        strain, rate = map(float, content.get(SEEN_KEY, (0.0, 0.0)))
        seen = (strain, rate) if SEEN_KEY in content else None
        fraction = float(content[ENERGY_KEY]) if ENERGY_KEY in content else None
        weights = [tensor for part in (network, field) if part is not None for tensor in part.state_dict().values()]
        numbers = [torch.tensor([strain, rate, fraction or 0.0]), *weights]
        if not all(bool(tensor.isfinite().all()) for tensor in numbers):
            raise ValueError("numbers that are not finite")
    return FittedModel(content["method"], field, material, network, integration, None, fraction, seen)


def _is_time_integration(content: Any) -> bool:
    """Whether some content has the form of `Simulator.time_integration`."""
    if not (isinstance(content, dict) and set(content) == {"integrator", "substeps"}):
        return False
    if not isinstance(content["integrator"], str):
        return False
    return content["integrator"] in INTEGRATORS and isinstance(content["substeps"], int) and content["substeps"] >= 1


def has_stalled(errors: Sequence[float], patience: int) -> bool:
    """Whether none of the last `patience` validation errors, one per epoch, is the lowest so far."""
    return len(errors) - 1 - int(np.argmin(errors)) >= patience


def write_history(run: Path, rows: list[dict[str, float]]) -> None:
    """Write `history.csv`, one row per epoch."""
    write_text(run / HISTORY_FILE, pd.DataFrame(rows).to_csv(index=False))


@dataclass
class History:
    """The rows of `history.csv` of a run, over all its searches.

    Attributes:
        run: folder of the run.
        report: called with every row.
        group: processes that search together.
        rows: so far.
    """

    run: Path
    report: Report
    group: ProcessGroup = ALONE
    rows: list[dict[str, float]] = field(default_factory=list)

    def append(self, row: dict[str, float]) -> None:
        """Append a row, write the file and report the row."""
        self.rows.append({"epoch": len(self.rows), **row})
        if self.group.is_main:
            write_history(self.run, self.rows)
        self.report(self.rows[-1])
