from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from support import write_video

from rafl.tracking.video.ffmpeg import FFmpegDecoder
from rafl.tracking.video.jpeg import JpegDecoder
from rafl.tracking.video.reader import open_video

FRAME_COUNT = 12


def write_mjpeg(path: Path, **options: str) -> list[bytes]:
    """Write a Motion JPEG video of blurred noise and return its packets."""
    random = np.random.default_rng(7)
    images = [
        cv2.GaussianBlur(random.uniform(0, 255, (144, 192)).astype(np.float32), (0, 0), 2.0) for _ in range(FRAME_COUNT)
    ]
    write_video(
        path,
        "mjpeg",
        "yuvj420p",
        options=options,
        frames=[(3.0 * p - 255.0).clip(0, 255).astype(np.uint8) for p in images],
    )
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def change_packets(path: Path, changed: Callable[[int, bytes], bytes]) -> None:
    """Replace a video's packets by `changed(number, content)`."""
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    with av.open(str(path), "w") as output:
        stream = output.add_stream("mjpeg", rate=100)
        stream.height, stream.width, stream.pix_fmt = 144, 192, "yuvj420p"
        for number, content in enumerate(packets):
            packet = av.Packet(changed(number, content))
            packet.stream, packet.pts, packet.dts, packet.is_keyframe = stream, number, number, True
            output.mux(packet)


def test_luma_agrees_with_ffmpeg(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    write_mjpeg(path, qmin="2", qmax="2")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        ffmpeg, decoder = FFmpegDecoder(stream), JpegDecoder.of(path)
        assert decoder is not None
        for packet in container.demux(stream):
            ((_, ours, damaged),), ((_, expected, _),) = decoder.decode([packet]), ffmpeg.decode([packet])
            assert not damaged
            assert [frame.timestamp for frame in ours] == [frame.timestamp for frame in expected]
            for one, other in zip(ours, expected, strict=True):
                assert one.image is not None
                assert np.abs(one.image - other.image.astype(float)).max() <= 3


def test_overwritten_code_is_reported(tmp_path: Path) -> None:
    """Up to 400 bytes are overwritten or zeroed. At most 4 % of the images may be wrong; with FFmpeg more are."""
    path = tmp_path / "a.avi"
    packets = write_mjpeg(path)
    decoder = JpegDecoder.of(path)
    assert decoder is not None
    random = np.random.default_rng(8)
    wrong = {"ours": 0, "ffmpeg": 0}
    with av.open(str(path)) as container:
        ffmpeg = FFmpegDecoder(container.streams.video[0])
        for trial in range(300):
            content = packets[trial % FRAME_COUNT]
            head = content.index(b"\xff\xda") + 14
            start = int(random.integers(head, len(content) - 2))
            length = min(int(random.integers(1, 400)), len(content) - 2 - start)
            other = random.bytes(length) if trial % 2 else bytes(length)
            damaged = content[:start] + other + content[start + length :]
            for name, decode in (("ours", decoder.decode), ("ffmpeg", ffmpeg.decode)):
                ((_, (truth,), _),) = decode([av.Packet(content)])
                for frame in decode([av.Packet(damaged)])[0][1]:
                    if frame.image is not None:
                        wrong[name] += np.abs(frame.image - truth.image.astype(float)).max() > 8
    assert wrong["ours"] <= 12
    assert wrong["ffmpeg"] > wrong["ours"]


def test_stray_bytes_from_a_camera_are_not_damage(tmp_path: Path) -> None:
    """Some webcams leave them before an image's end, as damage may do too. FFmpeg decodes these images."""
    path = tmp_path / "a.avi"
    write_mjpeg(path)
    intact = [frame.image for frame in open_video(path).read()]
    change_packets(path, lambda number, content: content[:-2] + bytes(6 + number % 3) + content[-2:])
    assert JpegDecoder.of(path) is None
    for frame, image in zip(open_video(path).read(), intact, strict=True):
        assert frame.image is not None
        assert image is not None
        assert np.abs(frame.image - image.astype(float)).max() <= 3


def test_damaged_first_image_is_missing_and_the_others_correct(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    write_mjpeg(path)
    intact = [frame.image for frame in open_video(path).read()]
    change_packets(path, lambda number, content: content[: len(content) // 2] if number == 0 else content)
    found = [frame.image for frame in open_video(path).read()]
    assert found[0] is None
    for image, before in zip(found[1:], intact[1:], strict=True):
        np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("number", [0, 7])
def test_damaged_file_in_a_folder_is_missing(tmp_path: Path, number: int) -> None:
    """OpenCV decodes the damaged file all the same."""
    folder = write_jpeg_folder(tmp_path)
    truth = [frame.image for frame in open_video(folder).read()]
    path = folder / f"{number}.jpg"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] + bytes(60) + content[len(content) // 2 + 60 :])
    assert cv2.imread(str(path)) is not None
    found = [frame.image for frame in open_video(folder).read()]
    assert [k for k, image in enumerate(found) if image is None] == [number]
    for k, image in enumerate(found):
        if image is not None:
            np.testing.assert_array_equal(image, truth[k])


def test_files_that_opencv_cannot_read_are_missing(tmp_path: Path) -> None:
    """One is empty, and the header of another claims four thousand million pixels."""
    folder = write_jpeg_folder(tmp_path)
    huge = bytearray(cv2.imencode(".bmp", np.zeros((8, 8), np.uint8))[1].tobytes())
    huge[18:26] = b"\0\0\1\0" * 2
    (folder / "3.bmp").write_bytes(huge)
    (folder / "3.jpg").write_bytes(b"")
    (folder / "4.png").write_bytes(b"")
    missing = [frame.image is None for frame in open_video(folder).read()]
    assert missing == [False] * 3 + [True] * 2 + [False, True] + [False] * (FRAME_COUNT - 5)


def test_stray_bytes_in_every_file_are_not_damage(tmp_path: Path) -> None:
    folder = write_jpeg_folder(tmp_path)
    for path in folder.iterdir():
        content = path.read_bytes()
        path.write_bytes(content[:-2] + bytes(6) + content[-2:])
    assert all(frame.image is not None for frame in open_video(folder).read())


def write_jpeg_folder(parent: Path) -> Path:
    """Write the frames of the video as single files."""
    (parent / "run").mkdir()
    for number, content in enumerate(write_mjpeg(parent / "a.avi")):
        (parent / "run" / f"{number}.jpg").write_bytes(content)
    return parent / "run"


def test_header_with_another_size_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    packets = write_mjpeg(path)
    decoder = JpegDecoder.of(path)
    assert decoder is not None
    offset = packets[0].index(b"\xff\xc0") + 5
    for claimed in (b"\xff\xff\xff\xff", b"\x00\x10\x00\x10"):
        packet = av.Packet(packets[0][:offset] + claimed + packets[0][offset + 4 :])
        assert decoder.decode([packet]) == [(packet, [], True)]
