"""Two stand-in laboratories in which a material identified on one shape is carried to others.

    python tests/bench/labs.py [--quick] [--out build/labs] [--lab viscous] [--lab rubber]

A laboratory is a finer mesh of a known material: a viscous, linearly elastic one, and a neo-Hookean rubber with Maxwell
branches. Its markers are recorded on five shapes without error, and made into datasets as rafl-capture does. Every
model is fitted on the canonical beam only. Resumable: results under --out are not computed again. --quick takes three
shapes, fewer recordings and fewer frames.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich.console import Console
from stand_in_lab import FULL, JUDGED, LABS, MODELS, QUICK, TRAINED_ON, Laboratory, loss_factor, material_of

from rafl.common.command_line import create_table
from rafl.common.files import write_text
from rafl.evaluation.metrics import BASELINE

PUBLISHED = (  # in the documentation
    "sysid-damping, full",
    "sysid-damping, selective",
    "sysid-damping",
    "sysid-loss",
    "sysid-branches",
    "auto",
)
# Bars for the judged models: largest relative error of E and of the loss factor, and largest mean test error [mm].
MODULUS_BAR, LOSS_BAR = 0.02, 0.05
ERROR_BARS = {"canonical": 0.15, "shorter": 0.15, "thicker": 0.15, "longer": 0.3, "thinner": 0.5}


def show(title: str, table: pd.DataFrame) -> None:
    printed = create_table("", *map(str, table.columns), title=title)
    for name, row in table.iterrows():
        printed.add_row(str(name), *map(str, row))
    Console(width=170).print(printed)


def material_table(laboratory: Laboratory) -> pd.DataFrame:
    """Identified materials, one row per model, after the laboratory's own. Errors are relative to the latter's."""
    true, frequency = laboratory.material, laboratory.swing_frequency
    rows = {"the laboratory": (true, np.nan)}
    for name, model in MODELS.items():
        if model.method:
            assumed = laboratory.dataset(TRAINED_ON, model).simulator.material
            rows[name] = (material_of(laboratory.fit(name), assumed), laboratory.training_loss(name))
        else:
            rows[name] = (true, laboratory.training_loss(name))
    own = loss_factor(true, frequency)
    return pd.DataFrame.from_dict(
        {
            name: {
                "E_kPa": 1e-3 * material.youngs_modulus,
                "E_error_percent": 100.0 * (material.youngs_modulus / true.youngs_modulus - 1.0),
                "nu": material.poissons_ratio,
                "viscosity_Pa_s": material.viscosity,
                "branch_shares": " ".join(f"{share:.4f}" for share in material.branch_shares),
                "loss_factor": loss_factor(material, frequency),
                "loss_factor_error_percent": 100.0 * (loss_factor(material, frequency) / own - 1.0),
                "training_loss": loss,
            }
            for name, (material, loss) in rows.items()
        },
        orient="index",
    )


def report(laboratory: Laboratory) -> pd.DataFrame:
    """Print and write the tables of a laboratory, and compare with the bars; the errors of all models by shape."""
    title, shapes = laboratory.name, laboratory.size.shapes
    show(f"{title}: sag, and distance from half the time step", laboratory.convergence().round(4))
    tested = {(shape, name): laboratory.errors(shape, name) for shape in shapes for name in MODELS}
    errors = pd.DataFrame(
        {shape: {name: tested[shape, name].loc[name, "mean_mm"] for name in MODELS} for shape in shapes}
    )
    errors.loc[BASELINE] = {shape: tested[shape, JUDGED[0]].loc[BASELINE, "mean_mm"] for shape in shapes}
    for name in JUDGED:
        first = {shape: tested[shape, name].loc[name, "first_frame_mm"] for shape in shapes}
        errors.loc[f"first frame of {name}"] = first
    materials = material_table(laboratory)
    for name, table in (("errors", errors), ("materials", materials)):
        write_text(laboratory.out / f"{name}.csv", table.rename_axis("model").to_csv(float_format="%.6g"))
    show(f"{title}: mean marker error of the test recordings [mm]", errors.map("{:.3f}".format))
    shown = {key: "{:.4g}".format for key in materials if key != "branch_shares"}
    frequency = f"loss factors at {laboratory.swing_frequency:.2f} Hz"
    show(
        f"{title}: identified on {TRAINED_ON}; {frequency}",
        materials.assign(**{k: materials[k].map(f) for k, f in shown.items()}),
    )
    for name in JUDGED:
        found = materials.loc[name]
        bars = [
            ("E", abs(found["E_error_percent"]), 100.0 * MODULUS_BAR, "%"),
            ("loss factor", abs(found["loss_factor_error_percent"]), 100.0 * LOSS_BAR, "%"),
            *((shape, errors.loc[name, shape], ERROR_BARS[shape], "mm") for shape in shapes),
        ]
        for label, value, bar, unit in bars:
            verdict = "holds" if value <= bar else "missed"
            print(f"{title}, {name}, {label}: {value:.3f} {unit}, bar {bar:g} {unit}: {verdict}")
    published = errors.loc[[BASELINE, *PUBLISHED]].rename_axis("method").reset_index()
    return published.melt("method", var_name="shape", value_name="mean_mm").assign(study=title)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three shapes, fewer recordings and frames")
    parser.add_argument("--out", type=Path, default=Path("build/labs"), help="folder for recordings, datasets and runs")
    parser.add_argument("--lab", choices=LABS, action="append", help="only this laboratory [all]")
    parser.add_argument("--results", type=Path, help="folder for a table of the errors in all laboratories")
    options = parser.parse_args()
    torch.set_num_threads(1)
    size = QUICK if options.quick else FULL
    laboratories = [
        Laboratory(name, options.out / ("quick" if options.quick else "full"), size) for name in options.lab or LABS
    ]
    tables: list[pd.DataFrame] = []
    for laboratory in laboratories:
        laboratory.convergence()
        for shape in size.shapes:
            laboratory.record(shape)
        for shape in size.shapes:
            for name in MODELS:
                laboratory.errors(shape, name)
        tables.append(report(laboratory))
    if options.results:
        columns = ["study", "shape", "method", "mean_mm"]
        write_text(options.results / "labs.csv", pd.concat(tables)[columns].to_csv(index=False, float_format="%.4f"))


if __name__ == "__main__":
    main()
