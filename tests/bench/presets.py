"""Frequency, damping and static drop of the real beam, simulated with each preset, law and identification method.

    python tests/bench/presets.py ../shared/real/clamped_beam --out build/presets [--only physical]

One material for all three recordings: that of the specimen file (`assumed`), or the one identified from all of them.
How the recordings are used, see `beam_recordings.py`. The marker error is the mean distance in the plane of the swing.
--leave-one-out fits to two of the recordings and predicts the third, in turn.
Resumable: results under --out are not computed again.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import yaml
from beam_recordings import BeamRecording, fit_history, moving_dataset, read_beam

from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.evaluation.oscillation import fit_oscillation
from rafl.fitting.methods import METHODS
from rafl.fitting.run_folder import FittedModel, Settings
from rafl.fitting.sysid import parameter_sentences
from rafl.simulation.rollout import equilibrium

SPECIMENS = Path(__file__).parents[2] / "datasets" / "specimens"
ASSUMED = "assumed"
IDENTIFIED = ("sysid-damping", "sysid-loss", "sysid-branches", "constitutive")
LEFT_OUT = ("sysid-branches", "constitutive", "auto")
# Name; entries that replace those of `material` in the specimen file; methods.
CONFIGURATIONS: list[tuple[str, dict[str, str], tuple[str, ...]]] = [
    ("paper", {"preset": "paper"}, (ASSUMED, "sysid-damping")),
    ("physical, full", {"integration": "full"}, ("sysid-damping",)),
    ("physical, selective", {"integration": "selective"}, ("sysid-damping",)),
    ("physical", {}, (ASSUMED, *IDENTIFIED)),
    ("physical, neo-hookean", {"law": "neo-hookean"}, ("sysid-branches",)),
    ("physical, yeoh", {"law": "yeoh"}, ("sysid-branches",)),
]
IDENTIFICATION_FRAMES, EPOCHS = 80, 13
HISTORY_METHODS = ("sysid-loss", "sysid-branches", "constitutive", "auto")


def identify(dataset: Dataset, method: str, run: Path) -> FittedModel:
    """The material that fits the motion of all training recordings in the plane of the swing best."""
    run.mkdir(parents=True, exist_ok=True)
    settings = Settings(method, (dataset.name,), EPOCHS, 0.0, 0.0, 0, IDENTIFICATION_FRAMES, 0, by_sigma=True)
    return METHODS[method]([dataset], settings, run, lambda row: None)


def compare(dataset: Dataset, model: FittedModel, recordings: list[BeamRecording]) -> pd.DataFrame:
    """Frequency, damping ratio, static drop and marker error of every recording."""
    parameters, markers = model.parameters(dataset.simulator), dataset.markers
    batch = Recordings.of(dataset, [item.name for item in recordings])
    with torch.no_grad():
        simulated, _ = batch.simulate(parameters=parameters)
        at_rest = markers.positions(equilibrium(dataset.simulator, dataset.start(batch.names).force, parameters))
    straight = markers.rest[:, 2].mean()
    rows = []
    for b, item in enumerate(recordings):
        trajectory = dataset.trajectories[item.name]
        own = simulated[: len(trajectory.time), b].numpy()
        measured, found = (
            fit_oscillation(trajectory.time, motion[..., 2].mean(1)) for motion in (trajectory.markers, own)
        )
        rows.append(
            {
                "recording": item.name,
                "recorded Hz": measured.frequency,
                "Hz": found.frequency,
                "recorded damping": measured.damping,
                "damping": found.damping,
                "recorded drop mm": 1e3 * (straight - item.settled_height),
                "drop mm": 1e3 * (straight - at_rest[b, :, 2].mean().item()),
                "error mm": 1e3 * np.linalg.norm((own - trajectory.markers)[..., ::2], axis=-1).mean(),
            }
        )
    return pd.DataFrame(rows)


def agreement(table: pd.DataFrame) -> pd.Series:
    """Largest differences between simulations and recordings, and the mean marker error."""
    return pd.Series(
        {
            "frequency, within %": 100 * (table["Hz"] / table["recorded Hz"] - 1).abs().max(),
            "damping, within": (table["damping"] - table["recorded damping"]).abs().max(),
            "drop, within mm": (table["drop mm"] - table["recorded drop mm"]).abs().max(),
            "error mm": table["error mm"].mean(),
        }
    )


class Bench:
    """The recordings and the folder of the results."""

    def __init__(self, folder: Path, out: Path) -> None:
        self.folder, self.out = folder, out
        self.text: dict[str, Any] = yaml.safe_load((SPECIMENS / "clamped_beam.yaml").read_text())

    def specimen(self, entries: dict[str, str], path: Path) -> tuple[Specimen, list[BeamRecording]]:
        """The specimen with some entries of its material replaced, written to a file, and the recordings."""
        content = self.text | {"material": self.text["material"] | entries}
        write_text(path, yaml.safe_dump(content, sort_keys=False))
        return read_beam(read_specimen(path), self.folder, SPECIMENS / "clamped_beam_recordings.csv")

    def history(self, specimen: Specimen, recordings: list[BeamRecording]) -> dict[str, np.ndarray]:
        """Node positions before the recordings; those of the first law serve all laws, which hardly differ in them."""
        path = self.out / "history.npz"
        if not path.exists():
            found = fit_history(moving_dataset(specimen, recordings, {}), specimen, recordings)
            np.savez(path, **found)  # type: ignore[arg-type]
        with np.load(path) as content:
            return {name: content[name] for name in content}

    def run(self, name: str, entries: dict[str, str], method: str) -> pd.DataFrame:
        """The table of one configuration, computed or read."""
        run = self.out / name.replace(", ", "-") / method
        path = run / "table.csv"
        if not path.exists():
            begin = time.perf_counter()
            run.mkdir(parents=True, exist_ok=True)
            specimen, recordings = self.specimen(entries, run / "specimen.yaml")
            history = self.history(specimen, recordings) if method in HISTORY_METHODS else {}
            dataset = moving_dataset(specimen, recordings, history)
            model = FittedModel("original") if method == ASSUMED else identify(dataset, method, run)
            table = compare(dataset, model, recordings)
            table.insert(0, "method", method)
            table.insert(0, "configuration", name)
            table.to_csv(path, index=False)
            print(f"({name}, {method}: {time.perf_counter() - begin:.0f} s)", flush=True)
        parameters = run / "parameters.csv"
        if parameters.exists():
            print(f"{name}, {method}:", *parameter_sentences(pd.read_csv(parameters)), sep="\n  ")
        return pd.read_csv(path)

    def leave_one_out(self, method: str) -> pd.DataFrame:
        """The table of every recording as a model fitted to the others predicts it, computed or read."""
        tables = []
        for held_out in ("beam_gravity_V2_b", "beam_load52_V2_a", "beam_load101_V2_a"):
            run = self.out / "leave-one-out" / held_out / method
            path = run / "table.csv"
            if not path.exists():
                run.mkdir(parents=True, exist_ok=True)
                specimen, recordings = self.specimen({}, run / "specimen.yaml")
                dataset = moving_dataset(specimen, recordings, self.history(specimen, recordings))
                items = dataset.trajectories
                split = {name: replace(x, split="test" if name == held_out else "train") for name, x in items.items()}
                dataset = replace(dataset, trajectories=split)
                model = identify(dataset, method, run)
                table = compare(dataset, model, [item for item in recordings if item.name == held_out])
                table.insert(0, "model", model.method)
                table.insert(0, "method", method)
                table.to_csv(path, index=False)
            tables.append(pd.read_csv(path))
            print(tables[-1].round(3).to_string(index=False), flush=True)
        return pd.concat(tables)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="folder of the beam's recordings")
    parser.add_argument("--out", type=Path, required=True, help="folder for runs and results")
    parser.add_argument("--only", help="compute and print only configurations whose name starts like this")
    parser.add_argument("--leave-one-out", action="store_true", help="predict each recording from the others")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    bench = Bench(options.recordings, options.out)
    if options.leave_one_out:
        held_out = pd.concat([bench.leave_one_out(method) for method in LEFT_OUT])
        print(held_out.round(3).to_string(index=False))
        return
    tables = [
        bench.run(name, entries, method)
        for name, entries, methods in CONFIGURATIONS
        for method in methods
        if name.startswith(options.only or "")
    ]
    table = pd.concat(tables)
    print(table.round(3).to_string(index=False))
    print("how far one material explains all recordings")
    keys = ["configuration", "method"]
    print(table.groupby(keys, sort=False).apply(agreement, include_groups=False).round(3).to_string())


if __name__ == "__main__":
    main()
