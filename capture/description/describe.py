"""The description of a specimen from a recording of it at rest: names and places of its dots, and its stiffness."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.description.alignment import Alignment, align_with_surface, find_pose
from rafl.capture.description.naming import dots_by_row, faces_of, name_dots
from rafl.capture.description.still import Dots, dots_at_rest
from rafl.capture.description.undeformed import PLACED_SIGMA, Shape, Undeformed, carry_back, find_undeformed
from rafl.capture.registration.places import MODULUS_SIGMA
from rafl.capture.registration.recording import Recording
from rafl.capture.registration.rigid import MARKERS_PER_OUTLIER, MIN_MARKERS
from rafl.capture.specimen.geometry import read_surface
from rafl.capture.specimen.specimen import Body, build_specimen
from rafl.common.errors import InputError
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.linking.naming import is_row_name

Array = NDArray[Any]

MAX_POSE_SIGMA = 1e-3  # largest standard deviation of a dot's place that an unknown frame may leave [m]
UNKNOWN_POSE_SIGMA = 1e-2  # of the height and tilt of a body whose frame is found with E in turn [m]
POSE_ITERATIONS = 3  # of the frame and E in turn
MAX_DISTANCE = 3e-3  # of a dot from every face [m]: half a millimetre of the hand, and a body cast not quite to size


@dataclass(frozen=True)
class Description:
    """A specimen as found in a recording.

    Attributes:
        shape: of the undeformed body.
        dots: as recorded, without those left out.
        names: of the markers; those of the file, unless these are of row and column, (M).
        listed: order of the markers in a specimen file, (M).
        undeformed: their places, and the body as recorded.
        youngs_modulus: [Pa].
        left_out: dots that lie on no face, by their names in the file, and their distances from the nearest [m].
        prior_sigma: standard deviation of log E of the assumed material.
    """

    shape: Shape
    dots: Dots
    names: tuple[str, ...]
    listed: NDArray[np.int64]
    undeformed: Undeformed
    youngs_modulus: float
    left_out: dict[str, float]
    prior_sigma: float

    @property
    def sag_tells(self) -> bool:
        """Whether E follows from the sag rather than from the assumed material."""
        return self.undeformed.modulus_sigma < 0.5 * self.prior_sigma

    @property
    def faces(self) -> list[str]:
        """The face of each dot."""
        return faces_of(self.undeformed.carried.normal)


def describe(
    recording: Recording, body: Body, folder: Path, lying: bool, label: str, modulus_sigma: float = MODULUS_SIGMA
) -> Description:
    """Find the dots of a specimen at rest, and their places on its undeformed body.

    Args:
        recording: of the specimen at rest; in another frame than the specimen's, the dots must tell where the body is.
        body: shape, assumed material and clamp.
        folder: that the file of a surface is relative to.
        lying: whether the specimen lies flat, so that gravity does not bend it; else it hangs on its clamp.
        label: of the recording, for messages.
        modulus_sigma: standard deviation of log E of the assumed material.

    Raises:
        InputError: the specimen never rests, or its dots are not on the body.
        SimulationError: the body's equilibrium cannot be found.
    """
    specimen = build_specimen(body, MarkerLayout.of([]), folder, "")
    surface = body.geometry.surface
    shape = Shape(specimen.mesh, None if surface is None else read_surface(folder / surface))
    simulator = specimen.simulator(0.01)
    if lying:
        simulator = replace(simulator, gravity=(0.0, 0.0, 0.0))
    dots = dots_at_rest(recording, label)
    dots = dots.select(np.array([name not in specimen.clamp_layout.names for name in dots.names]))
    left_out: dict[str, float] = {}
    q = simulator.equilibrium(simulator.weight[None], label=f"{label}: the specimen under its own weight")[0]
    excess = _excess(shape, q, dots, modulus_sigma)
    placed = recording.in_specimen_frame or float(np.median(excess)) < MAX_DISTANCE
    if not placed:
        alignment = find_pose(shape, q, dots)
        dots = replace(dots, position=alignment.pose.apply(dots.position))
        excess = _excess(shape, q, dots, modulus_sigma)
        if float(np.median(excess)) < MAX_DISTANCE:
            _check_pose(alignment, faces_of(carry_back(shape, q, dots).normal), label)
    dots = _dots_on_body(shape, q, dots, excess, left_out, label)
    undeformed = find_undeformed(shape, simulator, dots, modulus_sigma, PLACED_SIGMA if placed else UNKNOWN_POSE_SIGMA)
    if not placed:
        for _ in range(POSE_ITERATIONS):
            alignment = align_with_surface(shape, undeformed.q, dots)
            dots = replace(dots, position=alignment.pose.apply(dots.position))
            undeformed = find_undeformed(shape, simulator, dots, modulus_sigma, UNKNOWN_POSE_SIGMA)
        undeformed = replace(undeformed, sigma=np.hypot(undeformed.sigma, alignment.sigma))
    kept = _dots_on_body(shape, undeformed.q, dots, undeformed.carried.distance, left_out, label)
    if len(kept.names) < len(dots.names):
        dots, undeformed = kept, find_undeformed(shape, simulator, kept, modulus_sigma)
    faces, rest = faces_of(undeformed.carried.normal), undeformed.carried.rest
    names, listed = dots.names, np.arange(len(dots.names))
    if recording.names is None:  # a reader of such files takes the markers in the order of the specimen's
        names = name_dots(faces, rest)
    elif all(is_row_name(name) for name in names):
        names, listed = name_dots(faces, rest), np.concatenate(dots_by_row(faces, rest))
    modulus = specimen.material.youngs_modulus * float(np.exp(undeformed.log_modulus))
    return Description(shape, dots, names, listed, undeformed, modulus, left_out, modulus_sigma)


def _excess(shape: Shape, q: Array, dots: Dots, modulus_sigma: float) -> Array:
    """Distances of dots from the body beyond what its sag may be off, by the uncertain E [m], (M)."""
    carried = carry_back(shape, q, dots)
    sag = np.linalg.norm(dots.position - carried.gap - carried.rest, axis=1)
    return np.asarray(carried.distance - modulus_sigma * sag)


def _check_pose(alignment: Alignment, faces: list[str], label: str) -> None:
    """Raise InputError if the dots do not tell where the body is."""
    if alignment.sigma.max() > MAX_POSE_SIGMA:
        raise InputError(
            f"{label}: expected a recording in the specimen's frame, or dots that tell where the body is, found "
            f"another frame and dots on {', '.join(sorted(set(faces)))} only; put dots on the tip and the "
            "top too, or set the origin of the motion capture at the lower corner of the clamped face (x from clamp to tip, y across, z up)"
        )


def _dots_on_body(shape: Shape, q: Array, dots: Dots, distance: Array, left_out: dict[str, float], label: str) -> Dots:
    """The dots that lie on the body; enters the others, if they are few, into `left_out`.

    Raises:
        InputError: many dots are far from the body.
    """
    far = distance > MAX_DISTANCE
    total = len(dots.names) + len(left_out)
    if far.sum() + len(left_out) > max(1, total // MARKERS_PER_OUTLIER) or (~far).sum() < MIN_MARKERS:
        worst = int(np.argmax(distance))
        found = (
            f"{label}: expected the dots within {1e3 * MAX_DISTANCE:g} mm of the body's faces, found {int(far.sum())} "
            f"of {total} farther off ({dots.names[worst]} by {1e3 * distance[worst]:.1f} mm)"
        )
        raise InputError(f"{found}; {_reason(shape, q, dots)}")
    left_out.update({dots.names[k]: float(distance[k]) for k in np.flatnonzero(far)})
    return dots.select(~far)


def _reason(shape: Shape, q: Array, dots: Dots) -> str:
    """Whether another place or another size of the body would put the dots on its faces, and what to do."""
    pose = align_with_surface(shape, q, dots).pose
    moved = pose.apply(dots.position)
    distance = carry_back(shape, q, replace(dots, position=moved)).distance
    if np.mean(distance > MAX_DISTANCE) <= 1.0 / MARKERS_PER_OUTLIER:
        x, y, z = 1e3 * (moved - dots.position).mean(axis=0)
        turn = np.degrees(np.arccos(np.clip((np.trace(pose.rotation) - 1.0) / 2.0, -1.0, 1.0)))
        return (
            f"moved by {x:.1f}, {y:.1f}, {z:.1f} mm along x, y, z and turned by {turn:.1f} degrees they would lie on "
            "it, so the world of the recording is not the specimen's frame (origin at the lower corner of the clamped "
            "face on the side of smallest y, x from clamp to tip, z up): calibrate with the board at that corner, or "
            "set the origin of the motion capture there"
        )
    spans = (
        " x ".join(f"{1e3 * span:.1f}" for span in np.ptp(p, axis=0)) for p in (dots.position, shape.mesh.vertices)
    )
    return (
        f"they span {next(spans)} mm along x, y, z and the body {next(spans)} mm, and at no other place would they lie "
        "on it: correct the size or shape of the body, or its calibration's unit"
    )
