"""Make the pictures of the gallery from the output of the demonstration: python docs/gallery.py build/demo."""

import base64
import io
import re
import sys
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image

import rafl

matplotlib.use("Agg")
import matplotlib.pyplot as plt

GALLERY = Path(__file__).parent / "gallery"
WIDEST = 1000  # px
# Picture of the gallery: report of the demonstration, number of the image in it.
FROM_REPORTS = {
    "tracks-timeline": ("tracks/report.html", 0),
    "tracks-first-frame": ("tracks/report.html", 1),
    "tracks-residuals": ("tracks/report.html", 2),
    "dataset-mesh": ("canonical.html", 0),
    "dataset-first-frames": ("canonical.html", 1),
}


def images(report: Path) -> list[bytes]:
    """The images embedded in a report, in order."""
    found = re.findall(r'src="data:image/[a-z]+;base64,([^"]+)"', report.read_text(encoding="utf-8"))
    return [base64.b64decode(text) for text in found]


def save(image: Image.Image, name: str) -> None:
    """Save a picture, at most WIDEST wide, with 128 colours."""
    if image.width > WIDEST:
        image = image.resize((WIDEST, round(image.height * WIDEST / image.width)), Image.Resampling.LANCZOS)
    image.convert("RGB").quantize(128).save(GALLERY / f"{name}.png", optimize=True)


def motion(demo: Path) -> Image.Image:
    """Height of the outermost marker in a test recording: recorded, baseline simulator, fitted model."""
    dataset = rafl.read_dataset(demo / "canonical.h5")
    name = dataset.split("test")[0]
    recorded = dataset.trajectories[name]
    tip = int(np.argmax(dataset.markers.rest[:, 0]))
    figure, axes = plt.subplots(figsize=(8, 3.2), dpi=120, layout="constrained")
    axes.plot(recorded.time, 1e3 * recorded.markers[:, tip, 2], "k.", markersize=5, label="recorded marker")
    for label, model, style in (
        ("baseline simulator", None, "C1--"),
        ("fitted model", rafl.load_model(demo / "run"), "C0-"),
    ):
        simulated = rafl.simulate(dataset, model, [name])[name]
        axes.plot(simulated.time, 1e3 * simulated.markers[:, tip, 2], style, label=label)
    axes.set(xlabel="time [s]", ylabel="height of the outermost marker [mm]")
    axes.legend(loc="center right", frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer)
    plt.close(figure)
    return Image.open(buffer)


def main(demo: Path) -> None:
    """Make all pictures."""
    GALLERY.mkdir(exist_ok=True)
    for name, (report, number) in FROM_REPORTS.items():
        save(Image.open(io.BytesIO(images(demo / report)[number])), name)
    save(motion(demo), "motion")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
