"""One specimen's mesh, markers and recorded trajectories."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.common.arrays import ArrayFormat, check_shape, check_values
from rafl.common.names import check_distinct, check_names, check_visible
from rafl.data.markers import Markers
from rafl.data.views import VIEW_ARRAYS, View
from rafl.simulation.newton import MAX_EDGE_CHANGE
from rafl.simulation.rollout import Start
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]

SPLITS = ("train", "val", "test")
THROUGH_MODEL = "through the model"  # begins the description of a registration that rests on the assumed material
# Largest relative error of frame times against an even time grid, and of one recording's time step against another's.
MAX_RELATIVE_TIME_ERROR = 5e-3
# Of a camera's measurement to its row [frames]: half a frame if its clock is known, and what it was found late.
MAX_LAG = 2.0
MIN_VOLUME = 0.01  # of a cell in a first frame, as a share of that at rest; rubber keeps nearly all
MIN_FIXED, MIN_SPREAD = 3, 1e-6  # number of fixed vertices; their spread across a line, as a share of that along it
# The arrays of a dataset and of its file. N: nodes, E: elements, F: fixed nodes, M: markers, T: frames.
MESH_ARRAYS = {
    "vertices": ArrayFormat(("N", 3)),
    "hexes": ArrayFormat(("E", 8), "integer", low=0),
    "fixed": ArrayFormat(("F",), "integer", low=0),
}
MARKER_ARRAYS = {
    "rest": ArrayFormat(("M", 3)),
    "quad": ArrayFormat(("M", 4), "integer", low=0),
    "weights": ArrayFormat(("M", 4)),
    "normal_offset": ArrayFormat(("M",)),
    "moved": ArrayFormat(("M", 3), optional=True),  # of markers whose places were found, not as described
    "place_sigma": ArrayFormat(("M", 3), low=0.0, optional=True),
}
RECORDING_ARRAYS = {
    "time": ArrayFormat(("T",)),
    "markers": ArrayFormat(("T", "M", 3), finite=False),
    "valid": ArrayFormat(("T", "M"), "truth"),
    "sigma": ArrayFormat(("T", "M", 3), finite=False, low=0.0),
    "load": ArrayFormat(("N", 3)),
    "added_mass": ArrayFormat(("N",), low=0.0),
}
INITIAL_ARRAYS = dict.fromkeys(("q", "v", "virtual_force"), ArrayFormat(("N", 3)))


@dataclass(frozen=True)
class Trajectory:
    """One recording of the specimen's markers, in the specimen frame.

    Attributes:
        time: [s], (T).
        markers: positions [m], (T, M, 3), NaN where not valid.
        valid: whether a marker was observed, (T, M).
        sigma: [m], (T, M, 3); infinite where an axis was not observed.
        q, v: initial mesh positions [m] and velocities [m/s], (N, 3).
        virtual_force: nodal forces that balance the first frame; they vanish at the release [N], (N, 3).
        load: constant nodal forces during the motion, without gravity [N], (N, 3).
        added_mass: attached mass that moves with the nodes [kg], (N).
        split: `train`, `val` or `test`.
        attributes: plain values for readers of the file: load_g, registration, fit residual, sources.
        views: what each camera measured, by its name; empty where only positions are known.
    """

    time: Array
    markers: Array
    valid: NDArray[np.bool_]
    sigma: Array
    q: Array
    v: Array
    virtual_force: Array
    load: Array
    added_mass: Array
    split: str
    attributes: dict[str, object] = field(default_factory=dict)
    views: dict[str, View] = field(default_factory=dict)

    @property
    def has_pixels(self) -> bool:
        """Whether a camera saw a marker."""
        return any(bool(view.seen.any()) for view in self.views.values())

    def first_frames(self, frames: int) -> "Trajectory":
        """The recording with only its leading frames."""
        arrays = {key: getattr(self, key)[:frames] for key in ("time", "markers", "valid", "sigma")}
        views = {name: view.select_frames(slice(frames)) for name, view in self.views.items()}
        return replace(self, **arrays, views=views)


@dataclass(frozen=True)
class Dataset:
    """One specimen and its recordings.

    Attributes:
        name: of the specimen.
        simulator: mesh, assumed material, fixed nodes and time step.
        markers: embedded in the mesh.
        trajectories: by recording.
        recipe: text of the files that the dataset was built from.
    """

    name: str
    simulator: Simulator
    markers: Markers
    trajectories: dict[str, Trajectory]
    recipe: str = ""

    def __repr__(self) -> str:
        return (
            f"Dataset({self.name!r}, {len(self.trajectories)} recordings, {len(self.markers.names)} markers, "
            f"{len(self.simulator.mesh.vertices)} vertices)"
        )

    def on_device(self, device: str) -> "Dataset":
        """The dataset with its simulator on a device; see `rafl.simulation.simulator.Simulator.on_device`.

        Raises:
            InputError: there is no such device.
        """
        return replace(self, simulator=self.simulator.on_device(device))

    def first_frames(self, frames: int) -> "Dataset":
        """The dataset with only the leading frames of each recording; with 0, all of them."""
        if frames == 0:
            return self
        return replace(self, trajectories={name: item.first_frames(frames) for name, item in self.trajectories.items()})

    def split(self, name: str) -> list[str]:
        """Names of the recordings of a split, in order."""
        return [key for key, item in self.trajectories.items() if item.split == name]

    @property
    def registered_through_model(self) -> list[str]:
        """Names of the recordings whose frame was found through the assumed material."""
        found = {name: str(item.attributes.get("registration", "")) for name, item in self.trajectories.items()}
        return [name for name, method in found.items() if method.startswith(THROUGH_MODEL)]

    def start(self, recordings: list[str]) -> Start:
        """Initial states and loads of the named recordings as one batch."""
        chosen = [self.trajectories[name] for name in recordings]
        return Start(
            torch.from_numpy(np.stack([item.q for item in chosen])),
            torch.from_numpy(np.stack([item.v for item in chosen])),
            torch.from_numpy(np.stack([item.load for item in chosen])),
            torch.from_numpy(np.stack([item.added_mass for item in chosen])),
            tuple(recordings),
        )

    def check(self) -> None:
        """Check that shapes, indices, times and values are consistent.

        Raises:
            ValueError: a part is not; names it.
        """
        self._check_names()
        mesh, lengths = self.simulator.mesh, {"M": len(self.markers.names)}
        arrays = {"vertices": mesh.vertices, "hexes": mesh.hexes, "fixed": self.simulator.fixed}
        _check_arrays("mesh/", arrays, MESH_ARRAYS, lengths)
        _check_arrays("markers/", vars(self.markers), MARKER_ARRAYS, lengths)
        nodes = len(mesh.vertices)
        for label, indices in (("hexes", mesh.hexes), ("fixed", self.simulator.fixed), ("quad", self.markers.quad)):
            _require(bool((indices < nodes).all()), label, f"vertices from 0 to {nodes - 1}")
        _require(mesh.quadrature.volume.size > 0, "mesh/hexes", "one cell or more")  # none of them inverted
        error = np.abs(self.markers.weights.sum(axis=1) - 1.0)
        _require(bool((error < 1e-9).all()), "markers/weights", "weights that add up to 1")
        embedded = self.markers.positions(torch.from_numpy(mesh.vertices))
        _require(bool(embedded.isfinite().all()), "markers/quad", "four different vertices of a face")
        for name, item in self.trajectories.items():
            self._check_trajectory(f"trajectories/{name}", item, {**lengths})

    def check_mechanics(self) -> None:
        """Check that consistent parts also make a body that is held, and first frames that it can be in.

        Raises:
            ValueError: a cell is there twice, the fixed vertices do not hold the body or are all of it, or a first
                frame has inverted, flat or torn cells.
        """
        mesh, fixed = self.simulator.mesh, self.simulator.fixed
        distinct = len(np.unique(np.sort(mesh.hexes, axis=1), axis=0)) == len(mesh.hexes)
        _require(distinct, "mesh/hexes", "every cell once, found one twice: it would be twice as stiff")
        _require(len(np.unique(fixed)) == len(fixed), "mesh/fixed", "every vertex once, found one twice")
        _require(len(fixed) < len(mesh.vertices), "mesh/fixed", "some vertices that move, found all of them fixed")
        spread = np.zeros(3)
        if len(fixed) >= MIN_FIXED:
            spread = np.linalg.svd(mesh.vertices[fixed] - mesh.vertices[fixed].mean(axis=0), compute_uv=False)
        held = bool(spread[1] > MIN_SPREAD * spread[0])
        _require(held, "mesh/fixed", f"{MIN_FIXED} vertices or more, not on one line, or else the body falls or turns")
        for name, item in self.trajectories.items():
            label, volume = f"trajectories/{name}/initial/q", mesh.deformed_volumes(item.q) / mesh.volumes
            _require(
                bool((volume > MIN_VOLUME).all()),
                label,
                f"cells of more than {MIN_VOLUME:g} of their volume at rest, found {volume.min():.3g} of cell "
                f"{volume.argmin()}, which is inverted or flat",
            )
            change = float(mesh.max_edge_change(item.q[None] - mesh.vertices)[0])
            expected = f"edges that change by less than {MAX_EDGE_CHANGE:g} times their length at rest"
            _require(change < MAX_EDGE_CHANGE, label, f"{expected}, found {change:.3g}")

    def _check_names(self) -> None:
        """Recordings name parts of the file. The other names are only printed, and older files have any."""
        try:
            check_names(self.trajectories)
        except ValueError as reason:
            raise ValueError(f"recordings: {reason}") from None
        for label, names in (("name", [self.name]), ("markers", self.markers.names)):
            try:
                for name in names:
                    check_visible(name)
                check_distinct(names)
            except ValueError as reason:
                raise ValueError(f"{label}: {reason}") from None

    def _check_trajectory(self, label: str, item: Trajectory, lengths: dict[str, int]) -> None:
        _check_arrays(f"{label}/", vars(item), RECORDING_ARRAYS | INITIAL_ARRAYS, lengths)
        frames = len(item.time)
        grid = self.simulator.time_step * np.arange(frames)
        steps = np.maximum(np.arange(frames), 1)
        even = np.abs(item.time - grid) <= MAX_RELATIVE_TIME_ERROR * self.simulator.time_step * steps
        _require(frames > 1 and bool(even.all()), f"{label}/time", "two or more even times from 0 on")
        observed = item.markers[item.valid]
        _require(bool(item.valid.any()), f"{label}/valid", "a marker that is seen, found none in any frame")
        _require(bool(np.isfinite(observed).all()), f"{label}/markers", "finite positions where valid")
        _require(bool((item.sigma[item.valid] > 0).all()), f"{label}/sigma", "more than 0 where valid")
        _require(item.split in SPLITS, f"{label}, split", f"{', '.join(SPLITS)}, found {item.split!r}")
        try:
            check_names(item.views)
        except ValueError as reason:
            raise ValueError(f"{label}/views: {reason}") from None
        for camera, view in item.views.items():
            own = f"{label}/views/{camera}"
            _check_arrays(f"{own}/", vars(view), VIEW_ARRAYS, {**lengths, "T": frames})
            view.check(own, np.where(item.valid[..., None], item.markers, np.nan))
            near = np.abs(view.lag) <= MAX_LAG * self.simulator.time_step
            _require(bool(near.all()), f"{own}/lag", f"times within {MAX_LAG:g} frames of the recording's")


def _check_arrays(
    label: str, arrays: Mapping[str, Any], formats: Mapping[str, ArrayFormat], lengths: dict[str, int]
) -> None:
    """Raise ValueError for an array that differs from its description, or is missing."""
    for key, expected in formats.items():
        array = arrays[key]
        if array is None and expected.optional:
            continue
        check_shape(f"{label}{key}", array, expected, lengths)
        check_values(f"{label}{key}", array, expected)


def _require(condition: bool, label: str, expected: str) -> None:
    if not condition:
        raise ValueError(f"{label}: expected {expected}")
