"""The description of a specimen from a recording of it at rest: names and places of its dots, and its stiffness."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.summary import OTHER_SET_UP
from rafl.capture.description.alignment import HARDLY_TOLD, Alignment, align_with_surface, find_pose
from rafl.capture.description.naming import dots_by_row, faces_of, name_dots
from rafl.capture.description.still import Dots, dots_at_rest
from rafl.capture.description.undeformed import PLACED_SIGMA, Shape, Undeformed, carry_back, find_undeformed
from rafl.capture.registration.material_change import MODULUS_SIGMA
from rafl.capture.registration.recording import Recording
from rafl.capture.registration.rigid import MIN_MARKERS, RigidTransform
from rafl.capture.specimen.geometry import read_surface
from rafl.capture.specimen.specimen import Body, build_specimen
from rafl.common.errors import InputError, SimulationError
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.linking.naming import is_row_name

Array = NDArray[Any]

MEASURED_SIGMA = 0.1  # standard deviation of log E that a user gives: tensile tests of soft rubber differ by so much
MAX_POSE_SIGMA = 1e-3  # largest standard deviation of a dot's place that an unknown frame may leave [m]
UNKNOWN_POSE_SIGMA = 1e-2  # of the height and tilt of a body whose frame is found with E in turn [m]
MAX_MODULUS_SIGMAS = 3.0  # E farther off the assumed one contradicts it [standard deviations of log E]
POSE_ITERATIONS = 3  # of the frame and E in turn
MAX_LEFT_OUT = 0.1  # share of the dots that may lie on no face: specks beside the specimen, or a hand's slip
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
        InputError: the specimen never rests, its dots are not on the body, or it hangs and should lie flat.
        SimulationError: the body's equilibrium cannot be found.
    """
    if lying:
        _check_lying(recording, body, folder, label, modulus_sigma)
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
    placed = recording.in_specimen_frame or _fits(shape, q, dots, modulus_sigma)
    if not placed:
        alignment = find_pose(shape, q, dots)
        dots = dots.moved(alignment.pose)
        if _fits(shape, q, dots, modulus_sigma):
            _check_pose(alignment, faces_of(carry_back(shape, q, dots).normal), label)
    dots = _dots_on_body(shape, q, dots, left_out, label, modulus_sigma)
    undeformed = find_undeformed(shape, simulator, dots, modulus_sigma, PLACED_SIGMA if placed else UNKNOWN_POSE_SIGMA)
    if not placed:
        for _ in range(POSE_ITERATIONS):
            alignment = align_with_surface(shape, undeformed.q, dots)
            dots = dots.moved(alignment.pose)
            undeformed = find_undeformed(shape, simulator, dots, modulus_sigma, UNKNOWN_POSE_SIGMA)
        undeformed = replace(undeformed, sigma=np.hypot(undeformed.sigma, alignment.sigma))
    kept = _dots_on_body(shape, undeformed.q, dots, left_out, label)
    if len(kept.names) < len(dots.names):
        dots, undeformed = kept, find_undeformed(shape, simulator, kept, modulus_sigma)
    faces, rest = faces_of(undeformed.carried.normal), undeformed.carried.rest
    names, listed = dots.names, np.arange(len(dots.names))
    if recording.names is None:  # a reader of such files takes the markers in the order of the specimen's
        names = name_dots(faces, rest)
    elif all(is_row_name(name) for name in names):
        names, listed = name_dots(faces, rest), np.concatenate(dots_by_row(faces, rest))
    modulus = specimen.material.youngs_modulus * float(np.exp(undeformed.log_modulus))
    if abs(undeformed.log_modulus) > MAX_MODULUS_SIGMAS * modulus_sigma:
        assumed = specimen.material.youngs_modulus
        raise InputError(
            f"{label}: expected a sag of the assumed material, {1e-3 * assumed:.3g} kPa, found that of one near "
            f"{1e-3 * modulus:.3g} kPa; correct the size of the body or --youngs-modulus, say that it lies flat "
            "(--lying) if it does, or check that no camera has the video or the calibration images of another"
        )
    return Description(shape, dots, names, listed, undeformed, modulus, left_out, modulus_sigma)


