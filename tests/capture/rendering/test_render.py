import numpy as np
import pytest

from rafl.calibration.camera import OrthographicCamera
from rafl.capture.rendering.film import board_for, exposure_positions, side_cameras
from rafl.capture.rendering.motion import SimulatedMotion, tip_load_release, twist_release
from rafl.capture.rendering.render import Appearance, Renderer
from rafl.capture.specimen.specimen import Specimen

SHARP = Appearance(blur=0.0, exposure=0.0, noise=0.0)


def centroid(image: np.ndarray, at: np.ndarray, radius: float) -> np.ndarray:
    """Centroid of the darkness relative to the mean of a surrounding ring [px]; `at` and `radius` in px."""
    x, y = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    distance = np.hypot(x - at[0], y - at[1])
    ring = image[(distance > radius + 2) & (distance < radius + 5)].astype(float).mean()
    weight = np.where(distance < radius + 2, ring - image, 0.0).clip(0)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.fixture(scope="module")
def motion(small_specimen: Specimen) -> SimulatedMotion:
    return tip_load_release(small_specimen, small_specimen.material, 0.08, 6, 100.0)


@pytest.fixture(scope="module")
def camera(small_specimen: Specimen, motion: SimulatedMotion) -> OrthographicCamera:
    return side_cameras(small_specimen, [motion], np.random.default_rng(0)).cameras["left"]


@pytest.mark.parametrize("appearance", [SHARP, Appearance(noise=0.0), Appearance(exposure=0.9, blur=1.5, noise=0.0)])
def test_dots_are_drawn_where_the_markers_are(
    small_specimen: Specimen, motion: SimulatedMotion, camera: OrthographicCamera, appearance: Appearance
) -> None:
    """With or without lens and motion blur, the centroid of every visible dot is the projection of its marker."""
    renderer = Renderer.of(small_specimen, camera, appearance, np.random.default_rng(0))
    frame = 3
    image = renderer.draw(exposure_positions(motion, frame, appearance), np.random.default_rng(1))
    import torch

    positions = small_specimen.markers(1e-6).positions(torch.from_numpy(motion.q[frame])).numpy()
    radius = 1.5e-3 * camera.scale[0]
    for marker in range(10):  # on the left side
        pixel = camera.project(positions[marker])
        assert centroid(image, pixel, radius) == pytest.approx(pixel, abs=0.25)


def test_dots_on_the_far_side_are_hidden(small_specimen: Specimen, camera: OrthographicCamera) -> None:
    """Without the dots on the near side the left camera sees none."""
    from dataclasses import replace

    from rafl.tracking.linking.layout import MarkerLayout

    layout = small_specimen.layout
    far = replace(small_specimen, layout=MarkerLayout(layout.names[10:], layout.positions[10:]))
    renderer = Renderer.of(far, camera, SHARP, np.random.default_rng(0))
    image = renderer.draw(small_specimen.mesh.vertices[None], np.random.default_rng(0))
    body = camera.project(np.array([0.03, 0.0, 0.01])).astype(int)
    assert image[body[1] - 80 : body[1] + 80, body[0] - 200 : body[0] + 200].min() > 80


def test_a_twist_rotates_the_tip_and_keeps_the_clamp_fixed(small_specimen: Specimen) -> None:
    motion = twist_release(small_specimen, small_specimen.material, np.pi / 2, 3, 100.0)
    rest, first = small_specimen.mesh.vertices, motion.q[0]
    np.testing.assert_allclose(first[small_specimen.fixed], rest[small_specimen.fixed], atol=1e-15)
    tip = small_specimen.loaded
    centre = rest[tip].mean(0)
    quarter = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    np.testing.assert_allclose(first[tip] - centre, (rest[tip] - centre) @ quarter.T, atol=1e-12)
    assert motion.load == 0.0


@pytest.mark.parametrize(
    ("view", "squares", "square_mm"), [((0.13, 0.07), (11, 6), 10.0), ((1.1, 0.62), (25, 14), 40.0)]
)
def test_board_has_no_more_markers_than_its_dictionary(
    view: tuple[float, float], squares: tuple[int, int], square_mm: float
) -> None:
    pattern = board_for(view)
    assert (pattern.squares, pattern.square_mm) == (squares, square_mm)
    assert len(pattern.opencv_board().getIds()) <= 250
    assert min(board_for((0.02, 0.011)).squares) >= 5
