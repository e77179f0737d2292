"""Datasets from what one camera measured: the depth that its plane assumes does not matter."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from filmed_markers import side_camera

from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import Rig, rig_text
from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset, write_dataset
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.tracks import Tracks, write_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels, triangulate

FRAMES, SIGMA_PX = 8, 0.02
ROW = RecordingRow(recording="swing", load_g=60, split="train")
SETTINGS = CaptureSettings(start=0, initial="rest")


@pytest.fixture(scope="module")
def front(small_specimen: Specimen) -> Specimen:
    """The specimen with the markers of one side only."""
    kept = small_specimen.layout.positions[:, 1] == 0.0
    names = tuple(name for name, own in zip(small_specimen.layout.names, kept, strict=True) if own)
    layout = MarkerLayout(names, small_specimen.layout.positions[kept], 0.0)
    return replace(small_specimen, layout=layout)


@pytest.fixture(scope="module")
def motion(front: Specimen) -> np.ndarray:
    """Node positions [m], (T, N, 3), of a specimen softer than assumed."""
    softer = replace(front.material, youngs_modulus=0.8 * front.material.youngs_modulus)
    return tip_load_release(front, softer, 0.06, FRAMES, 100.0).q


def write_swing(
    folder: Path, specimen: Specimen, motion: np.ndarray, plane_m: float, hidden: tuple[int, int] | None = None
) -> OrthographicCamera:
    """Tracks of one camera whose plane is y = `plane_m`; `hidden` are a frame and a marker that were only filled."""
    camera = replace(side_camera(0.0), plane=Plane((0.0, 1.0, 0.0), plane_m, 5e-4))
    markers = specimen.markers(1e-6)
    exact = markers.positions(torch.from_numpy(motion)).numpy()
    pixel = camera.project(exact) + np.random.default_rng(0).normal(0.0, SIGMA_PX, (*exact.shape[:2], 2))
    sigma = np.full_like(pixel, SIGMA_PX)
    rig = Rig({"left": camera})
    position, position_sigma, residual = triangulate(rig, {"left": CameraPixels(pixel, sigma)})
    state = np.ones(position.shape[:2], np.uint8)
    if hidden is not None:
        state[hidden] = 2
        pixel[hidden], sigma[hidden] = np.nan, np.nan
    write_tracks(
        folder / "swing.h5",
        Tracks(
            names=markers.names,
            time=0.01 * np.arange(FRAMES),
            position=position,
            sigma=position_sigma,
            state=state,
            pixel={"left": pixel},
            residual=residual,
            pixel_sigma={"left": sigma},
            damaged={"left": np.zeros(FRAMES, bool)},
            frame={"left": np.arange(FRAMES)},
            images={"left": {}},
            fps=100.0,
            calibration=rig_text(rig),
            sources={},
            settings="",
        ),
    )
    return camera


def build(specimen: Specimen, folder: Path) -> Dataset:
    return build_dataset(specimen, folder, [ROW], SETTINGS, "", lambda: None)


def test_first_frame_does_not_depend_on_the_assumed_depth(front: Specimen, motion: np.ndarray, tmp_path: Path) -> None:
    found = []
    for number, plane in enumerate((0.0, 0.002)):
        folder = tmp_path / str(number)
        folder.mkdir()
        write_swing(folder, front, motion, plane)
        found.append(build(front, folder).trajectories["swing"])
    np.testing.assert_allclose(found[0].q, found[1].q, atol=2e-5)
    assert np.abs(found[0].markers - found[1].markers).max() == pytest.approx(0.002)
    distance = np.sqrt(((found[0].q - motion[0]) ** 2).sum(-1).mean())
    assert distance < 4e-4  # out of the image plane nothing but the shape tells the position


def test_pixels_are_kept_with_their_camera_and_markers(front: Specimen, motion: np.ndarray, tmp_path: Path) -> None:
    """Markers in another order than the specimen's; a filled position has no pixel, though it has a position."""
    turned = replace(
        front, layout=MarkerLayout(front.layout.names[::-1], front.layout.positions[::-1].copy(), front.layout.sigma)
    )
    camera = write_swing(tmp_path, turned, motion, 0.0, hidden=(3, 2))
    dataset = build(front, tmp_path)
    write_dataset(tmp_path / "data.h5", dataset)
    item = read_dataset(tmp_path / "data.h5").trajectories["swing"]
    view = item.views["left"]
    exact = camera.project(dataset.markers.positions(torch.from_numpy(motion)).numpy())
    hidden = (3, len(front.layout.names) - 3)
    assert item.valid.all()
    assert not view.seen[hidden]
    assert view.seen.sum() == view.seen.size - 1
    assert np.nanmax(np.abs(view.pixel - exact)) < 6.0 * SIGMA_PX
    np.testing.assert_allclose(view.covariance[view.seen], np.broadcast_to(SIGMA_PX**2 * np.eye(2), (79, 2, 2)))
    np.testing.assert_allclose(view.camera.project(item.markers[0]), camera.project(item.markers[0]), atol=1e-9)
