"""Which videos make up which recording."""

from pathlib import Path

from rafl.calibration.rig import Rig
from rafl.tracking.video.reader import VIDEO_SUFFIXES, Video, is_video, natural_key, open_video

from rafl.common.errors import InputError


def find_recordings(videos: Path, rig: Rig, calib: Path) -> dict[str, dict[str, Video]]:
    """Videos by recording and camera.

    `<recording>/<camera>.<ext>`, `<recording>_<camera>.<ext>`, or `<recording>.<ext>` where the rig has
    one camera; a folder of numbered pictures counts as a video, also when it is `videos` itself.

    Args:
        videos: folder, or a single video.
        rig: cameras to expect.
        calib: the rig's file, for messages.

    Raises:
        InputError: nothing found, a file that is no video, a video of a camera the rig lacks, a recording without one
            of the rig's cameras, an unreadable video, or one of another size than its camera's.
    """
    if not videos.exists():
        raise InputError(f"expected videos at {videos}, found nothing there; check the path")
    if videos.is_file() and not is_video(videos):
        raise InputError(
            f"expected a folder of videos or a video ({', '.join(sorted(VIDEO_SUFFIXES))}) at {videos}, found "
            "a file of another kind; check the path"
        )
    found: dict[str, dict[str, Path]] = {}

    def add(recording: str, camera: str, path: Path) -> None:
        if camera in found.setdefault(recording, {}):
            raise InputError(
                f"recording {recording}: expected one video of camera {camera}, found "
                f"{found[recording][camera].name} and {path.name}; move one away"
            )
        found[recording][camera] = path

    for path in [videos] if is_video(videos) else sorted(videos.iterdir(), key=natural_key):
        if is_video(path):
            add(*_split_name(path, rig, calib), path)
        elif path.is_dir():
            for part in sorted(path.iterdir(), key=natural_key):
                if is_video(part):
                    name = part.name if part.is_dir() else part.stem
                    _known(name, rig, calib, part)
                    add(path.name, name, part)
    if not found:
        raise InputError(f"expected videos in {videos}, found none; name them <recording>/<camera>.mp4")
    for recording, cameras in found.items():
        absent = set(rig.cameras) - set(cameras)
        if absent:
            raise InputError(
                f"recording {recording}: expected a video of every camera in {calib}, found none of "
                f"{', '.join(sorted(absent))}; add it, or calibrate without that camera"
            )
    return {
        recording: {camera: _checked(path, rig, camera) for camera, path in cameras.items()}
        for recording, cameras in found.items()
    }


def _split_name(path: Path, rig: Rig, calib: Path) -> tuple[str, str]:
    stem = path.resolve().name if path.is_dir() else path.stem
    for camera in rig.cameras:
        if stem.endswith(f"_{camera}"):
            return stem.removesuffix(f"_{camera}"), camera
    if len(rig.cameras) == 1:
        return stem, next(iter(rig.cameras))
    camera = stem.rpartition("_")[2]
    _known(camera, rig, calib, path)
    return stem, camera


def _known(camera: str, rig: Rig, calib: Path, path: Path) -> None:
    if camera not in rig.cameras:
        raise InputError(
            f"{path}: expected a video of one of the cameras in {calib} ({', '.join(rig.cameras)}), found "
            f"camera {camera!r}; rename the video, or calibrate that camera"
        )


def _checked(path: Path, rig: Rig, camera: str) -> Video:
    video = open_video(path)
    expected = rig.cameras[camera].image_size
    if video.size != expected:
        raise InputError(
            f"{path}: expected {expected[0]} x {expected[1]} pixels as calibrated for camera {camera}, found "
            f"{video.size[0]} x {video.size[1]}; record at the calibrated size, or calibrate again"
        )
    return video
