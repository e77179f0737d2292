from pathlib import Path

from support import write_video

from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rig import Rig
from rafl.tracking.video.recordings import find_recordings


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
