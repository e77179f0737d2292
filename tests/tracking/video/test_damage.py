"""What damage to a video file leaves of it: frames that are right, and frames that are missing."""

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from rafl.tracking.video.ffmpeg import FFmpegDecoder, packets_of
from rafl.tracking.video.reader import open_video
from support import FRAMES, ramp, write_video

from rafl.common.errors import InputError

SAFE = {"libx264": {"g": "6"}, "ffv1": {"level": "3", "slicecrc": "1", "g": "6"}}  # short groups, checksums
FINE = {
    "libx264": {"crf": "4"},
    "libx265": {"crf": "4", "x265-params": "log-level=none"},
}


def test_a_file_cut_before_its_first_frame_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, "libx264", "yuv420p")
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(InputError, match=r"a\.mp4"):
        list(open_video(path).read())


def test_of_a_cut_file_what_decodes_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    write_video(path, "ffv1", "gray")
    content = path.read_bytes()
    path.write_bytes(content[: int(0.6 * len(content))])
    reading = open_video(path).read()
    frames = list(reading)
    whole = [frame for frame in frames if frame.picture is not None]
    assert 4 <= len(whole) < FRAMES
    for number, frame in enumerate(whole):
        np.testing.assert_array_equal(frame.picture, ramp(number))


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "intra"),
    [
        ("a.mkv", "ffv1", "gray", False),
        ("a.mov", "prores_ks", "yuv422p10le", True),
        ("a.avi", "mjpeg", "yuvj420p", True),
        ("a.mp4", "libx264", "yuv420p", False),
    ],
)
def test_damaged_frames_are_missing_and_the_others_right(
    tmp_path: Path, name: str, codec: str, pixels: str, intra: bool
) -> None:
    """A packet's bytes are overwritten: no wrong picture comes out, and every frame keeps its slot and time."""
    path = tmp_path / name
    write_video(path, codec, pixels, options=SAFE.get(codec))
    truth = [frame.picture for frame in open_video(path).read()]
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    content = bytearray(path.read_bytes())
    start, size = content.find(packets[4]), len(packets[4])
    content[start + size // 4 : start + size] = bytes(size - size // 4)
    path.write_bytes(content)
    frames = list(open_video(path).read())
    assert len(frames) == FRAMES
    np.testing.assert_allclose([frame.time for frame in frames], 0.01 * np.arange(FRAMES), atol=1e-4)
    gone = [number for number, frame in enumerate(frames) if frame.picture is None]
    assert gone
    assert gone == [4] if intra else set(gone) <= set(range(1, 7))
    for frame, picture in zip(frames, truth, strict=True):
        if frame.picture is not None:
            np.testing.assert_array_equal(frame.picture, picture)


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_zeros_within_a_picture_are_damage(tmp_path: Path, name: str, codec: str) -> None:
    """As a disk's lost sectors leave them; HEVC's decoder takes them for pictures. Whole files are not suspected."""
    path = tmp_path / name
    random = np.random.default_rng(5)
    pictures = [random.integers(0, 256, (96, 128)).astype(np.uint8) for _ in range(10)]
    write_video(path, codec, "yuv420p", options=FINE[codec] | {"g": "5"}, pictures=pictures)
    truth = [frame.picture for frame in open_video(path).read()]
    assert all(picture is not None for picture in truth)
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
        assert any(frame.picture is None for frame in frames)
        for frame, picture in zip(frames, truth, strict=True):
            if frame.picture is not None:
                np.testing.assert_array_equal(frame.picture, picture)


def test_zeros_that_a_program_writes_after_every_picture_are_no_damage(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", "libx264", "yuv420p", options={"x264-params": "slices=1"})
    truth = [frame.picture for frame in open_video(tmp_path / "a.mp4").read()]
    with av.open(str(tmp_path / "a.mp4")) as source, av.open(str(tmp_path / "b.mp4"), "w") as output:
        stream = output.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                units = bytes(packet)
                last = 0  # where the length of the last unit is
                while (after := last + 4 + int.from_bytes(units[last : last + 4], "big")) < len(units):
                    last = after
                longer = (len(units) - last + 4).to_bytes(4, "big")
                padded = av.Packet(units[:last] + longer + units[last + 4 :] + bytes(8))
                padded.stream, padded.time_base, padded.duration = stream, packet.time_base, packet.duration
                padded.pts, padded.dts = packet.pts, packet.dts
                padded.is_keyframe = packet.is_keyframe
                output.mux(padded)
    found = [frame.picture for frame in open_video(tmp_path / "b.mp4").read()]
    for picture, before in zip(found, truth, strict=True):
        np.testing.assert_array_equal(picture, before)


def moving_texture(random: np.random.Generator, count: int = 20) -> list[np.ndarray]:
    """To and fro by 2 px a frame."""
    texture = cv2.GaussianBlur(random.uniform(0, 255, (150, 200)).astype(np.float32), (0, 0), 2.0) * 3.0 - 255.0
    places = [2 * abs((k + 19) % 38 - 19) for k in range(count)]
    pictures = [texture[8:136, place : place + 160] + random.normal(0.0, 6.0, (128, 160)) for place in places]
    return [np.clip(picture, 0, 255).astype(np.uint8) for picture in pictures]


def lost_and_wrong(path: Path, packet: int, start: int, content: bytes) -> tuple[int, int]:
    """Frames that are missing, and frames that are not what they were, once a packet's bytes are overwritten."""
    whole = path.read_bytes()
    truth = [frame.picture for frame in open_video(path).read()]
    assert all(picture is not None for picture in truth)
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    start += whole.find(packets[packet])
    damaged = path.with_stem("damaged")
    damaged.write_bytes(whole[:start] + content + whole[start + len(content) :])
    found = [frame.picture for frame in open_video(damaged).read()]
    pairs = [(one, other) for one, other in zip(found, truth, strict=True) if one is not None]
    return len(truth) - len(pairs), sum(np.abs(one.astype(float) - other).max() > 8.0 for one, other in pairs)


def test_frames_that_refer_to_a_damaged_one_are_missing_though_shown_before_it(tmp_path: Path) -> None:
    """H.264 with B-frames, a packet's beginning overwritten."""
    path = tmp_path / "a.mp4"
    random = np.random.default_rng(3)
    options = {"crf": "20", "bf": "3", "g": "10"}
    write_video(path, "libx264", "yuv420p", options=options, pictures=moving_texture(random))
    results = [
        lost_and_wrong(path, int(random.integers(1, 20)), int(random.integers(5, 20)), random.bytes(12))
        for _ in range(30)
    ]
    lost, wrong = np.sum(results, axis=0)
    assert 30 <= lost < 300
    assert wrong == 0


@pytest.mark.parametrize(
    ("codec", "options", "most"),
    [
        ("libx265", {"x265-params": "log-level=none:ctu=16:keyint=10"}, 4),
        ("libx265", {"x265-params": "log-level=none:ctu=16:keyint=10:wpp=0"}, 4),  # without marks where rows begin
        ("libsvtav1", {"crf": "20", "preset": "10", "g": "10"}, 2),
    ],
)
def test_what_decoders_read_in_silence_is_hardly_ever_taken(
    tmp_path: Path, codec: str, options: dict[str, str], most: int
) -> None:
    """A bit or some bytes of HEVC and AV1 overwritten; FFmpeg alone gives wrong pictures of a third of these copies."""
    path = tmp_path / "a.mp4"
    random = np.random.default_rng(6)
    write_video(path, codec, "yuv420p", options=options, pictures=moving_texture(random))
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    copies = 0
    for number in range(40):
        packet = int(random.integers(20))
        start = int(random.integers(len(packets[packet])))
        some = random.bytes(min(12, len(packets[packet]) - start))
        bit = bytes([packets[packet][start] ^ 1 << int(random.integers(8))])
        copies += lost_and_wrong(path, packet, start, bit if number % 2 else some)[1] > 0
    assert copies <= most


def test_intact_hevc_is_found_intact_time_and_again(tmp_path: Path) -> None:
    """Its pictures take motion from earlier ones, and weights by it: on their own, from what must not be left over."""
    path = tmp_path / "a.mp4"
    write_video(path, "libx265", "yuv420p", options={"x265-params": "log-level=none:bframes=0:qp=24"})
    for _ in range(30):
        assert all(frame.picture is not None for frame in open_video(path).read())


def test_h264_tells_of_damage_with_the_packet(tmp_path: Path) -> None:
    """So that frames shown before a damaged one, which refer to it, need not wait for it to come out.

    A bit of a picture is turned over, which often only leaves a part of it undecoded.
    """
    path, damaged = tmp_path / "a.mp4", tmp_path / "damaged.mp4"
    random = np.random.default_rng(9)
    write_video(path, "libx264", "yuv420p", options={"crf": "20", "bf": "3"}, pictures=moving_texture(random))
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    marked: list[int | None] = []
    for _ in range(60):
        content, victim = bytearray(path.read_bytes()), packets[random.integers(len(packets))]
        content[content.find(victim) + random.integers(40, len(victim))] ^= 1 << random.integers(8)
        damaged.write_bytes(content)
        with av.open(str(damaged)) as container:
            decoder = FFmpegDecoder(container.streams.video[0])
            told = set()
            for packet in container.demux(video=0):
                frames, complained = decoder.decoded(packet)
                told |= {packet.pts} if complained else set()
                marked += [frame.pts for frame in frames if frame.is_corrupt]
                assert all(frame.pts in told for frame in frames if frame.is_corrupt)
    assert len(marked) > 5


def test_another_stream_that_seems_to_begin_amid_a_file_is_passed_over() -> None:
    """As damage makes it seem in an MPEG transport stream; PyAV does not know its number."""

    class Container:
        left = iter([1, 2, IndexError(), 3, IndexError()])

        def demux(self, _: object) -> Iterator[object]:
            for item in self.left:
                if isinstance(item, IndexError):
                    raise item
                yield item

    notes: list[str] = []
    assert list(packets_of(Container(), None, notes)) == [1, 2, 3]
    assert not notes


@pytest.mark.parametrize("others", ["bframes=0", "bframes=2"])
def test_pictures_that_are_renewed_column_by_column_come_back_whole(tmp_path: Path, others: str) -> None:
    """H.264 without key frames but the first: the packet that begins a renewal passes for one."""
    path = tmp_path / "a.mp4"
    random = np.random.default_rng(7)
    options = {"crf": "20", "x264-params": f"intra-refresh=1:keyint=20:{others}"}
    write_video(path, "libx264", "yuv420p", options=options, pictures=moving_texture(random, 80))
    lost, wrong = np.transpose([lost_and_wrong(path, packet, 8, random.bytes(12)) for packet in range(5, 30, 4)])
    assert 8 < np.median(lost) < 50
    assert not wrong.any()


def test_a_stream_without_times_keeps_a_slot_for_every_frame(tmp_path: Path) -> None:
    """H.264 as small cameras write it, without a container: what comes after a lost frame is not taken for it."""
    path = tmp_path / "a.h264"
    random = np.random.default_rng(8)
    options = {"crf": "20", "g": "10", "bf": "0"}
    write_video(path, "libx264", "yuv420p", options=options, pictures=moving_texture(random, 40))
    lost, wrong = np.transpose([lost_and_wrong(path, packet, 40, random.bytes(12)) for packet in range(4, 36, 3)])
    assert lost.all()
    assert lost.max() < 36
    assert not wrong.any()
