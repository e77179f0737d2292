"""`evaluation.h5` of a run folder (see datasets/README.md): what `rafl-eval` simulated, to be looked at again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rafl.common.arrays import ArrayFormat, read_arrays
from rafl.common.errors import InputError
from rafl.common.hdf5_files import read_hdf5, write_hdf5
from rafl.common.version import VERSION
from rafl.common.yaml_files import check_format
from rafl.data.dataset import SPLITS
from rafl.data.strain_range import StrainRange
from rafl.evaluation.metrics import BASELINE, Comparison
from rafl.evaluation.surface import Surface, SurfaceMotion

Array = NDArray[Any]

EVALUATION_FILE = "evaluation.h5"
FORMAT = "rafl-evaluation/1"
UNITS = "SI: m, s, N; specimen frame"
MAX_MOTION_BYTES = 400_000_000  # of all bodies in a file, uncompressed; further recordings have none
LABEL, ADVICE = "an evaluation written by rafl-eval", "run rafl-eval again"  # in messages about unreadable files
# T: frames, M: markers, B, S, C: vertices, faces and cells at the boundary.
RECORDING_ARRAYS = {
    "time": ArrayFormat(("T",)),
    "recorded": ArrayFormat(("T", "M", 3), finite=False),
    "marker_names": ArrayFormat(("M",), "text"),
    "faces": ArrayFormat(("S", 4), "integer", low=0),
    "cells": ArrayFormat(("S",), "integer", low=0),
}
METHOD_ARRAYS = {
    "markers": ArrayFormat(("T", "M", 3)),
    "distances": ArrayFormat(("T", "M"), finite=False, low=0.0),
    "rest_distances": ArrayFormat(("M",), finite=False, low=0.0, optional=True),  # missing in earlier files
    "vertices": ArrayFormat(("T", "B", 3), optional=True),
    "strain": ArrayFormat(("T", "C"), low=0.0, optional=True),
    "force": ArrayFormat(("T-1", "B"), low=0.0, optional=True),
    "strain_range": ArrayFormat((2,), low=0.0),
}


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    Attributes:
        comparisons: one for each recording.
        models: one line that describes the fitted models.
    """

    comparisons: list[Comparison]
    models: str


def write_evaluation(path: Path, evaluation: Evaluation) -> None:
    """Write an evaluation as a whole. Bodies beyond `MAX_MOTION_BYTES` are left out, those of test recordings last.

    Raises:
        InputError: the file cannot be written.
    """
    kept = _recordings_with_bodies(evaluation.comparisons)
    with write_hdf5(path, read_evaluation) as file:
        file.attrs.update(
            {"format": FORMAT, "software": f"rafl {VERSION}", "units": UNITS, "models": _text(evaluation.models)}
        )
        for number, item in enumerate(evaluation.comparisons):
            group = file.create_group(f"recordings/{number}")
            group.attrs.update({"dataset": item.dataset, "recording": item.recording, "split": item.split})
            group["time"] = item.time
            group["marker_names"] = np.array(item.marker_names, dtype=h5py.string_dtype())
            group["faces"], group["cells"] = item.surface.faces, item.surface.cells
            _write_array(group, "recorded", item.recorded)
            for index, (method, distances) in enumerate(item.distances.items()):
                own = group.create_group(f"methods/{index}")
                own.attrs["method"] = _text(method)
                own["strain_range"] = [item.strains[method].strain, item.strains[method].rate]
                _write_array(own, "markers", item.simulated[method])
                _write_array(own, "distances", distances)
                _write_array(own, "rest_distances", item.rest_distances[method])
                motion = vars(item.motions[method]) if number in kept else {}
                for key, value in motion.items():
                    if value is not None:
                        _write_array(own, key, value)


def _recordings_with_bodies(comparisons: list[Comparison]) -> set[int]:
    """Numbers of the recordings whose bodies are written."""
    kept: set[int] = set()
    left = MAX_MOTION_BYTES
    for number in sorted(range(len(comparisons)), key=lambda number: comparisons[number].split != "test"):
        arrays = [array for motion in comparisons[number].motions.values() for array in vars(motion).values()]
        left -= sum(array.nbytes for array in arrays if array is not None)
        if arrays and left >= 0:
            kept.add(number)
    return kept


