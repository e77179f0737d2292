from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from rafl.tracking.video.ffmpeg import FFmpegDecoder
from rafl.tracking.video.jpeg import JpegDecoder
from rafl.tracking.video.reader import open_video
from support import write_video

COUNT = 12


def film(path: Path, **options: str) -> list[bytes]:
    """Blurred noise as Motion JPEG; its packets."""
    random = np.random.default_rng(7)
    pictures = [
        cv2.GaussianBlur(random.uniform(0, 255, (144, 192)).astype(np.float32), (0, 0), 2.0) for _ in range(COUNT)
    ]
    write_video(
        path,
        "mjpeg",
        "yuvj420p",
        options=options,
        pictures=[(3.0 * p - 255.0).clip(0, 255).astype(np.uint8) for p in pictures],
    )
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def change(path: Path, changed: Callable[[int, bytes], bytes]) -> None:
    """Write a video's packets again, changed by their number and content."""
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    with av.open(str(path), "w") as output:
        stream = output.add_stream("mjpeg", rate=100)
        stream.height, stream.width, stream.pix_fmt = 144, 192, "yuvj420p"
        for number, content in enumerate(packets):
            packet = av.Packet(changed(number, content))
            packet.stream, packet.pts, packet.dts, packet.is_keyframe = stream, number, number, True
            output.mux(packet)


def test_luma_is_what_ffmpeg_decodes(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    film(path, qmin="2", qmax="2")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        ffmpeg, decoder = FFmpegDecoder(stream), JpegDecoder.of(path)
        assert decoder is not None
        for packet in container.demux(stream):
            ((_, ours, damaged),), ((_, theirs, _),) = decoder.decode([packet]), ffmpeg.decode([packet])
            assert not damaged
            assert [frame.stamp for frame in ours] == [frame.stamp for frame in theirs]
            for one, other in zip(ours, theirs, strict=True):
                assert one.picture is not None
                assert np.abs(one.picture - other.picture.astype(float)).max() <= 3


def test_overwritten_code_is_told(tmp_path: Path) -> None:
    """Up to 400 bytes are overwritten or zeroed: 4 % may pass, by FFmpeg more."""
    path = tmp_path / "a.avi"
    packets = film(path)
    decoder = JpegDecoder.of(path)
    assert decoder is not None
    random = np.random.default_rng(8)
    wrong = {"ours": 0, "ffmpeg": 0}
    with av.open(str(path)) as container:
        ffmpeg = FFmpegDecoder(container.streams.video[0])
        for trial in range(300):
            content = packets[trial % COUNT]
            head = content.index(b"\xff\xda") + 14
            start = int(random.integers(head, len(content) - 2))
            length = min(int(random.integers(1, 400)), len(content) - 2 - start)
            other = random.bytes(length) if trial % 2 else bytes(length)
            damaged = content[:start] + other + content[start + length :]
            for name, decode in (("ours", decoder.decode), ("ffmpeg", ffmpeg.decode)):
                ((_, (truth,), _),) = decode([av.Packet(content)])
                for frame in decode([av.Packet(damaged)])[0][1]:
                    if frame.picture is not None:
                        wrong[name] += np.abs(frame.picture - truth.picture.astype(float)).max() > 8
    assert wrong["ours"] <= 12
    assert wrong["ffmpeg"] > wrong["ours"]


def test_bytes_that_a_camera_leaves_about_are_no_damage(tmp_path: Path) -> None:
    """As some webcams do before the picture's end, where damage leaves them as well: FFmpeg reads these."""
    path = tmp_path / "a.avi"
    film(path)
    whole = [frame.picture for frame in open_video(path).read()]
    change(path, lambda number, content: content[:-2] + bytes(6 + number % 3) + content[-2:])
    assert JpegDecoder.of(path) is None
    for frame, picture in zip(open_video(path).read(), whole, strict=True):
        assert frame.picture is not None
        assert picture is not None
        assert np.abs(frame.picture - picture.astype(float)).max() <= 3


def test_one_damaged_picture_at_the_start_is_missing_and_the_others_right(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    film(path)
    whole = [frame.picture for frame in open_video(path).read()]
    change(path, lambda number, content: content[: len(content) // 2] if number == 0 else content)
    found = [frame.picture for frame in open_video(path).read()]
    assert found[0] is None
    for picture, before in zip(found[1:], whole[1:], strict=True):
        np.testing.assert_array_equal(picture, before)


@pytest.mark.parametrize("number", [0, 7])
def test_a_damaged_file_in_a_folder_is_missing(tmp_path: Path, number: int) -> None:
    """OpenCV makes a picture of it."""
    folder = folder_of_files(tmp_path)
    truth = [frame.picture for frame in open_video(folder).read()]
    path = folder / f"{number}.jpg"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] + bytes(60) + content[len(content) // 2 + 60 :])
    assert cv2.imread(str(path)) is not None
    found = [frame.picture for frame in open_video(folder).read()]
    assert [k for k, picture in enumerate(found) if picture is None] == [number]
    for k, picture in enumerate(found):
        if picture is not None:
            np.testing.assert_array_equal(picture, truth[k])


def test_files_that_opencv_gives_up_on_are_missing(tmp_path: Path) -> None:
    """An empty one, and one whose header claims four thousand million pixels."""
    folder = folder_of_files(tmp_path)
    huge = bytearray(cv2.imencode(".bmp", np.zeros((8, 8), np.uint8))[1].tobytes())
    huge[18:26] = b"\0\0\1\0" * 2
    (folder / "3.bmp").write_bytes(huge)
    (folder / "3.jpg").write_bytes(b"")
    (folder / "4.png").write_bytes(b"")
    missing = [frame.picture is None for frame in open_video(folder).read()]
    assert missing == [False] * 3 + [True] * 2 + [False, True] + [False] * (COUNT - 5)


def test_bytes_that_a_camera_leaves_in_every_file_are_no_damage(tmp_path: Path) -> None:
    folder = folder_of_files(tmp_path)
    for path in folder.iterdir():
        content = path.read_bytes()
        path.write_bytes(content[:-2] + bytes(6) + content[-2:])
    assert all(frame.picture is not None for frame in open_video(folder).read())


def folder_of_files(parent: Path) -> Path:
    """The film as single files."""
    (parent / "run").mkdir()
    for number, content in enumerate(film(parent / "a.avi")):
        (parent / "run" / f"{number}.jpg").write_bytes(content)
    return parent / "run"


def test_a_header_that_claims_another_size_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    packets = film(path)
    decoder = JpegDecoder.of(path)
    assert decoder is not None
    at = packets[0].index(b"\xff\xc0") + 5
    for claimed in (b"\xff\xff\xff\xff", b"\x00\x10\x00\x10"):
        packet = av.Packet(packets[0][:at] + claimed + packets[0][at + 4 :])
        assert decoder.decode([packet]) == [(packet, [], True)]
