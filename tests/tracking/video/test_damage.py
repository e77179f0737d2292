"""Damaged video files give correct frames and missing frames, but no wrong frames."""

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from support import RAMP_FRAMES, ramp_frame, write_video

from rafl.common.errors import InputError
from rafl.tracking.video.ffmpeg import read_packets
from rafl.tracking.video.reader import open_video

CHECKSUM_OPTIONS = {"libx264": {"g": "6"}, "ffv1": {"level": "3", "slicecrc": "1", "g": "6"}}  # short groups, checksums
FINE_OPTIONS = {
    "libx264": {"crf": "4"},
    "libx265": {"crf": "4", "x265-params": "log-level=none"},
}


def test_file_truncated_before_first_frame_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, "libx264", "yuv420p")
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(InputError, match=r"a\.mp4"):
        list(open_video(path).read())


def test_decodable_frames_of_a_truncated_file_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    write_video(path, "ffv1", "gray")
    content = path.read_bytes()
    path.write_bytes(content[: int(0.6 * len(content))])
    reading = open_video(path).read()
    frames = list(reading)
    decoded = [frame for frame in frames if frame.image is not None]
    assert 4 <= len(decoded) < RAMP_FRAMES
    for number, frame in enumerate(decoded):
        np.testing.assert_array_equal(frame.image, ramp_frame(number))


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "intra"),
    [
        ("a.mkv", "ffv1", "gray", False),
        ("a.mov", "prores_ks", "yuv422p10le", True),
        ("a.avi", "mjpeg", "yuvj420p", True),
        ("a.mp4", "libx264", "yuv420p", False),
    ],
)
def test_damaged_frames_are_missing_and_the_others_correct(
    tmp_path: Path, name: str, codec: str, pixels: str, intra: bool
) -> None:
    """With a packet's bytes overwritten no image is wrong, and every frame keeps its slot and time."""
    path = tmp_path / name
    write_video(path, codec, pixels, options=CHECKSUM_OPTIONS.get(codec))
    truth = [frame.image for frame in open_video(path).read()]
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    content = bytearray(path.read_bytes())
    start, size = content.find(packets[4]), len(packets[4])
    content[start + size // 4 : start + size] = bytes(size - size // 4)
    path.write_bytes(content)
    frames = list(open_video(path).read())
    assert len(frames) == RAMP_FRAMES
    np.testing.assert_allclose([frame.time for frame in frames], 0.01 * np.arange(RAMP_FRAMES), atol=1e-4)
    missing = [number for number, frame in enumerate(frames) if frame.image is None]
    assert missing
    assert missing == [4] if intra else set(missing) <= set(range(1, 7))
    for frame, image in zip(frames, truth, strict=True):
        if frame.image is not None:
            np.testing.assert_array_equal(frame.image, image)


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_zeros_within_an_image_are_damage(tmp_path: Path, name: str, codec: str) -> None:
    """Lost disk sectors read as zeros, which HEVC's decoder accepts. Intact files give all frames."""
    path = tmp_path / name
    random = np.random.default_rng(5)
    images = [random.integers(0, 256, (96, 128)).astype(np.uint8) for _ in range(10)]
    write_video(path, codec, "yuv420p", options=FINE_OPTIONS[codec] | {"g": "5"}, frames=images)
    truth = [frame.image for frame in open_video(path).read()]
    assert all(image is not None for image in truth)
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    content = path.read_bytes()
    for number in range(2, 10):
        damaged = bytearray(content)
        length = int(random.integers(16, 400))
        last = len(packets[number]) - length
        start = content.find(packets[number]) + (last if number % 3 == 0 else int(random.integers(20, last)))
        damaged[start : start + length] = bytes(length)
        path.write_bytes(damaged)
        frames = list(open_video(path).read())
        assert any(frame.image is None for frame in frames)
        for frame, image in zip(frames, truth, strict=True):
            if frame.image is not None:
                np.testing.assert_array_equal(frame.image, image)


def test_zeros_written_after_every_image_are_not_damage(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", "libx264", "yuv420p", options={"x264-params": "slices=1"})
    truth = [frame.image for frame in open_video(tmp_path / "a.mp4").read()]
    with av.open(str(tmp_path / "a.mp4")) as source, av.open(str(tmp_path / "b.mp4"), "w") as output:
        stream = output.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                units = bytes(packet)
                last = 0  # offset of the last unit's length field
                while (after := last + 4 + int.from_bytes(units[last : last + 4], "big")) < len(units):
                    last = after
                longer = (len(units) - last + 4).to_bytes(4, "big")
                padded = av.Packet(units[:last] + longer + units[last + 4 :] + bytes(8))
                padded.stream, padded.time_base, padded.duration = stream, packet.time_base, packet.duration
                padded.pts, padded.dts = packet.pts, packet.dts
                padded.is_keyframe = packet.is_keyframe
                output.mux(padded)
    found = [frame.image for frame in open_video(tmp_path / "b.mp4").read()]
    for image, before in zip(found, truth, strict=True):
        np.testing.assert_array_equal(image, before)


def moving_texture(random: np.random.Generator, count: int = 20) -> list[np.ndarray]:
    """Images of a texture that moves to and fro by 2 px a frame."""
    texture = cv2.GaussianBlur(random.uniform(0, 255, (150, 200)).astype(np.float32), (0, 0), 2.0) * 3.0 - 255.0
    offsets = [2 * abs((k + 19) % 38 - 19) for k in range(count)]
    images = [texture[8:136, offset : offset + 160] + random.normal(0.0, 6.0, (128, 160)) for offset in offsets]
    return [np.clip(image, 0, 255).astype(np.uint8) for image in images]


def count_lost_and_wrong(path: Path, packet: int, start: int, content: bytes) -> tuple[int, int]:
    """Number of missing frames and of wrong frames after a packet's bytes from `start` are overwritten."""
    intact = path.read_bytes()
    truth = [frame.image for frame in open_video(path).read()]
    assert all(image is not None for image in truth)
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    start += intact.find(packets[packet])
    damaged = path.with_stem("damaged")
    damaged.write_bytes(intact[:start] + content + intact[start + len(content) :])
    found = [frame.image for frame in open_video(damaged).read()]
    pairs = [(one, other) for one, other in zip(found, truth, strict=True) if one is not None]
    return len(truth) - len(pairs), sum(np.abs(one.astype(float) - other).max() > 8.0 for one, other in pairs)


def test_frames_shown_before_a_damaged_one_they_refer_to_are_missing(tmp_path: Path) -> None:
    """H.264 with B frames; the beginning of a packet is overwritten."""
    path = tmp_path / "a.mp4"
    random = np.random.default_rng(3)
    options = {"crf": "20", "bf": "3", "g": "10"}
    write_video(path, "libx264", "yuv420p", options=options, frames=moving_texture(random))
    results = [
        count_lost_and_wrong(path, int(random.integers(1, 20)), int(random.integers(5, 20)), random.bytes(12))
        for _ in range(30)
    ]
    lost, wrong = np.sum(results, axis=0)
    assert 30 <= lost < 300
    assert wrong == 0


def test_most_damage_to_av1_is_found(tmp_path: Path) -> None:
    """A bit or some bytes are overwritten. The decoder reports what its checks find."""
    path = tmp_path / "a.mp4"
    random = np.random.default_rng(6)
    options = {"crf": "20", "preset": "10", "g": "10"}
    write_video(path, "libsvtav1", "yuv420p", options=options, frames=moving_texture(random))
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    wrong_copies = 0
    for number in range(40):
        packet = int(random.integers(20))
        start = int(random.integers(len(packets[packet])))
        noise = random.bytes(min(12, len(packets[packet]) - start))
        bit = bytes([packets[packet][start] ^ 1 << int(random.integers(8))])
        wrong_copies += count_lost_and_wrong(path, packet, start, bit if number % 2 else noise)[1] > 0
    assert wrong_copies <= 2


def test_stream_that_begins_within_a_file_is_skipped() -> None:
    """Damage to an MPEG transport stream can imitate one; PyAV raises IndexError for its number."""

    class Container:
        remaining = iter([1, 2, IndexError(), 3, IndexError()])

        def demux(self, _: object) -> Iterator[object]:
            for item in self.remaining:
                if isinstance(item, IndexError):
                    raise item
                yield item

    notes: list[str] = []
    assert list(read_packets(Container(), None, notes)) == [1, 2, 3]
    assert not notes


@pytest.mark.parametrize("b_frames", ["bframes=0", "bframes=2"])
def test_images_recover_by_periodic_intra_refresh(tmp_path: Path, b_frames: str) -> None:
    """H.264 whose only true key frame is the first; packets that begin a refresh are marked as key frames."""
    path = tmp_path / "a.mp4"
    random = np.random.default_rng(7)
    options = {"crf": "20", "x264-params": f"intra-refresh=1:keyint=20:{b_frames}"}
    write_video(path, "libx264", "yuv420p", options=options, frames=moving_texture(random, 80))
    lost, wrong = np.transpose([count_lost_and_wrong(path, packet, 8, random.bytes(12)) for packet in range(5, 30, 4)])
    assert 8 < np.median(lost) < 50
    assert not wrong.any()


def test_stream_without_timestamps_keeps_a_slot_for_every_frame(tmp_path: Path) -> None:
    """H.264 without a container, as from small cameras: the frame after a lost one does not take its slot."""
    path = tmp_path / "a.h264"
    random = np.random.default_rng(8)
    options = {"crf": "20", "g": "10", "bf": "0"}
    write_video(path, "libx264", "yuv420p", options=options, frames=moving_texture(random, 40))
    lost, wrong = np.transpose([count_lost_and_wrong(path, packet, 40, random.bytes(12)) for packet in range(4, 36, 3)])
    assert lost.all()
    assert lost.max() < 36
    assert not wrong.any()
