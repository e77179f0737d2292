"""Leave-one-recording-out on the real beam: original, SysID and RAFL on the recording each never saw.

    python tests/bench/clamped_beam.py ../shared/real/clamped_beam --out build/clamped_beam

Resumable: what stands under --out is not computed again.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import pandas as pd

SPECIMENS = Path(__file__).parents[2] / "datasets" / "specimens"
EPOCHS = 25


def command(name: str, *arguments: object) -> None:
    subprocess.run([str(Path(sys.executable).parent / name), *map(str, arguments)], check=True)


def hold_out(recording: str, table: pd.DataFrame, recordings: Path, out: Path) -> pd.DataFrame:
    """Errors on one recording of models fitted to the others."""
    out.mkdir(parents=True, exist_ok=True)
    split = table["recording"].eq(recording).map({True: "test", False: "train"})
    table.assign(split=split).to_csv(out / "recordings.csv", index=False)
    dataset = out / "clamped_beam.h5"
    if not dataset.exists():
        command(
            "rafl-capture", SPECIMENS / "clamped_beam.yaml", recordings,
            "--recordings", out / "recordings.csv", "--out", dataset, "--tolerance-mm", 8,
        )  # fmt: skip
    for method in ("sysid", "rafl"):
        run = out / method
        if not (run / "finished").exists():
            going_on = ["--resume"] if (run / "checkpoint.pt").exists() else []
            if run.exists() and not going_on:
                for path in run.iterdir():
                    path.unlink()
            command("rafl-fit", dataset, "--method", method, "--out", run, "--epochs", EPOCHS, *going_on)
            (run / "finished").touch()
    command("rafl-eval", out / "rafl", out / "sysid", dataset, "--out", out)
    errors = pd.read_csv(out / "errors.csv")
    return errors[errors["split"] == "test"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    table = pd.read_csv(SPECIMENS / "clamped_beam_recordings.csv")
    found = pd.concat(hold_out(name, table, arguments.recordings, arguments.out / name) for name in table["recording"])
    value = found["mean_mm"].map("{:.3f}".format) + " +- " + found["std_mm"].map("{:.3f}".format)
    summary = found.assign(error=value).pivot(index="recording", columns="method", values="error")
    summary.loc["mean"] = found.groupby("method")["mean_mm"].mean().map("{:.3f}".format)
    found.to_csv(arguments.out / "errors.csv", index=False)
    print(summary[["original", "sysid", "rafl"]].to_string())


if __name__ == "__main__":
    main()
