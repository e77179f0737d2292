"""What the notes of a recording say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import draw_frame, write_video

from rafl.calibration.camera import OrthographicCamera, Perspective, Plane
from rafl.calibration.rig import Rig
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.pipeline import TrackingSettings, existing_tracks, track_recording
from rafl.tracking.reconstruction.tracks import write_tracks
from rafl.tracking.video.reader import open_video

SIZE, FPS = (200, 160), 100.0
CAMERA = OrthographicCamera(
    image_size=SIZE, scale=(1e4, 1e4), rotation_vector=(0.0, 0.0, 0.0), plane=Plane((0.0, 0.0, 1.0), 0.0, 1e-4)
)


def moving_dots(path: Path, shown: list[int]) -> None:
    """A lossless video of 12 dots; frame t shows them after shown[t] steps of 2 px."""
    frames = []
    for step in shown:
        dots = [(40.0 + 30 * i + 2 * step, 40.0 + 35 * j, 6.0, 6.0, 0.0) for i in range(4) for j in range(3)]
        frames.append(np.rint(draw_frame(dots, SIZE, noise=1.0, seed=step)).clip(0, 255).astype(np.uint8))
    write_video(path, "ffv1", "gray", frames=frames)


def notes_of(path: Path, camera: OrthographicCamera, layout: MarkerLayout | None = None) -> str:
    settings = TrackingSettings(layout, None, 3)
    return "; ".join(track_recording({"front": open_video(path)}, Rig({"front": camera}), settings, lambda: None).notes)


def test_perspective_is_noted_where_it_makes_an_error(tmp_path: Path) -> None:
    """The outermost dot is 6 mm from the image centre and 8 mm behind where the scale is exact."""
    moving_dots(tmp_path / "a.mkv", list(range(8)))
    assert notes_of(tmp_path / "a.mkv", CAMERA) == ""
    near = replace(CAMERA, perspective=Perspective(1.0, -0.008, (99.5, 79.5)))
    note = notes_of(tmp_path / "a.mkv", near)
    assert note.startswith(
        "camera front: its calibration shows perspective, as from 1.00 m away; the orthographic model"
    )
    assert "up to 0.05 mm wrong" in note
    far = replace(CAMERA, perspective=Perspective(20.0, -0.008, (99.5, 79.5)))
    assert notes_of(tmp_path / "a.mkv", far) == ""


@pytest.mark.parametrize("off_mm", [0.0, 10.0])
def test_a_world_that_is_not_the_specimens_frame_is_noted(tmp_path: Path, off_mm: float) -> None:
    moving_dots(tmp_path / "a.mkv", list(range(8)))
    places = np.array([(4.0 + 3 * i - off_mm, 4.0 + 3.5 * j, 0.0) for i in range(4) for j in range(3)])
    layout = MarkerLayout(tuple(f"m{k}" for k in range(12)), 1e-3 * places)
    note = notes_of(tmp_path / "a.mkv", CAMERA, layout)
    if off_mm:
        assert note.startswith(
            "even the markers nearest to their places in the specimen file are 10.7, 0.0, 0.0 mm off"
        )
        assert "the calibration belongs to another set-up, or a camera was moved after it" in note
        assert "rafl-review calib.yaml" in note
    else:
        assert note == ""


def test_markers_on_a_face_that_no_camera_films_are_counted(tmp_path: Path) -> None:
    """The camera looks along z at the face z-min of a box. Behind it are 12 more dots, and one dot is not there."""
    moving_dots(tmp_path / "a.mkv", list(range(8)))
    front = [(4.0 + 3 * i, 4.0 + 3.5 * j, 0.0) for i in range(4) for j in range(3)]
    behind = [(x, y, 6.0) for x, y, _ in front]
    places = 1e-3 * np.array([*front, (11.5, 13.5, 0.0), *behind])
    names = (*(f"F{k}" for k in range(12)), "absent", *(f"B{k}" for k in range(12)))
    note = notes_of(tmp_path / "a.mkv", CAMERA, MarkerLayout(names, places, 5e-4, (0.02, 0.016, 0.006)))
    assert note == (
        "12 markers on the face z-max (B0, B1, B2, B3, ...): not in view of any camera; "
        "markers absent of the specimen were never found"
    )


def test_frames_shown_again_are_noted(tmp_path: Path) -> None:
    moving_dots(tmp_path / "a.mkv", [0, 1, 2, 2, 2, 5, 6, 7, 7, 9])
    assert notes_of(tmp_path / "a.mkv", CAMERA) == (
        "a.mkv: frames 3 to 4, 8 show the frame before again while the body moves and count as missing"
    )


def test_a_camera_whose_clock_is_late_keeps_what_it_filmed(tmp_path: Path) -> None:
    """Both films are the same; the right camera's frames are 0.3 frame after the rows, in which dots move by 2 px."""
    moving_dots(tmp_path / "a.mkv", list(range(12)))
    videos = {name: open_video(tmp_path / "a.mkv") for name in ("left", "right")}
    rig = Rig({"left": CAMERA, "right": replace(CAMERA, time_offset=-0.3 / FPS)})
    settings = TrackingSettings(None, FPS, 3)
    tracks = track_recording(videos, rig, settings, lambda: None)
    assert tracks.filmed_pixel.keys() == {"right"}
    assert tracks.lag["right"] == pytest.approx(0.3 / FPS)
    assert not tracks.lag["left"].any()
    assert tracks.filmed_time["right"] == pytest.approx((np.arange(12) + 0.3) / FPS)
    own = tracks.filmed_pixel["right"][:, 12:]
    np.testing.assert_allclose(own, tracks.pixel["left"][:, :12], atol=1e-9)
    moved = tracks.pixel["right"][1:, 12:] - own[1:]
    np.testing.assert_allclose(moved, np.broadcast_to([-0.6, 0.0], moved.shape), atol=0.1)
    path = tmp_path / "a.h5"
    write_tracks(path, tracks)
    assert existing_tracks(path, videos, rig, settings) is not None
    write_tracks(path, replace(tracks, filmed_time={}, filmed_pixel={}, filmed_sigma={}))
    assert existing_tracks(path, videos, rig, settings) is None
