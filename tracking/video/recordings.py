"""Find the videos of each recording."""

from collections.abc import Iterator
from pathlib import Path

from rafl.calibration.rig import Rig
from rafl.common.errors import InputError
from rafl.common.files import find_copies
from rafl.common.names import require_names
from rafl.tracking.video.reader import VIDEO_SUFFIXES, Video, is_video, natural_key, open_video, visible_entries


def find_recordings(videos: Path, rig: Rig, calib: Path) -> dict[str, dict[str, Video]]:
    """The videos of each recording, opened, by camera.

    Args:
        videos: as for `find_videos`.
        rig: as for `find_videos`.
        calib: as for `find_videos`.

    Raises:
        InputError: as `find_videos` and `open_videos` say.
    """
    return {name: open_videos(paths, rig) for name, paths in find_videos(videos, rig, calib).items()}


def open_videos(paths: dict[str, Path], rig: Rig) -> dict[str, Video]:
    """Open the videos of one recording, by camera.

    Raises:
        InputError: one cannot be opened, or has another size than its camera, or two are the same.
    """
    if copies := find_copies(paths.values()):
        raise InputError(
            f"expected a video of every camera, found {copies[0]} in {copies[1]} again; copy the right one"
        )
    return {camera: _open_checked(path, rig, camera) for camera, path in paths.items()}


def find_videos(videos: Path, rig: Rig, calib: Path) -> dict[str, dict[str, Path]]:
    """Find the videos by recording and camera.

    Their names are `<recording>/<camera>.<ext>`, `<recording>_<camera>.<ext>`, or `<recording>.<ext>` if the rig has
    one camera. A folder of numbered images counts as a video, also if it is `videos` itself.

    Args:
        videos: folder, or a single video.
        rig: cameras to expect.
        calib: file of the rig, for messages.

    Raises:
        InputError: no video is found, `videos` is not a video, a video's camera is not in the rig, a recording lacks a
            camera of the rig, or a video is unreadable or differs in size from its camera.
    """
    _check_videos(videos)
    found: dict[str, dict[str, Path]] = {}

    def add(recording: str, camera: str, path: Path) -> None:
        if camera in found.setdefault(recording, {}):
            raise InputError(
                f"recording {recording}: expected one video of camera {camera}, found "
                f"{found[recording][camera].name} and {path.name}; move one away"
            )
        found[recording][camera] = path

    for recording, path in _video_paths(videos):
        if recording is None:
            add(*_split_name(path, rig, calib), path)
        else:
            _check_camera(_stem(path), rig, calib, path)
            add(recording, _stem(path), path)
    if not found:
        raise InputError(f"expected videos in {videos}, found none; name them <recording>/<camera>.mp4")
    require_names(found, f"recordings in {videos}")
    for recording, cameras in found.items():
        missing = set(rig.cameras) - set(cameras)
        if missing:
            raise InputError(
                f"recording {recording}: expected a video of every camera in {calib}, found none of "
                f"{', '.join(sorted(missing))}; add it, or calibrate without that camera"
            )
    return found


def filmed_cameras(videos: Path, count: int) -> dict[str, tuple[int, int]]:
    """Names of the cameras in the names of the videos, in order, and the image size [px] of each.

    The size is that of the camera's first video that can be opened. If there is one camera, videos beside each other
    need not name it; it is then called `camera`.

    Args:
        videos: folder, or a single video.
        count: number of cameras that are expected.

    Raises:
        InputError: no video is found, or none of a camera can be opened.
    """
    _check_videos(videos)
    paths: dict[str, list[Path]] = {}
    for recording, path in _video_paths(videos):
        name = _stem(path) if recording is not None else "camera" if count == 1 else _stem(path).rpartition("_")[2]
        paths.setdefault(name, []).append(path)
    return {name: _first_size(paths[name]) for name in sorted(paths, key=lambda name: natural_key(Path(name)))}


def _first_size(paths: list[Path]) -> tuple[int, int]:
    """Image size [px] of the first video that can be opened."""
    for path in paths[:-1]:
        try:
            return open_video(path).size
        except InputError:
            continue
    return open_video(paths[-1]).size


def _check_videos(videos: Path) -> None:
    """Refuse a path at which there are no videos."""
    if not videos.exists():
        raise InputError(f"expected videos at {videos}, found nothing there; check the path")
    if videos.is_file() and not is_video(videos):
        raise InputError(
            f"expected a folder of videos or a video ({', '.join(sorted(VIDEO_SUFFIXES))}) at {videos}, found "
            "another file type; check the path"
        )


def _video_paths(videos: Path) -> Iterator[tuple[str | None, Path]]:
    """Recording, None for a video that lies in no recording's folder, and path of every video."""
    for path in [videos] if is_video(videos) else visible_entries(videos):
        if is_video(path):
            yield None, path
        elif path.is_dir():
            yield from ((path.name, part) for part in visible_entries(path) if is_video(part))


def _stem(path: Path) -> str:
    """Name of a video, or of a folder of images, without ending."""
    return path.resolve().name if path.is_dir() else path.stem


def _split_name(path: Path, rig: Rig, calib: Path) -> tuple[str, str]:
    """Recording and camera in the name of a video."""
    stem = _stem(path)
    for camera in rig.cameras:
        if stem.endswith(f"_{camera}"):
            return stem.removesuffix(f"_{camera}"), camera
    if len(rig.cameras) == 1:
        return stem, next(iter(rig.cameras))
    camera = stem.rpartition("_")[2]
    _check_camera(camera, rig, calib, path)
    return stem, camera


def _check_camera(camera: str, rig: Rig, calib: Path, path: Path) -> None:
    """Refuse a camera that is not in the rig."""
    if camera not in rig.cameras:
        raise InputError(
            f"{path}: expected a video of one of the cameras in {calib} ({', '.join(rig.cameras)}), found "
            f"camera {camera!r}; rename the video, or calibrate that camera"
        )


def _open_checked(path: Path, rig: Rig, camera: str) -> Video:
    """Open a video and check its size."""
    video = open_video(path)
    expected = rig.cameras[camera].image_size
    if video.size != expected:
        raise InputError(
            f"{path}: expected {expected[0]} x {expected[1]} pixels as calibrated for camera {camera}, found "
            f"{video.size[0]} x {video.size[1]}; record at the calibrated size, or calibrate again"
        )
    return video
