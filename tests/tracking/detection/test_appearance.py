import cv2
import numpy as np
import pytest
from support import draw_frame, marker_grid
from synthetic import Scene, draw, expose

from rafl.tracking.detection.appearance import find_markers
from rafl.tracking.linking.tracker import Tracker


def test_markers_are_found_beside_blobs_of_other_sizes() -> None:
    """Six large blobs and a row of small ones beside 24 dots of one size."""
    rest = marker_grid()
    large = [(30 + 50 * i, 30, 13.0, 10.0, 0.3) for i in range(6)]
    small = [(20 + 24 * i, 220, 3.0, 3.0, 0.0) for i in range(13)]
    image = draw_frame([*((x, y, 6.0, 6.0, 0.0) for x, y in rest), *large, *small], (360, 240), noise=2.0)
    found = find_markers(image)
    assert found is not None
    appearance, dots = found
    assert len(dots) == 24
    assert appearance.dark
    assert appearance.radius == pytest.approx(6.0, rel=0.05)
    assert Tracker(appearance, dots).pattern.spacing == pytest.approx(34.0, abs=1.0)


def test_markers_are_found_before_a_mottled_background() -> None:
    """Twelve dots on a bright skin before a mottled background with many round blobs."""
    random = np.random.default_rng(2)
    image = np.full((480, 640), 70.0)
    for size, strength in ((120, 35.0), (30, 25.0), (6, 12.0)):
        coarse = random.normal(0.0, strength, (480 // size + 2, 640 // size + 2))
        image += cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)
    image = np.clip(image + random.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
    skin = draw_frame([(x, y, 9.0, 9.0, 0.0) for x, y in marker_grid(6, 2)], (260, 150), noise=3.0)
    image[160:310, 200:460] = skin
    found = find_markers(image)
    assert found is not None
    dots = found[1]
    assert len(dots) == 12
    distance = np.linalg.norm(dots.centre[:, None] - (marker_grid(6, 2) + np.array([200, 160]))[None], axis=2)
    assert distance.min(axis=1).max() < 0.2


def test_mottled_skin_gives_few_false_detections() -> None:
    """Dots of low contrast on a skin so mottled that it has more round blobs than dots."""
    truth = 100 + marker_grid()
    false = 0
    for seed in range(12):
        random = np.random.default_rng(seed)
        skin = draw_frame([(x, y, 6.0, 6.0, 0.0) for x, y in truth], (640, 480), noise=2.0, seed=seed, contrast=60.0)
        mottled = skin + cv2.resize(random.normal(0.0, 8.0, (62, 82)), (640, 480), interpolation=cv2.INTER_CUBIC)
        found = find_markers(np.clip(np.rint(mottled), 0, 255).astype(np.uint8))
        assert found is not None
        distance = np.linalg.norm(found[1].centre[:, None] - truth, axis=2)
        assert distance.min(axis=0).max() < 1.0  # the mottled surroundings shift a dot
        false += len(found[1]) - 24
    assert false <= 10


@pytest.mark.parametrize("row", [80, 114, 182])
@pytest.mark.parametrize("offset", [-6.0, 6.0])
def test_markers_under_a_highlight_are_found_in_the_rows(row: int, offset: float) -> None:
    """A highlight as wide as a dot runs along a row and adds two thirds of the dots' contrast."""
    rest = marker_grid(8, 4)
    image = draw_frame([(x, y, 6.0, 6.0, 0.0) for x, y in rest], (360, 260), noise=2.0)
    highlight = 90.0 * np.exp(-(((np.arange(260)[:, None] - row - offset) / 9.0) ** 2))
    found = find_markers(np.clip(np.rint(image + highlight), 0, 255).astype(np.uint8))
    assert found is not None
    distance = np.linalg.norm(found[1].centre[:, None] - rest, axis=2)
    assert distance.min(axis=1).max() < 1.0
    assert (distance.min(axis=0) < 1.0).sum() >= 31


@pytest.mark.parametrize("spacings", [3, 4])
@pytest.mark.parametrize("blur", [3.1, 3.4])
def test_rows_do_not_extend_far_beyond_the_markers(spacings: int, blur: float) -> None:
    """A blurred blob on the extension of the rows, some spacings from the last marker, is no marker."""
    rest = marker_grid(8, 4)
    column = rest[:, 0].max() + 34.0 * spacings
    image = draw_frame([(x, y, 6.0, 6.0, 0.0) for x, y in rest], (480, 260), noise=2.0)
    x, y = np.meshgrid(np.arange(480) - column, np.arange(260) - 114.0)
    blob = cv2.GaussianBlur((x**2 + y**2 < 6.8**2).astype(float), (0, 0), blur)
    found = find_markers(np.clip(np.rint(image - 100.0 * blob), 0, 255).astype(np.uint8))
    assert found is not None
    assert len(found[1]) == len(rest)


def count_errors(scene: Scene, spacing: float, radius: float) -> tuple[int, int]:
    """Count missed and false markers in eight frames with rows of dots on the skin."""
    assert scene.skin_box is not None
    left, top, right, bottom = scene.skin_box
    x, y = np.meshgrid(
        np.arange(left + 1.8 * radius, right - 1.7 * radius, spacing),
        np.arange(top + 1.8 * radius, bottom - 1.7 * radius, spacing),
    )
    missed = false = 0
    for seed in range(8):
        random = np.random.default_rng(seed)
        truth = np.stack([x.ravel(), y.ravel()], axis=1) + random.uniform(-1, 1, (x.size, 2))
        ellipses = np.column_stack([truth, np.full((len(truth), 2), radius), np.zeros(len(truth))])
        found = find_markers(expose(draw(scene, ellipses, random), scene, random))
        assert found is not None
        distance = np.linalg.norm(found[1].centre[:, None] - truth, axis=2)
        missed += int((distance.min(axis=0) > 1).sum())
        false += int((distance.min(axis=1) > 1).sum())
    return missed, false


def test_background_blobs_on_extended_rows_are_no_markers() -> None:
    """Their surroundings are darker than the skin, whereas a highlight brightens a marker's surroundings."""
    skin = (100.0, 80.0, 540.0, 400.0)
    scene = Scene(size=(640, 480), supersampling=4, skin_box=skin, clutter=30.0)
    assert count_errors(scene, 24.0, 4.0) == (0, 0)


def test_few_markers_are_found_before_many_background_blobs() -> None:
    """A dozen dots before a background full of blobs of their size: about one blob in a hundred passes."""
    skin = (380.0, 260.0, 560.0, 330.0)
    scene = Scene(size=(960, 600), supersampling=4, skin=125.0, skin_box=skin, clutter=40.0)
    missed, false = count_errors(scene, 30.0, 5.0)
    assert missed == 0
    assert false <= 20
