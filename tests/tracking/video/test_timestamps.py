from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rig import Rig
from rafl.tracking.reconstruction.triangulation import CameraPixels, shown_frames
from rafl.tracking.video.reader import Video
from rafl.tracking.video.timestamps import camera_times, common_clock, delays

from rafl.common.errors import InputError

SIDE = OrthographicCamera(
    image_size=(1280, 720), scale=(6000.0, 6000.0), rotation_vector=(np.pi / 2, 0.0, 0.0), offset=(600.0, 400.0)
)
ASKEW = replace(SIDE, rotation_vector=(1.9, 0.6, 0.2))
RIG = Rig({"side": SIDE, "askew": ASKEW})
TIME = 0.01 * np.arange(120)


def places(time: np.ndarray) -> np.ndarray:
    """Six markers of a beam that swings in both directions."""
    share = np.linspace(0.2, 1.0, 6)
    decay = np.exp(-2 * time)
    z = 0.015 * np.sin(2 * np.pi * 7.7 * time) * decay
    y = 0.006 * np.sin(2 * np.pi * 5.1 * time + 1) * decay
    motion = np.stack([np.zeros_like(z), y, z], axis=-1)
    return np.stack([0.1 * share, 0 * share, 0 * share], axis=-1) + motion[:, None] * share[:, None] ** 2


def seen(camera: OrthographicCamera, time: np.ndarray, random: np.random.Generator) -> CameraPixels:
    pixel = camera.project(places(time)) + random.normal(0, 0.02, (len(time), 6, 2))
    return CameraPixels(pixel, np.full(pixel.shape, 0.02))


@pytest.mark.parametrize("late", [0.0237, -0.0149, 0.0])
def test_delays_from_common_markers(late: float, random: np.random.Generator) -> None:
    """To 0.1 frame asked; a hundredth reached."""
    pixels = {"side": seen(SIDE, TIME, random), "askew": seen(ASKEW, TIME - late, random)}
    found = delays(RIG, pixels, {"side": TIME, "askew": TIME})
    assert found["side"] == 0.0
    assert found["askew"] == pytest.approx(late, abs=2e-4)


def test_delays_without_common_markers(random: np.random.Generator) -> None:
    """Each camera sees its own three markers; the body moves as one."""
    pixels = {"side": seen(SIDE, TIME, random), "askew": seen(ASKEW, TIME - 0.0237, random)}
    for name, gone in (("side", slice(0, 3)), ("askew", slice(3, 6))):
        pixels[name].pixel[:, gone] = np.nan
        pixels[name].sigma[:, gone] = np.nan
    assert delays(RIG, pixels, {"side": TIME, "askew": TIME})["askew"] == pytest.approx(0.0237, abs=1e-3)


def test_no_motion_tells_nothing(random: np.random.Generator) -> None:
    still = {name: seen(camera, 0 * TIME, random) for name, camera in (("side", SIDE), ("askew", ASKEW))}
    with pytest.raises(InputError, match="too little"):
        delays(RIG, still, {"side": TIME, "askew": TIME})


def test_frames_one_camera_dropped_are_kept_from_the_other() -> None:
    whole, holed = TIME, np.delete(TIME, [30, 31])
    np.testing.assert_allclose(common_clock({"a": holed, "b": whole}), whole)
    np.testing.assert_allclose(common_clock({"a": whole, "b": holed + 1e-4}), whole)


def test_which_frame_shows_which_time() -> None:
    holed = np.delete(TIME, [30, 31])
    shown = shown_frames(holed, common_clock({"a": holed, "b": TIME}))
    np.testing.assert_array_equal(shown, [*range(30), -1, -1, *range(30, len(holed))])


def test_times_that_do_not_rise_or_rates_that_differ_are_refused() -> None:
    videos = {name: Video(Path(f"{name}.mp4"), (1280, 720), 120, 100.0) for name in ("a", "b")}
    back = TIME.copy()
    back[50] = back[49]
    with pytest.raises(InputError, match=r"a\.mp4.*frame 50.*--fps"):
        camera_times({"a": back, "b": TIME}, videos, None)
    with pytest.raises(InputError, match=r"b\.mp4.*100 frames/s.*found 50"):
        camera_times({"a": TIME, "b": 2 * TIME}, videos, None)
    assert camera_times({"a": back, "b": TIME}, videos, 50.0)["a"][-1] == pytest.approx(119 / 50)
