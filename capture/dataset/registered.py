"""Recordings in the specimen frame, and what their first frames show together: places of the markers and a pose."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from rafl.calibration.summary import OTHER_SET_UP
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.registration.averaging import average_frames, average_views
from rafl.capture.registration.camera_change import CameraChange, positions_at, without_lag
from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.places import Places, find_places
from rafl.capture.registration.recording import Recording
from rafl.capture.registration.registration import Registration, fit_pose_near_clamp
from rafl.capture.registration.rigid import IDENTITY, MIN_MARKERS, RigidTransform, pose_sigma
from rafl.capture.release.motion_start import MotionStart, find_motion_start
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.markers import Markers
from rafl.data.views import View

Array = NDArray[Any]

# A marker moves by no more than this multiple of its distance from the clamp: where a slack body that a clamp holds
# level hangs down from it, by the root of two.
MOST_MOTION = 1.5


@dataclass(frozen=True)
class Registered:
    """A recording in the specimen frame.

    Attributes:
        recording, row, registration: of which it is made.
        position, sigma: of the specimen's markers [m], (T, M, 3).
        views: what each camera measured of them, by its name; empty if not known.
        start: where the motion starts, and in which state.
        last: last frame that is used.
    """

    recording: Recording
    row: RecordingRow
    registration: Registration
    position: Array
    sigma: Array
    start: MotionStart
    last: int
    views: dict[str, View]

    @classmethod
    def of(
        cls,
        specimen: Specimen,
        recording: Recording,
        row: RecordingRow,
        registration: Registration,
        settings: CaptureSettings,
    ) -> "Registered":
        """Transform a recording by its registration, without outliers, and find where its motion starts."""
        own = len(specimen.layout.names)
        position = registration.pose.apply(recording.position[:, :own])
        sigma = registration.pose.rotate_sigma(recording.sigma[:, :own])
        if registration.covariance.ndim > 2:
            sigma = np.hypot(sigma, pose_sigma(registration.covariance[:, None], position))
        position[:, [name in registration.outliers for name in specimen.layout.names]] = np.nan
        # Positions as recorded: if a clamp marker jumps, a specimen at rest would seem to move in the clamp's frame.
        start = _motion_start(recording.position[:, :own], row, settings)
        last = len(recording.time) - 1 if row.last_frame is None else row.last_frame
        if not start.frame < last < len(recording.time):
            raise InputError(
                f"recording {row.recording}: expected at least two frames within 0 to {len(recording.time) - 1}, "
                f"found {start.frame} to {last}; correct recordings.csv"
            )
        kept = np.array(
            [k if name not in registration.outliers else -1 for k, name in enumerate(specimen.layout.names)]
        )
        views = {camera: view.select_markers(kept) for camera, view in recording.views.items()}
        views = _in_frame(views, registration.pose, registration.covariance, recording.time)
        return cls(recording, row, registration, position, sigma, start, last, views)

    def with_changes(self, changes: dict[str, CameraChange]) -> "Registered":
        """The recording as its cameras saw it from where they are now, at their own times."""
        if not self.views:
            return self
        views = {name: changes[name].applied(view) if name in changes else view for name, view in self.views.items()}
        position, sigma = positions_at(views, self.recording.time)
        return replace(self, views=views, position=position, sigma=sigma)

    def with_pose(self, places: Places) -> "Registered":
        """The recording in the specimen frame, after its pose was found; sigma then contains that of the pose."""
        registration = replace(
            self.registration,
            pose=places.pose,
            covariance=places.pose_covariance,
            pose_from_model=False,
            modulus=places.modulus,
            modulus_sigma=places.modulus_sigma,
        )
        position = places.pose.apply(self.position)
        by_pose = pose_sigma(places.pose_covariance, position)
        sigma = np.hypot(places.pose.rotate_sigma(self.sigma), by_pose)
        views = _in_frame(self.views, places.pose, places.pose_covariance, self.recording.time)
        return replace(self, registration=registration, position=position, sigma=sigma, views=views)

    def first_frame(self, dataset: Dataset, specimen: Specimen, whole_surface: bool) -> FirstFrame:
        """Mean marker positions at rest before the release, or those of the first frame."""
        rest = self.start.rest_frames
        target, sigma = average_frames(self.position[rest], self.sigma[rest])
        name, axes = self.row.recording, None
        if self.views:
            views = self.views if self.start.rest_start < self.start.frame else self._views_without_lag()
            target, axes, sigma = average_views({key: view.select_frames(rest) for key, view in views.items()}, target)
        if np.isfinite(target[:, 0]).sum() < MIN_MARKERS:
            raise InputError(
                f"recording {name}, frame {self.start.frame}: expected at least {MIN_MARKERS} markers, found fewer; "
                "start at a later first_frame"
            )
        surface = np.setdiff1d(np.unique(specimen.mesh.surface), specimen.fixed)
        nodes = surface if whole_surface else specimen.loaded
        observation = FirstFrame(dataset.simulator, dataset.markers, nodes, target, sigma, name, whole_surface)
        return replace(observation, moving=self.start.moving, axes=axes)

    def _views_without_lag(self) -> dict[str, View]:
        """What the cameras would have measured at the times of the frames: a specimen that moves has moved on since."""
        views = {name: without_lag(view, self.recording.time) for name, view in self.views.items()}
        own = self.registration
        moving = own.pose.rotation.ndim > 2
        return _in_frame(views, own.pose, own.covariance, self.recording.time) if moving else views


def _in_frame(views: dict[str, View], pose: RigidTransform, covariance: Array, time: Array) -> dict[str, View]:
    """The views in the specimen frame, to which a pose leads from the cameras' frame: one, or one for every frame.

    Args:
        views: by camera.
        pose, covariance: the latter is contained in views whose pose differs from frame to frame.
        time: of the frames [s], (T).
    """
    if pose is IDENTITY:
        return views
    if pose.rotation.ndim > 2:
        result = {}
        for name, view in views.items():
            own = pose.at_times(time, time + view.lag) if view.lag.any() else pose
            result[name] = replace(view, rotation=own.rotation, translation=own.translation, pose_covariance=covariance)
        return result
    return {
        name: replace(view, camera=view.camera.in_frame(pose.rotation, pose.translation))
        for name, view in views.items()
    }


def find_dataset_places(
    dataset: Dataset,
    specimen: Specimen,
    registered: list[Registered],
    known: Markers | None,
    settings: CaptureSettings,
) -> tuple[Markers, list[Registered]]:
    """The markers at the places that the first frames show, and the recordings with the poses that these show.

    Places stay as described where the elements lock: such a mesh follows a bent body less closely than a hand places a
    dot. A recording that starts in motion shows neither places nor a pose, for its first frame is no equilibrium.

    Args:
        dataset: with the markers as described.
        specimen: its description.
        registered: recordings; the pose of some may be unknown.
        known: markers whose places are known.
        settings: tolerances and methods.

    Raises:
        InputError: the places are farther from the described ones than the tolerance.
    """
    markers = known or dataset.markers
    fixed = known is not None or specimen.material.integration != "enhanced"
    chosen = [item for item in registered if not item.start.moving and (item.registration.pose_from_model or not fixed)]
    if not chosen:
        return markers, registered
    described = replace(dataset, markers=markers)
    unknown = [item.registration.pose_from_model for item in chosen]
    frames = [item.first_frame(described, specimen, whole_surface=False) for item in chosen]
    frames = [
        replace(frame, load=1e-3 * item.row.load_g) if posed else frame
        for item, frame, posed in zip(chosen, frames, unknown, strict=True)
    ]
    targets = np.array([frame.target for frame, posed in zip(frames, unknown, strict=True) if posed])
    pose = IDENTITY
    if len(targets):
        pose = fit_pose_near_clamp(specimen, average_frames(targets, np.ones_like(targets))[0])
    sigma = 0.0 if fixed else specimen.layout.sigma
    places = find_places(frames, unknown, pose, np.broadcast_to(sigma, len(markers.names)))
    found = [
        item.with_pose(places) if any(unknown) and item.registration.pose_from_model else item for item in registered
    ]
    if not fixed:
        _check_places(specimen, dataset.markers, places.markers, settings)
    return markers if fixed else places.markers, found


def _check_places(specimen: Specimen, described: Markers, markers: Markers, settings: CaptureSettings) -> None:
    """Raise InputError if the markers are farther from their described places than the tolerance."""
    moved = np.linalg.norm(markers.rest - described.rest, axis=1)
    distance = float(np.sqrt((moved**2).mean()))
    if distance > settings.fit_tolerance:
        raise InputError(
            f"specimen {specimen.name}: expected the markers near their at_mm, found them {1e3 * distance:.2f} mm off "
            f"in the first frames (root mean square; at most {1e3 * settings.fit_tolerance:g} mm). Either at_mm is "
            f"wrong, or the calibration's world is not the specimen's frame, or {OTHER_SET_UP}; --fit-tolerance-mm "
            "allows more"
        )


def check_near_clamp(dataset: Dataset, specimen: Specimen, item: Registered, tolerance: float) -> None:
    """Check that the markers are where a body that is held at its clamp can have them.

    Args:
        dataset: with the markers as described.
        specimen: its description.
        item: the recording; not checked if its pose is still unknown.
        tolerance: distance by which a marker may be farther off than that [m].

    Raises:
        InputError: in the first frame, a marker is farther from its place.
    """
    if item.registration.pose_from_model:
        return
    frame = item.first_frame(dataset, specimen, whole_surface=False)
    rest, clamp = frame.markers.rest[frame.measured], frame.simulator.mesh.vertices[specimen.fixed]
    along = np.where(frame.observed_axes, frame.along_axes(frame.target[frame.measured] - rest), 0.0)
    moved, distance = np.linalg.norm(along, axis=1), cdist(rest, clamp).min(axis=1)
    beyond = moved - MOST_MOTION * distance
    worst = int(np.argmax(beyond))
    if beyond[worst] > tolerance:
        name = np.array(frame.markers.names)[frame.measured][worst]
        raise InputError(
            f"recording {frame.recording}, frame {item.start.frame}: expected marker {name} near its at_mm, "
            f"{1e3 * distance[worst]:.1f} mm from the clamp, found it {1e3 * moved[worst]:.1f} mm off. Either names or "
            "at_mm of markers are wrong, or this is another specimen, or the calibration's world is not the specimen's "
            f"frame, or {OTHER_SET_UP}; --fit-tolerance-mm allows more"
        )


def _motion_start(position: Array, row: RecordingRow, settings: CaptureSettings) -> MotionStart:
    """First frame and its state, by recordings.csv, the settings and the recorded motion."""
    given = settings.start if row.first_frame is None else row.first_frame
    if given is not None and given >= len(position):
        raise InputError(
            f"recording {row.recording}: expected a first frame within 0 to {len(position) - 1}, found {given}; "
            "correct it"
        )
    return find_motion_start(position, "rest" if settings.initial == "sequence" else settings.initial, given)
