"""What the results page shows: a summary as JSON, and the motion of each recording as bytes.

The numbers of a motion are rounded to 16 bits over the range of their array, so that a page with all of them can be
mailed: positions to about the 65,000th part of the specimen's size.
"""

import json
import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.data.dataset import Dataset
from rafl.evaluation.evaluation_file import Evaluation
from rafl.evaluation.metrics import Comparison
from rafl.evaluation.oscillation import most_active_coordinate
from rafl.evaluation.surface import Surface, SurfaceMotion
from rafl.evaluation.tables import page_tables

Array = NDArray[Any]

LARGEST_CODE, MISSING_CODE = 32767, -32768
MAX_CURVE_FRAMES = 300  # of an error over time in the summary
DIGITS = 4  # of an error in the summary


@dataclass(frozen=True)
class PageData:
    """What the page shows.

    Attributes:
        title: heading of the page.
        models: one line that describes the fitted models; empty for a dataset.
        recordings: one comparison for each; without simulations for a dataset.
        tables: see `page_tables`.
        note: on what is not there; empty if nothing is missing.
    """

    title: str
    models: str
    recordings: list[Comparison]
    tables: list[dict[str, Any]]
    note: str = ""

    @classmethod
    def of_evaluation(cls, evaluation: Evaluation, title: str) -> "PageData":
        """An evaluation under a title."""
        comparisons = evaluation.comparisons
        kept = sum(bool(item.motions) for item in comparisons)
        note = (
            f"The evaluation holds the bodies of {kept} of {len(comparisons)} recordings, and all markers and errors."
        )
        return cls(
            title, evaluation.models, comparisons, page_tables(comparisons), note if kept < len(comparisons) else ""
        )

    @classmethod
    def of_dataset(cls, dataset: Dataset) -> "PageData":
        """The recordings of a dataset, with the body of each first frame."""
        mesh = dataset.simulator.mesh
        surface = Surface.of(mesh)
        recordings = [
            Comparison(
                dataset=dataset.name,
                recording=name,
                split=item.split,
                time=item.time,
                recorded=np.where(item.valid[..., None], item.markers, np.nan),
                simulated={},
                distances={},
                rest_distances={},
                marker_names=dataset.markers.names,
                surface=surface,
                motions={"body of the first frame": SurfaceMotion.of(mesh, item.q[None])},
                strains={},
            )
            for name, item in dataset.trajectories.items()
        ]
        note = (
            "A dataset holds no simulation. The body is the one fitted to the first frame. rafl-fit fits a model, and "
            "rafl-eval simulates the recordings with it and with the baseline simulator."
        )
        return cls(f"Dataset {dataset.name}", "", recordings, [], note)

    @property
    def methods(self) -> list[str]:
        """Names of all methods, the baseline simulator first."""
        return list(dict.fromkeys(method for item in self.recordings for method in (*item.errors, *item.motions)))

    def summary(self) -> dict[str, Any]:
        """What the page shows before a motion is loaded; plain values for JSON."""
        return {
            "title": self.title,
            "models": self.models,
            "note": self.note,
            "methods": self.methods,
            "tables": self.tables,
            "recordings": [_described(item) for item in self.recordings],
        }


def _described(item: Comparison) -> dict[str, Any]:
    """A recording in the summary: names, mean errors [mm], and the error over time [mm]."""
    stride = max(math.ceil(len(item.error_time) / MAX_CURVE_FRAMES), 1)
    return {
        "dataset": item.dataset,
        "recording": item.recording,
        "split": item.split,
        "frames": len(item.time),
        "mean": {method: 1e3 * float(errors.mean()) for method, errors in item.errors.items()},
        "std": {method: 1e3 * float(errors.std()) for method, errors in item.errors.items()},
        "curve": {
            "time": [round(float(time), 6) for time in item.error_time[::stride]],
            "errors": {
                method: [float(f"{1e3 * error:.{DIGITS}g}") for error in errors[::stride]]
                for method, errors in item.errors.items()
            },
        },
    }


def pack_motion(item: Comparison, max_frames: int | None = None) -> bytes:
    """The motion of a recording, for the page.

    Four bytes with the length of a header as an unsigned integer, the header as JSON, and the arrays that it lists,
    compressed; see `_encode`.

    Args:
        item: the recording.
        max_frames: frames to keep at most; None keeps all. More are thinned out evenly.
    """
    stride = 1 if max_frames is None else math.ceil(len(item.time) / max_frames)
    marker, axis = most_active_coordinate(item.recorded)
    arrays: list[tuple[str, str, Array]] = [("recorded", "", item.recorded)]
    for method, motion in item.motions.items():
        arrays += [("vertices", method, motion.vertices), ("strain", method, motion.strain)]
        if motion.force is not None:
            arrays.append(("force", method, motion.force))
    for method, markers in item.simulated.items():
        arrays += [("markers", method, markers), ("error", method, item.distances[method])]
    described, contents = [], []
    for key, method, values in arrays:
        about, content = _encode(values[::stride])
        described.append({"key": key, "method": method, **about, "bytes": len(content)})
        contents.append(content)
    header = {
        "stride": stride,
        "time": item.time[::stride].tolist(),
        "markers": list(item.marker_names),
        "faces": item.surface.faces.tolist(),
        "cells": item.surface.cells.tolist(),
        "most_active": [int(marker), int(axis)],
        "arrays": described,
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    return b"".join([len(text).to_bytes(4, "little"), text, *contents])


def _encode(values: Array) -> tuple[dict[str, Any], bytes]:
    """An array as 16-bit codes: value = offset + scale * code; -32768 for NaN.

    Stored are the differences of the codes along the first axis, modulo 2^16, first the low bytes of all, then the high
    ones, by zlib.
    """
    finite = np.isfinite(values)
    known = values[finite]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    offset, scale = 0.5 * (low + high), (high - low) / (2 * LARGEST_CODE) or 1.0
    codes = np.full(values.shape, MISSING_CODE, dtype=np.int16)
    codes[finite] = np.rint((known.astype(np.float64) - offset) / scale).clip(-LARGEST_CODE, LARGEST_CODE)
    changes = codes.astype("<u2")
    changes[1:] -= changes[:-1].copy()
    planes = np.ascontiguousarray(changes).view(np.uint8).reshape(-1, 2).T
    return {"shape": list(values.shape), "offset": offset, "scale": scale}, zlib.compress(planes.tobytes(), 6)
