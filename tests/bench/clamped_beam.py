"""Leave-one-recording-out on the real beam: every method on the recording it never saw.

    python tests/bench/clamped_beam.py ../shared/real/clamped_beam --out build/clamped_beam

Original with both presets, SysID (E and nu; E alone), RAFL; and where the time stepping does not damp, SysID with
viscosity and RAFL on top of it. Markers count by their uncertainty.
Resumable: what stands under --out is not computed again.
"""

import argparse
from pathlib import Path

import pandas as pd
from commands import command

SPECIMENS = Path(__file__).parents[2] / "datasets" / "specimens"
MODELS: dict[str, list[object]] = {  # rafl-fit's options
    "sysid": ["--method", "sysid", "--epochs", 25],
    "sysid-e": ["--method", "sysid-e", "--epochs", 15],
    "rafl": ["--epochs", 25],
    "sysid-damping": ["--method", "sysid-damping", "--epochs", 25, "--integrator", "generalised-alpha"],
    "rafl-from-sysid": ["--epochs", 25],
}
STARTS = {"rafl-from-sysid": "sysid-damping"}  # whose run it goes on from
COLUMNS = ["original", "original (paper preset)", *MODELS]


def dataset_of(specimen: Path, recordings: Path, out: Path, name: str) -> Path:
    path = out / f"{name}.h5"
    if not path.exists():
        table = out / "recordings.csv"
        command("rafl-capture", specimen, recordings, "--recordings", table, "--out", path, "--tolerance-mm", 8)
    return path


def hold_out(recording: str, table: pd.DataFrame, recordings: Path, out: Path) -> pd.DataFrame:
    """Errors on one recording of models fitted to the others."""
    out.mkdir(parents=True, exist_ok=True)
    split = table["recording"].eq(recording).map({True: "test", False: "train"})
    table.assign(split=split).to_csv(out / "recordings.csv", index=False)
    specimen = SPECIMENS / "clamped_beam.yaml"
    dataset = dataset_of(specimen, recordings, out, "clamped_beam")
    for name, options in MODELS.items():
        run = out / name
        if not (run / "finished").exists():
            going_on = ["--resume"] if (run / "checkpoint.pt").exists() else []
            if run.exists() and not going_on:
                for path in run.iterdir():
                    path.unlink()
            start = ["--from", out / STARTS[name]] if name in STARTS else []
            command("rafl-fit", dataset, "--out", run, "--by-sigma", *options, *start, *going_on)
            (run / "finished").touch()
    if not (out / "errors.csv").exists():
        command("rafl-eval", *(out / name for name in MODELS), dataset, "--out", out)
    paper = out / "paper"
    if not (paper / "errors.csv").exists():
        text = specimen.read_text().replace("preset: physical", "preset: paper")
        (out / "paper.yaml").write_text(text)
        other = dataset_of(out / "paper.yaml", recordings, out, "paper")
        command("rafl-eval", out / "sysid", other, "--out", paper)
    errors, others = pd.read_csv(out / "errors.csv"), pd.read_csv(paper / "errors.csv")
    # Where a method occurs twice rafl-eval names it with its folder.
    errors["method"] = errors["method"].str.replace(r"^.* \((.*)\)$", r"\1", regex=True)
    others = others[others["method"] == "original"].assign(method="original (paper preset)")
    both = pd.concat([errors, others])
    return both[both["split"] == "test"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    table = pd.read_csv(SPECIMENS / "clamped_beam_recordings.csv")
    found = pd.concat(hold_out(name, table, arguments.recordings, arguments.out / name) for name in table["recording"])
    value = found["mean_mm"].map("{:.3f}".format) + " +- " + found["std_mm"].map("{:.3f}".format)
    summary = found.assign(error=value).pivot(index="recording", columns="method", values="error")
    summary.loc["mean"] = found.groupby("method")["mean_mm"].mean().map("{:.3f}".format)
    found.to_csv(arguments.out / "errors.csv", index=False)
    print(summary[COLUMNS].to_string())


if __name__ == "__main__":
    main()
