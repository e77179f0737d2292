import cv2
import numpy as np
import pytest
from rafl.tracking.detection.appearance import find_family
from rafl.tracking.linking.tracker import Tracker
from rafl.tracking.synthetic import Scene, draw, expose
from support import grid, picture


def test_the_family_is_the_dots_not_the_clutter() -> None:
    """Six large blots and a row of small specks beside 24 dots of one size."""
    rest = grid()
    blots = [(30 + 50 * i, 30, 13.0, 10.0, 0.3) for i in range(6)]
    specks = [(20 + 24 * i, 220, 3.0, 3.0, 0.0) for i in range(13)]
    image = picture([*((x, y, 6.0, 6.0, 0.0) for x, y in rest), *blots, *specks], (360, 240), noise=2.0)
    found = find_family(image)
    assert found is not None
    family, dots = found
    assert len(dots) == 24
    assert family.dark
    assert family.radius == pytest.approx(6.0, rel=0.05)
    assert Tracker(family, dots).pattern.spacing == pytest.approx(34.0, abs=1.0)


def test_the_family_is_not_the_background() -> None:
    """Twelve dots on a bright skin before a mottled wall that is full of round blots."""
    random = np.random.default_rng(2)
    wall = np.full((480, 640), 70.0)
    for size, strength in ((120, 35.0), (30, 25.0), (6, 12.0)):
        coarse = random.normal(0.0, strength, (480 // size + 2, 640 // size + 2))
        wall += cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)
    wall = np.clip(wall + random.normal(0, 3, wall.shape), 0, 255).astype(np.uint8)
    skin = picture([(x, y, 9.0, 9.0, 0.0) for x, y in grid(6, 2)], (260, 150), noise=3.0)
    wall[160:310, 200:460] = skin
    found = find_family(wall)
    assert found is not None
    dots = found[1]
    assert len(dots) == 12
    distance = np.linalg.norm(dots.centre[:, None] - (grid(6, 2) + np.array([200, 160]))[None], axis=2)
    assert distance.min(axis=1).max() < 0.2


def test_stains_of_the_skin_are_no_markers() -> None:
    """Dim dots on a skin so mottled that it shows more round stains than there are dots."""
    dots = 100 + grid()
    false = 0
    for seed in range(12):
        random = np.random.default_rng(seed)
        skin = picture([(x, y, 6.0, 6.0, 0.0) for x, y in dots], (640, 480), noise=2.0, seed=seed, contrast=60.0)
        mottled = skin + cv2.resize(random.normal(0.0, 8.0, (62, 82)), (640, 480), interpolation=cv2.INTER_CUBIC)
        found = find_family(np.clip(np.rint(mottled), 0, 255).astype(np.uint8))
        assert found is not None
        away = np.linalg.norm(found[1].centre[:, None] - dots, axis=2)
        assert away.min(axis=0).max() < 1.0  # what lies around a dot pulls it
        false += len(found[1]) - 24
    assert false <= 10


@pytest.mark.parametrize("row", [80, 114, 182])
@pytest.mark.parametrize("beside", [-6.0, 6.0])
def test_markers_under_a_gloss_stand_in_the_others_rows(row: int, beside: float) -> None:
    """A streak of light as wide as a dot runs along a row, two thirds as bright as the dots are dark."""
    rest = grid(8, 4)
    image = picture([(x, y, 6.0, 6.0, 0.0) for x, y in rest], (360, 260), noise=2.0)
    streak = 90.0 * np.exp(-(((np.arange(260)[:, None] - row - beside) / 9.0) ** 2))
    found = find_family(np.clip(np.rint(image + streak), 0, 255).astype(np.uint8))
    assert found is not None
    away = np.linalg.norm(found[1].centre[:, None] - rest, axis=2)
    assert away.min(axis=1).max() < 1.0
    assert (away.min(axis=0) < 1.0).sum() >= 31


@pytest.mark.parametrize("away", [3, 4])
@pytest.mark.parametrize("blur", [3.1, 3.4])
def test_lines_do_not_reach_far_beyond_the_dots(away: int, blur: float) -> None:
    """A blurred blot where the rows would go on, but some pitches from the last dot: many lines lead there."""
    rest = grid(8, 4)
    column = rest[:, 0].max() + 34.0 * away
    image = picture([(x, y, 6.0, 6.0, 0.0) for x, y in rest], (480, 260), noise=2.0)
    x, y = np.meshgrid(np.arange(480) - column, np.arange(260) - 114.0)
    blot = cv2.GaussianBlur((x**2 + y**2 < 6.8**2).astype(float), (0, 0), blur)
    found = find_family(np.clip(np.rint(image - 100.0 * blot), 0, 255).astype(np.uint8))
    assert found is not None
    assert len(found[1]) == len(rest)


def before_a_wall(scene: Scene, pitch: float, radius: float) -> tuple[int, int]:
    """Of a body's dots in rows, in eight pictures: how many are not found, and how many more are."""
    assert scene.skin_box is not None
    left, top, right, bottom = scene.skin_box
    x, y = np.meshgrid(
        np.arange(left + 1.8 * radius, right - 1.7 * radius, pitch),
        np.arange(top + 1.8 * radius, bottom - 1.7 * radius, pitch),
    )
    missed = more = 0
    for seed in range(8):
        random = np.random.default_rng(seed)
        places = np.stack([x.ravel(), y.ravel()], axis=1) + random.uniform(-1, 1, (x.size, 2))
        ellipses = np.column_stack([places, np.full((len(places), 2), radius), np.zeros(len(places))])
        found = find_family(expose(draw(scene, ellipses, random), scene, random))
        assert found is not None
        gap = np.linalg.norm(found[1].centre[:, None] - places, axis=2)
        missed += int((gap.min(axis=0) > 1).sum())
        more += int((gap.min(axis=1) > 1).sum())
    return missed, more


def test_blots_where_rows_go_on_are_no_dots() -> None:
    """They look less like dots than dots under a gloss do, but lie on darker ground, to which no light was added."""
    skin = (100.0, 80.0, 540.0, 400.0)
    assert before_a_wall(Scene(size=(640, 480), fine=4, skin_box=skin, clutter=30.0), 24.0, 4.0) == (0, 0)


def test_many_blots_do_not_outweigh_few_dots() -> None:
    """A dozen dots before a wall full of blots as large: hardly one in a hundred of these passes."""
    skin = (380.0, 260.0, 560.0, 330.0)
    missed, more = before_a_wall(Scene(size=(960, 600), fine=4, skin=125.0, skin_box=skin, clutter=40.0), 30.0, 5.0)
    assert missed == 0
    assert more <= 20
