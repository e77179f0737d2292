"""Cameras from a specimen at rest: its dots found in one video each, named, and held against their layout."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rest_pose import FEWEST_POINTS, RestCamera, camera_from_points
from rafl.tracking.linking.follow import follow
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.linking.naming import name_by_layout, visible_markers
from rafl.tracking.video.reader import Video, is_video, natural_key, open_video
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rafl.common.errors import InputError

Array = NDArray[Any]

FACES = {  # by the face filmed, the line of sight
    "x-min": (1.0, 0.0, 0.0),
    "x-max": (-1.0, 0.0, 0.0),
    "y-min": (0.0, 1.0, 0.0),
    "y-max": (0.0, -1.0, 0.0),
    "z-min": (0.0, 0.0, 1.0),
    "z-max": (0.0, 0.0, -1.0),
}
AT_REST = 1.0  # px: a dot that moves farther than this is not at rest
DEEP = 0.1  # of the width: a face seen narrower than this is seen from its edge
ALIKE = 1.5  # times the residual: faces whose misfits differ by less cannot be told apart


@dataclass(frozen=True)
class RestView:
    """What one camera's video of the specimen at rest gave.

    Attributes:
        found: the camera.
        face: of the specimen that it films.
        markers: how many of the layout's it named.
    """

    found: RestCamera
    face: str
    markers: int


def rest_videos(folder: Path) -> dict[str, Video]:
    """The videos of a folder, one a camera and named after it; a single video is one camera.

    Raises:
        InputError: none there, or one that cannot be opened.
    """
    if not folder.exists():
        raise InputError(f"expected videos of the specimen at rest at {folder}, found nothing there; check the path")
    paths = [folder] if is_video(folder) else [p for p in sorted(folder.iterdir(), key=natural_key) if is_video(p)]
    if not paths:
        raise InputError(f"expected one video per camera in {folder}, found none; name them <camera>.mp4")
    return {path.name if path.is_dir() else path.stem: open_video(path) for path in paths}


def camera_at_rest(
    name: str, video: Video, layout: MarkerLayout, face: str | None, tilt_sign: int | None, tick: Callable[[], None]
) -> RestView:
    """The camera that filmed a specimen at rest; the specimen's frame is the world.

    The camera stands upright: the picture's up is the specimen's z, or, where it looks along z, its right is x.

    Args:
        name: of the camera, for messages.
        video: its.
        layout: of the specimen's markers.
        face: one of `FACES`; None to try them all.
        tilt_sign: see `rafl.calibration.rest_pose.camera_from_points`.
        tick: called after every frame.

    Raises:
        InputError: dots that move, that match no face, or several alike, or that leave the camera open.
    """
    dots = _still_dots(video, tick)
    fits: dict[str, tuple[Array, Array, float]] = {}
    for each in [face] if face else list(FACES):
        matched = _matched(dots, layout, each, video)
        if matched is not None:
            fits[each] = matched
    if not fits:
        raise InputError(
            f"{video.path}: expected at least {FEWEST_POINTS} dots in the pattern of the specimen's markers"
            f"{f' on its face {face}' if face else ''}, found {len(dots)} dots that do not match; check "
            "--specimen, and that the camera stands upright"
        )
    most = max(len(points) for points, _, _ in fits.values())
    fits = {each: fit for each, fit in fits.items() if len(fit[0]) == most}
    best = min(misfit for _, _, misfit in fits.values())
    alike = [each for each, (_, _, misfit) in fits.items() if misfit < ALIKE * best + 1e-3]
    if len(alike) > 1:
        raise InputError(
            f"camera {name}: its dots match the markers of the faces {', '.join(alike)} alike; say which it films, for "
            f"instance --face {name}={alike[0]}"
        )
    points, pixels, _ = fits[alike[0]]
    found = camera_from_points(points, pixels, video.size, name, tilt_sign)
    return RestView(found, alike[0], len(points))


def _still_dots(video: Video, tick: Callable[[], None]) -> Array:
    """The dots' places in the whole video (D, 2)."""
    tracks = follow(video, tick)
    seen = np.isfinite(tracks.pixel[..., 0])
    kept = seen.mean(axis=0) > 0.5
    places = np.array([np.median(tracks.pixel[seen[:, d], d], axis=0) for d in np.flatnonzero(kept)])
    away = np.nanmax(np.linalg.norm(tracks.pixel[:, kept] - places, axis=2), initial=0.0)
    if away > AT_REST:
        raise InputError(
            f"{video.path}: expected a specimen at rest, found dots that move by {away:.1f} px; film it unloaded and "
            "still, or cut the video"
        )
    return places


def _matched(dots: Array, layout: MarkerLayout, face: str, video: Video) -> tuple[Array, Array, float] | None:
    """Markers (P, 3) and their pixels (P, 2) if the camera films this face, and the affine misfit [px]."""
    away = np.array(FACES[face])
    right = np.array([1.0, 0.0, 0.0]) if away[2] else np.cross([0.0, 0.0, -1.0], away)
    rotation = np.stack([right, np.cross(away, right), away])
    camera = OrthographicCamera(
        image_size=video.size, rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()), scale=(1.0, 1.0)
    )
    places = camera.ideal(layout.positions[visible_markers(layout, camera)])
    width = np.ptp(places, axis=0)
    if len(places) < FEWEST_POINTS or len(dots) < FEWEST_POINTS or width.min() < DEEP * width.max():
        return None
    scale = float(_spacing(dots) / _spacing(places))
    offset = dots.mean(0) - scale * places.mean(0)
    guess = OrthographicCamera(
        image_size=video.size, rotation_vector=camera.rotation_vector, scale=(scale, scale), offset=tuple(offset)
    )
    try:
        names = np.array(name_by_layout(dots, layout, guess, str(video.path)))
    except InputError:
        return None
    named = names >= 0
    if named.sum() < FEWEST_POINTS:
        return None
    points, pixels = layout.positions[names[named]], dots[named]
    design = np.column_stack([guess.ideal(points), np.ones(len(points))])
    affine = np.linalg.lstsq(design, pixels, rcond=None)[0]
    turn = affine[:2].T / np.sqrt(abs(np.linalg.det(affine[:2])) + 1e-12)
    if turn[0, 0] + turn[1, 1] < np.sqrt(2.0):  # turned by more than 45 degrees: this camera is not upright
        return None
    return points, pixels, float(np.sqrt(((design @ affine - pixels) ** 2).mean()))


def _spacing(places: Array) -> float:
    return float(np.median(cKDTree(places).query(places, 2)[0][:, 1]))
