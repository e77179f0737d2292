import shutil
from pathlib import Path

import pytest
from support import write_video

from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rig import Rig
from rafl.common.errors import InputError
from rafl.tracking.video.recordings import filmed_cameras, find_recordings


def camera() -> OrthographicCamera:
    return OrthographicCamera(image_size=(96, 64), scale=(1e4, 1e4), rotation_vector=(0.0, 0.0, 0.0))


def test_recordings_are_found_by_name(tmp_path: Path) -> None:
    rig = Rig({"left": camera(), "right": camera()})
    (tmp_path / "one").mkdir()
    for name in ("one/left.mkv", "one/right.mkv", "two_left.mkv", "two_right.mkv"):
        write_video(tmp_path / name, "ffv1", "gray")
    (tmp_path / "notes.txt").write_text("not a video")
    found = find_recordings(tmp_path, rig, Path("calib.yaml"))
    assert {name: sorted(cameras) for name, cameras in found.items()} == {
        "one": ["left", "right"],
        "two": ["left", "right"],
    }
    single = Rig({"front": camera()})
    write_video(tmp_path / "swing.mkv", "ffv1", "gray")
    assert set(find_recordings(tmp_path / "swing.mkv", single, Path("calib.yaml"))) == {"swing"}


def test_one_video_for_two_cameras_is_refused(tmp_path: Path) -> None:
    rig = Rig({"left": camera(), "right": camera()})
    (tmp_path / "one").mkdir()
    write_video(tmp_path / "one/left.mkv", "ffv1", "gray")
    shutil.copy(tmp_path / "one/left.mkv", tmp_path / "one/right.mkv")
    with pytest.raises(InputError, match=r"left\.mkv in .*right\.mkv again; copy the right one"):
        find_recordings(tmp_path, rig, Path("calib.yaml"))


def test_filmed_cameras_are_in_order_with_the_size_of_a_readable_video(tmp_path: Path) -> None:
    for name in ("a/cam10.mkv", "a/cam2.mkv", "b_cam2.mkv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_video(tmp_path / name, "ffv1", "gray")
    (tmp_path / "a/cam2.mkv").write_bytes(b"")
    size = filmed_cameras(tmp_path, 2)["cam10"]
    assert list(filmed_cameras(tmp_path, 2).items()) == [("cam2", size), ("cam10", size)]
    assert filmed_cameras(tmp_path / "b_cam2.mkv", 1) == {"camera": size}
    (tmp_path / "b_cam2.mkv").unlink()
    with pytest.raises(InputError, match=r"cam2\.mkv"):
        filmed_cameras(tmp_path, 2)
