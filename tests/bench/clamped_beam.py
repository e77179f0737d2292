"""Leave-one-recording-out study on the real beam: every method is tested on the recording held out.

    python tests/bench/clamped_beam.py ../shared/real/clamped_beam --out build/clamped_beam

Compares the baseline simulator with both presets, system identification (E and nu, E alone) and RAFL. Under
generalised-alpha, which hardly damps, it adds system identification with viscosity and RAFL on top of it. Markers are
weighted by their uncertainty. Resumable: results under --out are not computed again.
"""

import argparse
from pathlib import Path

import pandas as pd
from commands import run_command

SPECIMENS = Path(__file__).parents[2] / "datasets" / "specimens"
FIT_OPTIONS: dict[str, list[object]] = {  # of rafl-fit, by model
    "sysid": ["--method", "sysid", "--epochs", 25],
    "sysid-e": ["--method", "sysid-e", "--epochs", 15],
    "auto": [],
    "rafl": ["--method", "rafl", "--epochs", 25],
    "sysid-damping": ["--method", "sysid-damping", "--epochs", 25, "--integrator", "generalised-alpha"],
    "rafl-from-sysid": ["--method", "rafl", "--epochs", 25],
}
START_MODELS = {"rafl-from-sysid": "sysid-damping"}  # the model whose run a fit starts from
TABLE_COLUMNS = ["original", "original (paper preset)", *FIT_OPTIONS]


def build_dataset(specimen: Path, recordings: Path, out: Path, name: str) -> Path:
    path = out / f"{name}.h5"
    if not path.exists():
        table = out / "recordings.csv"
        run_command("rafl-capture", specimen, recordings, "--recordings", table, "--out", path, "--tolerance-mm", 8)
    return path


def held_out_errors(recording: str, table: pd.DataFrame, recordings: Path, out: Path) -> pd.DataFrame:
    """Errors on one recording of models fitted to the others."""
    out.mkdir(parents=True, exist_ok=True)
    split = table["recording"].eq(recording).map({True: "test", False: "train"})
    table.assign(split=split).to_csv(out / "recordings.csv", index=False)
    specimen = SPECIMENS / "clamped_beam.yaml"
    dataset = build_dataset(specimen, recordings, out, "clamped_beam")
    for name, options in FIT_OPTIONS.items():
        run = out / name
        if not (run / "finished").exists():
            resume = ["--resume"] if (run / "checkpoint.pt").exists() else []
            if run.exists() and not resume:
                for path in run.iterdir():
                    path.unlink()
            start = ["--from", out / START_MODELS[name]] if name in START_MODELS else []
            run_command("rafl-fit", dataset, "--out", run, "--by-sigma", *options, *start, *resume)
            (run / "finished").touch()
    if not (out / "errors.csv").exists():
        run_command("rafl-eval", *(out / name for name in FIT_OPTIONS), dataset, "--out", out)
    paper = out / "paper"
    if not (paper / "errors.csv").exists():
        text = specimen.read_text().replace("preset: physical", "preset: paper")
        (out / "paper.yaml").write_text(text)
        paper_dataset = build_dataset(out / "paper.yaml", recordings, out, "paper")
        run_command("rafl-eval", out / "sysid", paper_dataset, "--out", paper)
    errors, paper_errors = pd.read_csv(out / "errors.csv"), pd.read_csv(paper / "errors.csv")
    # rafl-eval appends the folder to the name of a method that occurs twice.
    errors["method"] = errors["method"].str.replace(r"^.* \((.*)\)$", r"\1", regex=True)
    baseline = paper_errors[paper_errors["method"] == "original"].assign(method="original (paper preset)")
    both = pd.concat([errors, baseline])
    return both[both["split"] == "test"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="folder of the beam's recordings")
    parser.add_argument("--out", type=Path, required=True, help="folder for datasets, runs and errors")
    options = parser.parse_args()
    table = pd.read_csv(SPECIMENS / "clamped_beam_recordings.csv")
    errors = pd.concat(
        held_out_errors(name, table, options.recordings, options.out / name) for name in table["recording"]
    )
    value = errors["mean_mm"].map("{:.3f}".format) + " +- " + errors["std_mm"].map("{:.3f}".format)
    summary = errors.assign(error=value).pivot(index="recording", columns="method", values="error")
    summary.loc["mean"] = errors.groupby("method")["mean_mm"].mean().map("{:.3f}".format)
    errors.to_csv(options.out / "errors.csv", index=False)
    print("marker error on the recording held out, mean +- standard deviation [mm]")
    print(summary[TABLE_COLUMNS].to_string())


if __name__ == "__main__":
    main()
