from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rig import Rig
from rafl.common.errors import InputError
from rafl.tracking.reconstruction.triangulation import CameraPixels, shown_frames
from rafl.tracking.video.reader import Video
from rafl.tracking.video.timestamps import (
    camera_times,
    common_clock,
    estimate_clock_delays,
    late_starts,
    slow_motion_note,
)

SIDE = OrthographicCamera(
    image_size=(1280, 720), scale=(6000.0, 6000.0), rotation_vector=(np.pi / 2, 0.0, 0.0), offset=(600.0, 400.0)
)
ASKEW = replace(SIDE, rotation_vector=(1.9, 0.6, 0.2))
RIG = Rig({"side": SIDE, "askew": ASKEW})
TIME = 0.01 * np.arange(120)


def marker_positions(time: np.ndarray) -> np.ndarray:
    """Positions (T, 6, 3) [m] of six markers on a beam that oscillates in y and z."""
    share = np.linspace(0.2, 1.0, 6)
    decay = np.exp(-2 * time)
    z = 0.015 * np.sin(2 * np.pi * 7.7 * time) * decay
    y = 0.006 * np.sin(2 * np.pi * 5.1 * time + 1) * decay
    motion = np.stack([np.zeros_like(z), y, z], axis=-1)
    return np.stack([0.1 * share, 0 * share, 0 * share], axis=-1) + motion[:, None] * share[:, None] ** 2


def project_with_noise(camera: OrthographicCamera, time: np.ndarray, random: np.random.Generator) -> CameraPixels:
    pixel = camera.project(marker_positions(time)) + random.normal(0, 0.02, (len(time), 6, 2))
    return CameraPixels(pixel, np.full(pixel.shape, 0.02))


@pytest.mark.parametrize("delay", [0.0237, -0.0149, 0.0])
def test_delays_from_common_markers(delay: float, random: np.random.Generator) -> None:
    """The requirement is 0.1 frame; the error is a hundredth of a frame."""
    pixels = {"side": project_with_noise(SIDE, TIME, random), "askew": project_with_noise(ASKEW, TIME - delay, random)}
    found = estimate_clock_delays(RIG, pixels, {"side": TIME, "askew": TIME})
    assert found["side"] == 0.0
    assert found["askew"] == pytest.approx(delay, abs=2e-4)


def test_delays_without_common_markers(random: np.random.Generator) -> None:
    """Each camera sees three markers of its own; all are on one body."""
    pixels = {"side": project_with_noise(SIDE, TIME, random), "askew": project_with_noise(ASKEW, TIME - 0.0237, random)}
    for name, hidden in (("side", slice(0, 3)), ("askew", slice(3, 6))):
        pixels[name].pixel[:, hidden] = np.nan
        pixels[name].sigma[:, hidden] = np.nan
    assert estimate_clock_delays(RIG, pixels, {"side": TIME, "askew": TIME})["askew"] == pytest.approx(0.0237, abs=1e-3)


def test_a_camera_that_began_later_is_found_by_its_missing_frames(random: np.random.Generator) -> None:
    pixels = {"side": project_with_noise(SIDE, TIME, random), "askew": project_with_noise(ASKEW, TIME[5:], random)}
    offsets, (note,) = late_starts(RIG, pixels, {"side": TIME, "askew": TIME[:-5]})
    assert offsets == {"side": 0.0, "askew": pytest.approx(-0.05, abs=2e-4)}
    assert note.startswith("the cameras recorded 120 (side), 115 (askew) frames;")
    assert note.endswith("by the motion, askew began 5.0 frames (0.050 s) later: corrected")


