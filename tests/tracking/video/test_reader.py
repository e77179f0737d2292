import struct
import threading
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from support import RAMP_FRAMES, ramp_frame, write_video

from rafl.common.errors import InputError
from rafl.tracking.video.decoding import Decoder, _decode_all, read_frames
from rafl.tracking.video.frame_order import DecodedFrame, DecodedPacket, FrameOrder
from rafl.tracking.video.reader import open_video

LOW_LOSS_OPTIONS = {
    "libx264": {"crf": "4"},
    "libx265": {"crf": "4", "x265-params": "log-level=none"},
    "libsvtav1": {"crf": "4", "preset": "10"},
}


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mkv", "ffv1", "gray"),
        ("a.avi", "mjpeg", "yuvj420p"),
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mov", "prores_ks", "yuv422p10le"),
        ("b.mkv", "ffv1", "gray10le"),
        ("c.mkv", "ffv1", "gray16le"),
        ("d.mp4", "libx265", "yuv420p10le"),
        ("e.mp4", "libsvtav1", "yuv420p"),
        ("f.avi", "rawvideo", "gray"),
        ("g.avi", "rawvideo", "bgr24"),
    ],
)
def test_images_and_times(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    """Every frame is read in order with its time; grey levels agree up to the format's loss and range."""
    path = tmp_path / name
    write_video(path, codec, pixels, options=LOW_LOSS_OPTIONS.get(codec))
    video = open_video(path)
    assert video.size == (96, 64)
    images = [(frame.time, frame.image) for frame in video.read()]
    assert len(images) == RAMP_FRAMES
    for number, (time, image) in enumerate(images):
        assert time == pytest.approx(0.01 * number, abs=1e-4)
        assert image is not None
        assert image.dtype == (np.float32 if "10" in pixels or "16" in pixels else np.uint8)
        # The format may map the grey levels affinely (limited or full range).
        fit = np.polyfit(ramp_frame(number).ravel(), image.ravel().astype(float), 1)
        assert 0.8 < fit[0] < 1.2
        assert np.abs(np.polyval(fit, ramp_frame(number)) - image).mean() < 3.0


def test_image_folder_is_sorted_by_number(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for number in range(RAMP_FRAMES):
        cv2.imwrite(str(folder / f"img{number}.png"), ramp_frame(number))
    video = open_video(folder)
    assert video.frames == RAMP_FRAMES
    for number, (time, image) in enumerate((frame.time, frame.image) for frame in video.read()):
        assert np.isnan(time)
        np.testing.assert_array_equal(image, ramp_frame(number))


@pytest.mark.parametrize(
    ("name", "codec", "pixels"), [("a.avi", "mjpeg", "yuvj420p"), ("a.mov", "prores_ks", "yuv422p10le")]
)
def test_parallel_decoders_agree_with_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, codec: str, pixels: str
) -> None:
    """Images that decode slowly and quickly, one of them damaged, come in order with their times."""
    random = np.random.default_rng(4)
    images = [np.full((240, 320), 4 * k, np.uint8) for k in range(40)]
    for number in range(0, 40, 3):
        images[number] = random.integers(0, 256, (240, 320)).astype(np.uint8)
    path = tmp_path / name
    write_video(path, codec, pixels, frames=images)
    with av.open(str(path)) as container:
        packet = [bytes(packet) for packet in container.demux(video=0) if packet.size][12]
    content = bytearray(path.read_bytes())
    start = content.find(packet)
    content[start + len(packet) // 4 : start + len(packet)] = bytes(len(packet) - len(packet) // 4)
    path.write_bytes(content)
    found = []
    monkeypatch.setattr("rafl.tracking.video.decoding.BYTES_PER_DECODER", 100)
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    for max_decoders in (1, 4):
        monkeypatch.setattr("rafl.tracking.video.decoding.MAX_DECODERS", max_decoders)
        found.append(list(open_video(path).read()))
    assert [k for k, frame in enumerate(found[1]) if frame.image is None] == [12]
    for one, other in zip(*found, strict=True):
        assert one.time == other.time
        np.testing.assert_array_equal(one.image, other.image)


def test_large_images_get_several_decoders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as keep pace with tracking, but no more than four."""
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    decoder_counts: list[int] = []

    def counting_decode_all(packets: Iterator[av.Packet], decoders: list[Decoder]) -> Iterator[object]:
        decoder_counts.append(len(decoders))
        return _decode_all(packets, decoders)

    monkeypatch.setattr("rafl.tracking.video.decoding._decode_all", counting_decode_all)
    random = np.random.default_rng(4)
    for side in (64, 800):
        images = [random.integers(0, 256, (side, side)).astype(np.uint8)] * 6
        for name, codec, pixels in (("a.avi", "mjpeg", "yuvj420p"), ("a.mov", "prores_ks", "yuv422p10le")):
            write_video(tmp_path / name, codec, pixels, frames=images)
            assert len(list(open_video(tmp_path / name).read())) == 6
    assert decoder_counts == [1, 1, 4, 4]


def test_reading_can_stop_while_decoders_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "a.avi", "mjpeg", "yuvj420p")
    monkeypatch.setattr("rafl.tracking.video.decoding.BYTES_PER_DECODER", 100)
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    running = threading.active_count()
    reading = read_frames(tmp_path / "a.avi", 0, 0.0, [])
    next(reading)
    reading.close()
    assert threading.active_count() == running


def test_timestamp_far_ahead_does_not_delay_other_frames() -> None:
    """One packet of a hundred has a wrong timestamp; the other frames are still passed on one by one."""
    order = FrameOrder()
    packets = [
        packet_with_output(10**9 if number == 20 else number, number == 0, *([] if number == 20 else [number]))
        for number in range(100)
    ]
    shown = []
    for frame in order.frames(packets):
        shown.append(frame)
        assert len(order.held) <= 33
    assert [round(100 * frame.time) for frame in shown] == [*range(20), *range(21, 100), 10**9]
    assert all(frame.image is not None for frame in shown[:-1])


def test_frame_output_after_its_slot_was_lost_is_dropped() -> None:
    """A damaged packet's frame may be output long after later ones. Every slot is passed on once."""
    outputs = [[0], [1], [], [3], [4], [5, 2]]
    shown = list(FrameOrder().frames(packet_with_output(number, True, *outputs[number]) for number in range(6)))
    assert [round(100 * frame.time) for frame in shown] == list(range(6))
    assert [frame.image is None for frame in shown] == [number == 2 for number in range(6)]


def packet_with_output(timestamp: int, random_access: bool, *output: int) -> DecodedPacket:
    """Packet at a timestamp [10 ms], after which the decoder outputs the frames with the timestamps `output`."""
    frames = [DecodedFrame(number, ramp_frame(number % 12)) for number in output]
    return DecodedPacket(timestamp, random_access, 0.01, frames, damaged=False)


def test_dropped_frames_and_uneven_times_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    timestamps = [0, 10, 20, 50, 60, 71, 80]
    with av.open(str(path), "w") as output:
        stream = output.add_stream("ffv1", rate=100)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "gray"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, timestamp in enumerate(timestamps):
            frame = av.VideoFrame.from_ndarray(ramp_frame(number), format="gray")
            frame.pts, frame.time_base = timestamp, Fraction(1, 1000)
            output.mux(stream.encode(frame))
        output.mux(stream.encode())
    reading = open_video(path).read()
    np.testing.assert_allclose([frame.time for frame in reading], 1e-3 * np.array(timestamps), atol=1e-4)
    assert any("1 gaps" in note for note in reading.notes)


def test_wrong_announced_rate_is_noted(tmp_path: Path) -> None:
    """The container announces another frame rate than its timestamps have."""
    path = tmp_path / "a.mkv"
    write_video(path, "ffv1", "gray", rate=50)
    video = replace(open_video(path), fps=30.0, frames=40)
    reading = video.read()
    assert len(list(reading)) == RAMP_FRAMES
    assert any("30 frames/s" in note and "50" in note for note in reading.notes)
    assert any("announces 40 frames and holds 12" in note for note in reading.notes)


def set_quarter_turn(path: Path) -> None:
    """Set a video's display matrix to a clockwise quarter turn."""
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 44  # after version, times, number, duration, layer and volume
    one = 0x10000
    content[matrix : matrix + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 64 * one, 0, 0x40000000)
    path.write_bytes(content)


@pytest.mark.parametrize(("name", "codec", "pixels"), [("a.mp4", "libx264", "yuv420p"), ("a.mov", "mjpeg", "yuvj420p")])
def test_display_rotation_is_applied(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    """Telephones store rotated images and a quarter turn in the file's display matrix."""
    path = tmp_path / name
    write_video(path, codec, pixels, options=LOW_LOSS_OPTIONS.get(codec))
    set_quarter_turn(path)
    video = open_video(path)
    assert video.size == (64, 96)
    image = next(iter(video.read())).image
    assert image is not None
    clockwise = np.rot90(ramp_frame(0), -1)
    assert np.corrcoef(image.ravel(), clockwise.ravel())[0, 1] > 0.99


def test_title_that_is_not_utf8_is_accepted(tmp_path: Path) -> None:
    """Older cameras and programs write titles in Latin-1."""
    path = tmp_path / "a.mp4"
    write_video(path, "libx264", "yuv420p", title="MESSGERAET")
    path.write_bytes(path.read_bytes().replace(b"MESSGERAET", "MESSGERÄTE".encode("latin-1")))
    assert b"\xc4" in path.read_bytes()
    assert sum(frame.image is not None for frame in open_video(path).read()) == 12


def test_predicted_frames_are_those_of_lossy_codecs_with_references(tmp_path: Path) -> None:
    for name, codec, pixels, predicted in (
        ("a.mp4", "libx264", "yuv420p", True),
        ("a.mov", "mjpeg", "yuvj420p", False),
        ("a.mkv", "ffv1", "gray", False),
    ):
        write_video(tmp_path / name, codec, pixels)
        assert open_video(tmp_path / name).predicted_frames == predicted


def test_sixteen_bit_images(tmp_path: Path) -> None:
    """A 16-bit PNG holds 12 bits."""
    folder = tmp_path / "run"
    folder.mkdir()
    for number in range(2):
        cv2.imwrite(str(folder / f"{number}.png"), (ramp_frame(number).astype(np.uint16) * 16 + 5))
    for number, frame in enumerate(open_video(folder).read()):
        np.testing.assert_allclose(frame.image, ramp_frame(number) + 5 / 16)


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [("a.mp4", "libx264", {"x264-params": "tff=1"}), ("a.mpg", "mpeg2video", {"flags": "+ildct+ilme"})],
)
def test_interlaced_video_is_refused(tmp_path: Path, name: str, codec: str, options: dict[str, str]) -> None:
    path = tmp_path / name
    write_video(path, codec, "yuv420p", rate=50, options=options)
    with pytest.raises(InputError, match=f"{name}: expected frames that are exposed at once, found interlaced ones"):
        open_video(path)


def test_stopping_early_leaves_no_thread(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mkv", "ffv1", "gray")
    before = threading.active_count()
    frames = iter(open_video(tmp_path / "a.mkv").read())
    next(frames)
    frames.close()
    assert threading.active_count() == before


@pytest.mark.parametrize(("tag", "rate"), [("240.000000", 240.0), ("nan", 0.0), ("fast", 0.0), (None, 0.0)])
def test_capture_rate_of_slow_motion_files(tmp_path: Path, tag: str | None, rate: float) -> None:
    path = tmp_path / "a.mov"
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        if tag is not None:
            container.metadata["com.android.capture.fps"] = tag
        stream = container.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuvj420p"
        image = np.zeros((64, 96, 3), np.uint8)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    assert open_video(path).capture_fps == rate
