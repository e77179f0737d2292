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
from rafl.tracking.video.decoding import Decoder, _all_decoded, frames_of_file
from rafl.tracking.video.frame_order import Decoded, Order, Piece
from rafl.tracking.video.quantisation import HARM
from rafl.tracking.video.reader import open_video
from support import FRAMES, ramp, write_video

QUIET = {
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
def test_pictures_and_times(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    """Every frame comes back in order with its time; levels up to the format's own loss and range."""
    path = tmp_path / name
    write_video(path, codec, pixels, options=QUIET.get(codec))
    video = open_video(path)
    assert video.size == (96, 64)
    pictures = [(frame.time, frame.picture) for frame in video.read()]
    assert len(pictures) == FRAMES
    for number, (time, picture) in enumerate(pictures):
        assert time == pytest.approx(0.01 * number, abs=1e-4)
        assert picture is not None
        assert picture.dtype == (np.float32 if "10" in pixels or "16" in pixels else np.uint8)
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


@pytest.mark.parametrize(
    ("name", "codec", "pixels"), [("a.avi", "mjpeg", "yuvj420p"), ("a.mov", "prores_ks", "yuv422p10le")]
)
def test_decoders_side_by_side_give_what_one_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, codec: str, pixels: str
) -> None:
    """Pictures that take long and pictures that take no time, one of them damaged: in order, each with its own time."""
    random = np.random.default_rng(4)
    pictures = [np.full((240, 320), 4 * k, np.uint8) for k in range(40)]
    for number in range(0, 40, 3):
        pictures[number] = random.integers(0, 256, (240, 320)).astype(np.uint8)
    path = tmp_path / name
    write_video(path, codec, pixels, pictures=pictures)
    with av.open(str(path)) as container:
        packet = [bytes(packet) for packet in container.demux(video=0) if packet.size][12]
    content = bytearray(path.read_bytes())
    start = content.find(packet)
    content[start + len(packet) // 4 : start + len(packet)] = bytes(len(packet) - len(packet) // 4)
    path.write_bytes(content)
    found = []
    monkeypatch.setattr("rafl.tracking.video.decoding.BYTES_EACH", 100)
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    for most in (1, 4):
        monkeypatch.setattr("rafl.tracking.video.decoding.MOST_DECODERS", most)
        found.append(list(open_video(path).read()))
    assert [k for k, frame in enumerate(found[1]) if frame.picture is None] == [12]
    for one, other in zip(*found, strict=True):
        assert one.time == other.time
        np.testing.assert_array_equal(one.picture, other.picture)


def test_small_pictures_have_one_decoder_and_large_ones_several(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As many as keep pace with the follower, and no more than four."""
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    many: list[int] = []

    def counted(packets: Iterator[av.Packet], decoders: list[Decoder]) -> Iterator[object]:
        many.append(len(decoders))
        return _all_decoded(packets, decoders)

    monkeypatch.setattr("rafl.tracking.video.decoding._all_decoded", counted)
    random = np.random.default_rng(4)
    for side in (64, 800):
        pictures = [random.integers(0, 256, (side, side)).astype(np.uint8)] * 6
        for name, codec, pixels in (("a.avi", "mjpeg", "yuvj420p"), ("a.mov", "prores_ks", "yuv422p10le")):
            write_video(tmp_path / name, codec, pixels, pictures=pictures)
            assert len(list(open_video(tmp_path / name).read())) == 6
    assert many == [1, 1, 4, 4]


def test_reading_can_stop_while_decoders_are_at_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "a.avi", "mjpeg", "yuvj420p")
    monkeypatch.setattr("rafl.tracking.video.decoding.BYTES_EACH", 100)
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    running = threading.active_count()
    reading = frames_of_file(tmp_path / "a.avi", 0, 0.0, [])
    next(reading)
    reading.close()
    assert threading.active_count() == running


def test_a_stamp_far_ahead_does_not_keep_the_others_waiting() -> None:
    """One packet of a hundred is stamped with nonsense; the others come one by one all the same."""
    order = Order()
    pieces = [
        piece(10**9 if number == 20 else number, number == 0, *([] if number == 20 else [number]))
        for number in range(100)
    ]
    given = []
    for frame in order.frames(pieces):
        given.append(frame)
        assert len(order.held) <= 33
    assert [round(100 * frame.time) for frame in given] == [*range(20), *range(21, 100), 10**9]
    assert all(frame.picture is not None for frame in given[:-1])


def test_a_frame_that_comes_after_its_slot_was_given_up_is_dropped() -> None:
    """As a damaged packet's does, long after frames that are shown later: every slot is given on once."""
    out = [[0], [1], [], [3], [4], [5, 2]]
    given = list(Order().frames(piece(number, True, *out[number]) for number in range(6)))
    assert [round(100 * frame.time) for frame in given] == list(range(6))
    assert [frame.picture is None for frame in given] == [number == 2 for number in range(6)]


def piece(stamp: int, key: bool, *out: int) -> Piece:
    """A packet of a hundredth of a second's frame, after which the decoder gives some."""
    return Piece(stamp, key, 0.01, [Decoded(number, ramp(number % 12), None) for number in out], complained=False)


def test_dropped_frames_and_uneven_times_are_honoured(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    stamps = [0, 10, 20, 50, 60, 71, 80]
    with av.open(str(path), "w") as output:
        stream = output.add_stream("ffv1", rate=100)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "gray"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, stamp in enumerate(stamps):
            frame = av.VideoFrame.from_ndarray(ramp(number), format="gray")
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            output.mux(stream.encode(frame))
        output.mux(stream.encode())
    reading = open_video(path).read()
    np.testing.assert_allclose([frame.time for frame in reading], 1e-3 * np.array(stamps), atol=1e-4)
    assert any("1 gaps" in note for note in reading.notes)


def test_a_false_rate_is_noted(tmp_path: Path) -> None:
    """A container that announces another rate than its time stamps keep."""
    path = tmp_path / "a.mkv"
    write_video(path, "ffv1", "gray", rate=50)
    video = replace(open_video(path), fps=30.0, frames=40)
    reading = video.read()
    assert len(list(reading)) == FRAMES
    assert any("30 frames/s" in note and "50" in note for note in reading.notes)
    assert any("announces 40 frames and holds 12" in note for note in reading.notes)


def lay_on_its_side(path: Path) -> None:
    """Let a video's display matrix ask for a quarter turn clockwise."""
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 44  # after version, times, number, duration, layer and volume
    one = 0x10000
    content[matrix : matrix + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 64 * one, 0, 0x40000000)
    path.write_bytes(content)


@pytest.mark.parametrize(("name", "codec", "pixels"), [("a.mp4", "libx264", "yuv420p"), ("a.mov", "mjpeg", "yuvj420p")])
def test_a_video_marked_as_turned_is_shown_turned(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    """As telephones write it: the pictures lie on their side, the file's display matrix says a quarter turn."""
    path = tmp_path / name
    write_video(path, codec, pixels, options=QUIET.get(codec))
    lay_on_its_side(path)
    video = open_video(path)
    assert video.size == (64, 96)
    picture = next(iter(video.read())).picture
    assert picture is not None
    clockwise = np.rot90(ramp(0), -1)
    assert np.corrcoef(picture.ravel(), clockwise.ravel())[0, 1] > 0.99


def test_steps_of_coding_turn_with_the_picture(tmp_path: Path) -> None:
    """H.264 whose macroblocks differ; at a fixed quantiser of 30, whose step is 20 levels; Motion JPEG says none.

    An encoder in a hurry counts as a coarser one. The last frames are asked too.
    """
    path = tmp_path / "a.mp4"
    write_video(path, "libx264", "yuv420p", options={"crf": "25", "aq-mode": "1", "aq-strength": "2"})
    plain = [frame.steps for frame in open_video(path).read()]
    lay_on_its_side(path)
    turned = list(open_video(path).read())
    assert [number for number, steps in enumerate(plain) if steps is not None] == [0, 5, 10, 11]
    for number in (0, 5, 10, 11):
        steps = plain[number]
        assert steps is not None
        assert steps.shape == (4, 6)
        np.testing.assert_array_equal(turned[number].steps, np.rot90(steps, -1))
    assert len(np.unique(plain[0])) > 1
    corners = np.array([[0.0, 0.0], [63.4, 0.0], [63.4, 95.4], [np.nan, np.nan]])
    first = np.rot90(plain[0], -1)
    np.testing.assert_array_equal(turned[0].step_at(corners)[:3], [first[0, 0], first[0, 3], first[5, 3]])

    write_video(path, "libx264", "yuv420p", options={"qp": "30", "bf": "0"})
    later = list(open_video(path).read())[5]
    np.testing.assert_allclose(later.steps, 20.0)
    for preset, coarser in (("ultrafast", 2.4), ("veryfast", 1.0), ("faster", 1.2), ("medium", 1.0), ("slow", 1.0)):
        write_video(path, "libx264", "yuv420p", options={"qp": "30", "bf": "0", "preset": preset})
        np.testing.assert_allclose(list(open_video(path).read())[5].steps, coarser * 20.0)
    write_video(path.with_suffix(".avi"), "mjpeg", "yuvj420p")
    frame = next(iter(open_video(path.with_suffix(".avi")).read()))
    assert frame.steps is None
    assert np.isnan(frame.step_at(corners)).all()


def test_haste_makes_frames_lag_most_between_others(tmp_path: Path) -> None:
    """Every frame of twelve but 0, 4, 8 and the last is made of those before and after; of the last none is made."""
    path = tmp_path / "a.mp4"
    presets = ("veryfast", 1.8, 3.9, 3.9), ("faster", 1.0, 1.4, 2.0), ("medium", 1.0, 1.0, 2.0)
    for preset, most, between, last in presets:
        options = {"qp": "30", "bf": "3", "b-adapt": "0", "b-pyramid": "none", "preset": preset}
        write_video(path, "libx264", "yuv420p", options=options)
        expected = [between if number % 4 else most for number in range(11)] + [last]
        assert [frame.lag for frame in open_video(path).read()] == expected
    path.write_bytes(path.read_bytes().replace(b"x264 - core", b"camera core"))  # one that does not say
    expected = [1.5 if number % 4 else 1.2 for number in range(11)] + [2.0]
    assert [frame.lag for frame in open_video(path).read()] == expected


@pytest.mark.parametrize(("ending", "bits"), [("mp4", ""), ("ts", ""), ("mkv", "10le")])
def test_steps_of_hevc_are_told(tmp_path: Path, ending: str, bits: str) -> None:
    """At quantisers of 24 and 30, whose steps are 10 and 20 levels, of 8 or 10 bits; of first pictures three less."""
    path = tmp_path / f"a.{ending}"
    factor, power = HARM["hevc"]
    for quantiser, step in ((24, 10.0), (30, 20.0)):
        said = {"x265-params": f"log-level=none:bframes=0:qp={quantiser}"}
        write_video(path, "libx265", "yuv420p" + bits, options=said)
        told = np.array([np.full((1, 1), np.nan) if it.steps is None else it.steps for it in open_video(path).read()])
        assert told.shape == (12, 1, 1)
        own = (told.ravel() / factor) ** (1.0 / power)
        np.testing.assert_allclose(own, [step / np.sqrt(2.0), *[step] * 11], rtol=1e-6)


def test_names_in_any_letters_are_read(tmp_path: Path) -> None:
    """A title in Latin letters that are no UTF-8, as older cameras and programs write them."""
    path = tmp_path / "a.mp4"
    write_video(path, "libx264", "yuv420p", title="MESSGERAET")
    path.write_bytes(path.read_bytes().replace(b"MESSGERAET", "MESSGERÄTE".encode("latin-1")))
    assert b"\xc4" in path.read_bytes()
    assert sum(frame.picture is not None for frame in open_video(path).read()) == 12


@pytest.mark.parametrize(
    ("codec", "finer", "coarser"),
    [
        ("mpeg4", {"qmin": "3", "qmax": "3"}, {"qmin": "9", "qmax": "9"}),
        ("libvpx-vp9", {"crf": "15", "b": "0"}, {"crf": "45", "b": "0"}),
        ("libsvtav1", {"crf": "15", "preset": "10"}, {"crf": "45", "preset": "10"}),
    ],
)
def test_steps_of_other_codecs_are_told(
    tmp_path: Path, codec: str, finer: dict[str, str], coarser: dict[str, str]
) -> None:
    path, means = tmp_path / "a.mkv", []
    for options in (finer, coarser):
        write_video(path, codec, "yuv420p", options=options)
        told = [frame.steps for frame in open_video(path).read() if frame.steps is not None]
        means.append(np.mean([each.mean() for each in told]))
    assert means[1] > 1.5 * means[0] > 1.0


def test_sixteen_bit_pictures(tmp_path: Path) -> None:
    """Twelve bits in a 16-bit PNG."""
    folder = tmp_path / "run"
    folder.mkdir()
    for number in range(2):
        cv2.imwrite(str(folder / f"{number}.png"), (ramp(number).astype(np.uint16) * 16 + 5))
    for number, frame in enumerate(open_video(folder).read()):
        np.testing.assert_allclose(frame.picture, ramp(number) + 5 / 16)


def test_a_reader_that_stops_early_leaves_no_thread(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mkv", "ffv1", "gray")
    before = threading.active_count()
    frames = iter(open_video(tmp_path / "a.mkv").read())
    next(frames)
    frames.close()
    assert threading.active_count() == before