def test_a_camera_that_began_later_and_stopped_later_is_asked_about(random: np.random.Generator) -> None:
    times = {"side": TIME, "askew": TIME}
    pixels = {"side": project_with_noise(SIDE, TIME, random), "askew": project_with_noise(ASKEW, TIME + 0.05, random)}
    offsets, (note,) = late_starts(RIG, pixels, times)
    assert offsets == {"side": 0.0, "askew": 0.0}
    assert note.startswith("by the motion, askew began 5.0 frames (0.050 s) later than side; unless a trigger")
    together = {"side": pixels["side"], "askew": project_with_noise(ASKEW, TIME, random)}
    assert late_starts(RIG, together, times) == ({"side": 0.0, "askew": 0.0}, [])
    still = {name: project_with_noise(camera, 0 * TIME, random) for name, camera in (("side", SIDE), ("askew", ASKEW))}
    assert late_starts(RIG, still, times) == ({"side": 0.0, "askew": 0.0}, [])


def test_a_camera_that_stopped_earlier_keeps_its_offset(random: np.random.Generator) -> None:
    pixels = {"side": project_with_noise(SIDE, TIME, random), "askew": project_with_noise(ASKEW, TIME[:-5], random)}
    assert late_starts(RIG, pixels, {"side": TIME, "askew": TIME[:-5]}) == ({"side": 0.0, "askew": 0.0}, [])
    still = {name: CameraPixels(0.0 * item.pixel + 400.0, item.sigma) for name, item in pixels.items()}
    offsets, (note,) = late_starts(RIG, still, {"side": TIME, "askew": TIME[:-5]})
    assert offsets == {"side": 0.0, "askew": 0.0}
    assert note.endswith("whether they began together, the motion does not show")


def test_delay_without_motion_is_an_error(random: np.random.Generator) -> None:
    still = {name: project_with_noise(camera, 0 * TIME, random) for name, camera in (("side", SIDE), ("askew", ASKEW))}
    with pytest.raises(InputError, match="too little"):
        estimate_clock_delays(RIG, still, {"side": TIME, "askew": TIME})


def test_clock_keeps_frames_that_one_camera_dropped() -> None:
    complete, dropped = TIME, np.delete(TIME, [30, 31])
    np.testing.assert_allclose(common_clock({"a": dropped, "b": complete}), complete)
    np.testing.assert_allclose(common_clock({"a": complete, "b": dropped + 1e-4}), complete)


def test_clock_times_map_to_frames() -> None:
    dropped = np.delete(TIME, [30, 31])
    shown = shown_frames(dropped, common_clock({"a": dropped, "b": TIME}))
    np.testing.assert_array_equal(shown, [*range(30), -1, -1, *range(30, len(dropped))])


def test_decreasing_times_and_differing_rates_are_refused() -> None:
    videos = {name: Video(Path(f"{name}.mp4"), (1280, 720), 120, 100.0) for name in ("a", "b")}
    decreasing = TIME.copy()
    decreasing[50] = decreasing[49]
    with pytest.raises(InputError, match=r"a\.mp4.*frame 50.*--fps"):
        camera_times({"a": decreasing, "b": TIME}, videos, None)
    with pytest.raises(InputError, match=r"b\.mp4.*100 frames/s.*found 50"):
        camera_times({"a": TIME, "b": 2 * TIME}, videos, None)
    assert camera_times({"a": decreasing, "b": TIME}, videos, 50.0)["a"][-1] == pytest.approx(119 / 50)


def test_slow_motion_is_timed_by_its_capture_rate() -> None:
    """A film of 100 frames/s that plays at 30, beside one that plays at the rate at which it was recorded."""
    slow = Video(Path("a.mov"), (1280, 720), 120, 30.0, 100.0)
    videos = {"a": slow, "b": replace(slow, path=Path("b.mov"), fps=100.0)}
    played = np.arange(120) / 30.0
    times = camera_times({"a": played, "b": TIME}, videos, None)
    np.testing.assert_allclose(times["a"], TIME)
    np.testing.assert_allclose(times["b"], TIME)
    (note,) = slow_motion_note(slow, played)
    assert note.startswith("a.mov: plays at 30 frames/s and was recorded at 100")
    assert slow_motion_note(videos["b"], TIME) == []
    assert slow_motion_note(replace(slow, capture_fps=0.0), played) == []