def _check_lying(recording: Recording, body: Body, folder: Path, label: str, modulus_sigma: float) -> None:
    """Raise InputError if the dots show the sag of a specimen that hangs."""
    try:
        hanging = describe(recording, body, folder, False, label, modulus_sigma)
    except (InputError, SimulationError):
        return
    if hanging.sag_tells:
        raise InputError(
            f"{label}: expected the straight rows of a specimen that lies flat, found them bent as if it hung, with a "
            f"Young's modulus of {1e-3 * hanging.youngs_modulus:.3g} kPa; leave out --lying, or film it again lying"
        )


def _distances(shape: Shape, q: Array, dots: Dots, modulus_sigma: float) -> tuple[Array, Array]:
    """Distances of dots from the body, and the largest allowed ones, as an uncertain E bends it otherwise [m], (M)."""
    carried = carry_back(shape, q, dots)
    return carried.distance, MAX_DISTANCE + modulus_sigma * carried.deflection


def _fits(shape: Shape, q: Array, dots: Dots, modulus_sigma: float) -> bool:
    """Whether most dots lie on the body."""
    distance, allowed = _distances(shape, q, dots, modulus_sigma)
    return bool(np.median(distance - allowed) < 0.0)


def _check_pose(alignment: Alignment, faces: list[str], label: str) -> None:
    """Raise InputError if the dots do not tell where the body is."""
    if alignment.sigma.max() > MAX_POSE_SIGMA:
        held = ", ".join(sorted(set(faces)))
        raise InputError(
            f"{label}: expected a recording in the specimen's frame, or dots that tell where the body is, found "
            f"another frame and dots on {held} only; put dots on the tip and the top too, or set the origin of motion "
            "capture at the lower corner of the clamped face (x from clamp to tip, y across, z up)"
        )


def _dots_on_body(
    shape: Shape, q: Array, dots: Dots, left_out: dict[str, float], label: str, modulus_sigma: float = 0.0
) -> Dots:
    """The dots that lie on the body; enters the others, if they are few, into `left_out`.

    Raises:
        InputError: many dots are far from the body.
    """
    distance, allowed = _distances(shape, q, dots, modulus_sigma)
    far, total = distance > allowed, len(dots.names) + len(left_out)
    if far.sum() + len(left_out) > max(1.0, MAX_LEFT_OUT * total) or (~far).sum() < MIN_MARKERS:
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
    dots = replace(dots, sigma=np.where(dots.measured, dots.sigma, PLACED_SIGMA))  # where the planes are
    middle = 0.5 * (q.min(axis=0) + q.max(axis=0) - dots.position.min(axis=0) - dots.position.max(axis=0))
    best: tuple[Array, RigidTransform] | None = None
    for shift in (np.zeros(3), *np.diag(middle)):  # along each axis, the middle of the dots to that of the body
        pose = align_with_surface(shape, q, dots, RigidTransform(np.eye(3), shift), HARDLY_TOLD).pose
        moved = dots.moved(pose)
        distance = carry_back(shape, q, moved).distance
        motion = moved.position - dots.position
        if np.mean(distance > MAX_DISTANCE) <= MAX_LEFT_OUT and (
            best is None or np.linalg.norm(motion) < np.linalg.norm(best[0])
        ):
            best = motion, pose
    if best is not None:
        x, y, z = 1e3 * best[0].mean(axis=0)
        turn = np.degrees(np.arccos(np.clip((np.trace(best[1].rotation) - 1.0) / 2.0, -1.0, 1.0)))
        return (
            f"moved by about {x:.0f}, {y:.0f}, {z:.0f} mm along x, y, z and turned by {turn:.0f} degrees they would "
            "lie on it, so the world of the recording is not the specimen's frame (origin at the lower corner of the "
            "clamped face on the side of smallest y, x from clamp to tip, z up): calibrate with the board at that "
            f"corner, or set the origin of motion capture there; or the size of the body is wrong, or {OTHER_SET_UP}"
        )
    spans = [" x ".join(f"{1e3 * x:.1f}" for x in np.ptp(p, axis=0)) for p in (dots.position, shape.mesh.vertices)]
    return (
        f"they span {spans[0]} mm along x, y, z and the body {spans[1]} mm, and at no other place would they lie on "
        "it: correct the size or shape of the body, or the unit of the recording"
    )