def _text(name: str) -> str:
    """A name that may hold bytes of a folder's name that are no UTF-8, as text."""
    return name.encode("utf-8", "backslashreplace").decode()


def _write_array(group: h5py.Group, key: str, value: Array) -> None:
    group.create_dataset(key, data=value.astype(np.float32), shuffle=True, compression="gzip", compression_opts=1)


def read_evaluation(path: Path) -> Evaluation:
    """Read and check an evaluation.

    Raises:
        InputError: no such file, no evaluation, a newer version, or a damaged or inconsistent part.
    """
    with read_hdf5(path, LABEL, ADVICE) as file:
        check_format(str(file.attrs.get("format", "")), FORMAT, path)
        groups = file["recordings"]
        comparisons = [_read(groups[key], f"recordings/{key}") for key in sorted(groups, key=int)]
        methods = {item.dataset: set(item.distances) for item in comparisons}
        for number, item in enumerate(comparisons):
            if set(item.distances) != methods[item.dataset]:
                raise ValueError(f"recordings/{number}: expected the methods of the dataset's other recordings")
        models = str(file.attrs["models"])
    if not comparisons:
        raise InputError(f"expected at least one recording in {path}, found none; {ADVICE}")
    return Evaluation(comparisons, models)


def _read(group: h5py.Group, label: str) -> Comparison:
    lengths: dict[str, int] = {}
    found = read_arrays(group, RECORDING_ARRAYS, lengths, f"{label}/")
    lengths["T-1"] = lengths["T"] - 1
    methods = {}
    for key in sorted(group["methods"], key=int):
        own = group["methods"][key]
        method = str(own.attrs["method"])
        if method in methods:
            raise ValueError(f"{label}: expected methods that differ, found {method!r:.80} twice")
        methods[method] = read_arrays(own, METHOD_ARRAYS, lengths, f"{label}/methods/{key}/")
    if BASELINE not in methods:
        raise ValueError(f"{label}: expected the method {BASELINE}, found none")
    names = {key: str(group.attrs[key]) for key in ("dataset", "recording", "split")}
    if names["split"] not in SPLITS:
        raise ValueError(f"{label}: expected split {', '.join(SPLITS)}, found {names['split']!r:.80}")
    bodies = [{"vertices", "strain"} <= set(own) for own in methods.values()]
    if any(bodies) != all(bodies):
        raise ValueError(f"{label}: expected the bodies of all methods or of none")
    for key, bound in (("faces", "B"), ("cells", "C")):
        if not found[key].size or (all(bodies) and found[key].max() >= lengths[bound]):
            raise ValueError(f"{label}/{key}: expected indices below {lengths.get(bound, 0)}")
    seen = [np.isfinite(own["distances"]) for own in methods.values()]
    alike = all((each == seen[0]).all() for each in seen)
    if not (alike and seen[0].any()) or (np.diff(found["time"]) <= 0).any():
        raise ValueError(f"{label}: expected markers that are seen, the same for all methods, at times that grow")
    return Comparison(
        **names,
        time=found["time"],
        recorded=found["recorded"],
        simulated={method: own["markers"] for method, own in methods.items()},
        distances={method: own["distances"] for method, own in methods.items()},
        rest_distances={
            method: own.get("rest_distances", np.full(lengths["M"], np.nan)) for method, own in methods.items()
        },
        marker_names=found["marker_names"],
        surface=Surface(found["faces"], found["cells"]),
        motions={method: _motion(own) for method, own in methods.items() if all(bodies)},
        strains={method: StrainRange(*own["strain_range"].tolist()) for method, own in methods.items()},
    )


def _motion(arrays: dict[str, Array]) -> SurfaceMotion:
    force = arrays.get("force")
    return SurfaceMotion(
        arrays["vertices"].astype(np.float32),
        arrays["strain"].astype(np.float32),
        None if force is None else force.astype(np.float32),
    )
