"""Videos of the specimen at rest, which tell how its cameras stand: find and name its markers."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rest_pose import MIN_POINTS
from rafl.common.errors import InputError
from rafl.tracking.linking.follow import follow
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.linking.naming import name_by_layout, visible_markers
from rafl.tracking.video.reader import Video, is_video, open_video, visible_entries

Array = NDArray[Any]

FACES = {  # line of sight of a camera that films the face
    "x-min": (1.0, 0.0, 0.0),
    "x-max": (-1.0, 0.0, 0.0),
    "y-min": (0.0, 1.0, 0.0),
    "y-max": (0.0, -1.0, 0.0),
    "z-min": (0.0, 0.0, 1.0),
    "z-max": (0.0, 0.0, -1.0),
}
MAX_MOTION_PX = 1.0  # a dot that moves farther is not at rest
MIN_ASPECT = 0.1  # width over length of the imaged markers; below it, the camera sees the face edge-on
MISFIT_RATIO = 1.5  # faces whose misfits are within this factor of the best cannot be distinguished


@dataclass(frozen=True)
class RestView:
    """The markers that a camera sees of the specimen at rest.

    Attributes:
        face: the face of the specimen that the camera films.
        points: marker positions in the specimen frame [m], (P, 3).
        pixels: their pixels, (P, 2).
    """

    face: str
    points: Array
    pixels: Array


def open_rest_videos(folder: Path) -> dict[str, Video]:
    """Open the videos of a folder, by camera. Each file is named after its camera; a single video is one camera.

    Raises:
        InputError: there is no video, or one cannot be opened.
    """
    if not folder.exists():
        raise InputError(f"expected videos of the specimen at rest at {folder}, found nothing there; check the path")
    paths = [folder] if is_video(folder) else [path for path in visible_entries(folder) if is_video(path)]
    if not paths:
        raise InputError(f"expected one video per camera in {folder}, found none; name them <camera>.mp4")
    return {path.name if path.is_dir() else path.stem: open_video(path) for path in paths}


def match_rest_video(
    name: str, video: Video, layout: MarkerLayout, face: str | None, tick: Callable[[], None]
) -> RestView:
    """Find the markers in a video of the specimen at rest.

    The camera must stand upright: up in the image is the specimen's z. If it films along z, right in the image is x.

    Args:
        name: camera name for error messages.
        video: the camera's video.
        layout: layout of the specimen's markers.
        face: one of `FACES`; None to try all.
        tick: called after every frame.

    Raises:
        InputError: the dots move, match no face, or match several faces equally well.
    """
    dots = _rest_positions(video, tick)
    matches: dict[str, tuple[Array, Array, float]] = {}
    for each in [face] if face else list(FACES):
        matched = _match_face(dots, layout, each, video)
        if matched is not None:
            matches[each] = matched
    if not matches:
        raise InputError(
            f"{video.path}: expected at least {MIN_POINTS} dots in the pattern of the specimen's markers"
            f"{f' on its face {face}' if face else ''}, found {len(dots)} dots that do not match; check "
            "--specimen, and that the camera is upright"
        )
    most = max(len(points) for points, _, _ in matches.values())
    matches = {each: match for each, match in matches.items() if len(match[0]) == most}
    best = min(misfit for _, _, misfit in matches.values())
    equal = [each for each, (_, _, misfit) in matches.items() if misfit < MISFIT_RATIO * best + 1e-3]
    if len(equal) > 1:
        raise InputError(
            f"camera {name}: its dots match the faces {', '.join(equal)} equally well; name the face that it films, "
            f"for instance --face {name}={equal[0]}"
        )
    points, pixels, _ = matches[equal[0]]
    return RestView(equal[0], points, pixels)


def _rest_positions(video: Video, tick: Callable[[], None]) -> Array:
    """Median pixel (D, 2) over the video of each dot that is seen in more than half of the frames."""
    tracks = follow(video, tick)
    seen = np.isfinite(tracks.pixel[..., 0])
    kept = seen.mean(axis=0) > 0.5
    positions = np.array([np.median(tracks.pixel[seen[:, d], d], axis=0) for d in np.flatnonzero(kept)])
    motion = np.nanmax(np.linalg.norm(tracks.pixel[:, kept] - positions, axis=2), initial=0.0)
    if motion > MAX_MOTION_PX:
        raise InputError(
            f"{video.path}: expected a specimen at rest, found dots that move by {motion:.1f} px; film it unloaded and "
            "motionless, or cut the video"
        )
    return positions


def _match_face(dots: Array, layout: MarkerLayout, face: str, video: Video) -> tuple[Array, Array, float] | None:
    """Match the dots (D, 2) with the markers of one face.

    Returns:
        Marker positions [m], (P, 3), their pixels (P, 2) and the RMS misfit of an affine map between them [px]; None
        if the dots do not match this face.
    """
    sight = np.array(FACES[face])
    right = np.array([1.0, 0.0, 0.0]) if sight[2] else np.cross([0.0, 0.0, -1.0], sight)
    rotation = np.stack([right, np.cross(sight, right), sight])
    camera = OrthographicCamera(
        image_size=video.size, rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()), scale=(1.0, 1.0)
    )
    expected = camera.project_undistorted(layout.positions[visible_markers(layout, camera)])
    extent = np.ptp(expected, axis=0)
    if len(expected) < MIN_POINTS or len(dots) < MIN_POINTS or extent.min() < MIN_ASPECT * extent.max():
        return None
    scale = float(_median_spacing(dots) / _median_spacing(expected))
    offset = dots.mean(0) - scale * expected.mean(0)
    guess = OrthographicCamera(
        image_size=video.size, rotation_vector=camera.rotation_vector, scale=(scale, scale), offset=tuple(offset)
    )
    try:
        indices = np.array(name_by_layout(dots, layout, guess, str(video.path)))
    except InputError:
        return None
    named = indices >= 0
    if named.sum() < MIN_POINTS:
        return None
    points, pixels = layout.positions[indices[named]], dots[named]
    design = np.column_stack([guess.project_undistorted(points), np.ones(len(points))])
    affine = np.linalg.lstsq(design, pixels, rcond=None)[0]
    linear = affine[:2].T / np.sqrt(abs(np.linalg.det(affine[:2])) + 1e-12)
    if linear[0, 0] + linear[1, 1] < np.sqrt(2.0):  # rotated by more than 45 degrees: not upright
        return None
    return points, pixels, float(np.sqrt(((design @ affine - pixels) ** 2).mean()))


def _median_spacing(points: Array) -> float:
    """Median distance of a point to its nearest neighbour."""
    return float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
