from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from calibration.camera import OrthographicCamera
from calibration.rig import Rig
from groundwork import InputError
from tracking.recordings import find_recordings
from tracking.video import open_video

FRAMES = 12


def ramp(frame: int) -> np.ndarray:
    """A smooth picture, another each frame, within the range every format keeps."""
    x, y = np.meshgrid(np.arange(96), np.arange(64))
    return (30 + x + 1.2 * y + 5 * frame).astype(np.uint8)


def write_video(path: Path, codec: str, pixels: str, rate: int = 100, options: dict[str, str] | None = None) -> None:
    with av.open(str(path), "w") as output:
        stream = output.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = 96, 64, pixels
        stream.options = options or {}
        for number in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(ramp(number), format="gray")
            output.mux(stream.encode(frame.reformat(format=pixels)))
        output.mux(stream.encode())


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mkv", "ffv1", "gray"),
        ("a.avi", "mjpeg", "yuvj420p"),
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mov", "prores_ks", "yuv422p10le"),
    ],
)
def test_pictures_and_times(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    """Every frame comes back in order with its time; levels up to the format's own loss and range."""
    path = tmp_path / name
    write_video(path, codec, pixels, options={"crf": "4"} if codec == "libx264" else None)
    video = open_video(path)
    assert video.size == (96, 64)
    pictures = [(frame.time, frame.picture) for frame in video.read()]
    assert len(pictures) == FRAMES
    for number, (time, picture) in enumerate(pictures):
        assert time == pytest.approx(0.01 * number, abs=1e-4)
        assert picture is not None
        assert picture.dtype == (np.float32 if "10" in pixels else np.uint8)
        # An affine map of levels (limited or full range) leaves the picture's shape.
        fit = np.polyfit(ramp(number).ravel(), picture.ravel().astype(float), 1)
        assert 0.8 < fit[0] < 1.2
        assert np.abs(np.polyval(fit, ramp(number)) - picture).mean() < 3.0


def test_a_folder_of_pictures_is_sorted_by_number(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for number in range(FRAMES):
        cv2.imwrite(str(folder / f"img{number}.png"), ramp(number))
    video = open_video(folder)
    assert video.frames == FRAMES
    for number, (time, picture) in enumerate((frame.time, frame.picture) for frame in video.read()):
        assert np.isnan(time)
        np.testing.assert_array_equal(picture, ramp(number))


def test_a_cut_file_is_an_error_not_a_short_video(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, "libx264", "yuv420p")
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(InputError, match=r"a\.mp4"):
        list(open_video(path).read())


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
