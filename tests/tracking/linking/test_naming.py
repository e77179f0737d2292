from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import ROOT

from rafl.calibration.camera import OrthographicCamera, PinholeCamera
from rafl.calibration.rig import Rig
from rafl.common.errors import InputError
from rafl.tracking.linking.layout import MarkerLayout, read_layout
from rafl.tracking.linking.naming import (
    averted_markers,
    name_by_layout,
    name_by_rows,
    visible_markers,
    with_face_planes,
)

CAMERA = OrthographicCamera(
    image_size=(1280, 720), scale=(9000.0, 9000.0), rotation_vector=(np.pi / 2, 0.0, 0.0), offset=(150.0, 400.0)
)


def two_sided(shift: float = 0.0) -> MarkerLayout:
    """16 markers on each side face of a beam. Those of the far side are shifted by `shift` [m] towards the tip."""
    names, positions = [], []
    for side, y in (("L", 0.0), ("R", 0.03)):
        for row, z in enumerate((0.02, 0.01)):
            for column in range(8):
                names.append(f"{side}{row}{column}")
                positions.append((0.010 + 0.012 * column + (shift if side == "R" else 0.0), y, z))
    return MarkerLayout(tuple(names), np.array(positions))


LAYOUT = two_sided()


def project_left_side(turn_deg: float = 0.0, bend: float = 0.0, shift: float = 0.0) -> np.ndarray:
    """The left side's dots in the image [px], bent down by `bend` [m] at the tip, then rotated."""
    positions = LAYOUT.positions[:16].copy()
    positions[:, 2] -= bend * (positions[:, 0] / 0.1) ** 2
    positions[:, 0] += shift
    centre = positions.mean(0)
    rotation = Rotation.from_rotvec([0, np.radians(turn_deg), 0]).as_matrix()
    return CAMERA.project((positions - centre) @ rotation.T + centre)


def test_only_the_near_side_is_visible() -> None:
    assert CAMERA.viewing_direction == pytest.approx([0, 1, 0])
    assert visible_markers(LAYOUT, CAMERA).tolist() == list(range(16))
    one_plane = MarkerLayout(LAYOUT.names[:16], LAYOUT.positions[:16])
    assert len(visible_markers(one_plane, CAMERA)) == 16


def camera_from_above(turn_deg: float, distance: float | None = None) -> OrthographicCamera | PinholeCamera:
    """CAMERA, or a pinhole camera at a distance [m] from the beam, turned to look down on it."""
    turn = Rotation.from_rotvec([-np.radians(turn_deg), 0.0, 0.0]).as_matrix()
    rotation = CAMERA.rotation @ turn.T
    vector = tuple(Rotation.from_matrix(rotation).as_rotvec().tolist())
    if distance is None:
        return replace(CAMERA, rotation_vector=vector)
    translation = np.array([0.0, 0.0, distance]) - rotation @ LAYOUT.positions.mean(axis=0)
    return PinholeCamera(
        image_size=(1280, 720),
        rotation_vector=vector,
        focal=(3000.0, 3000.0),
        centre=(640.0, 360.0),
        translation=tuple(translation.tolist()),
    )


@pytest.mark.parametrize("distance", [None, 0.3])
@pytest.mark.parametrize("turn_deg", [0.0, 30.0])
def test_markers_that_look_away_from_every_camera(turn_deg: float, distance: float | None) -> None:
    """A camera that looks down on the beam sees its top, on which there are no markers, but none of its far side."""
    beam = replace(LAYOUT, box=(0.1, 0.03, 0.03))
    camera = camera_from_above(turn_deg, distance)
    assert camera.viewing_direction[2] == pytest.approx(-np.sin(np.radians(turn_deg)), abs=1e-9)
    assert averted_markers(beam, [camera]) == {"y-max": list(LAYOUT.names[16:])}
    behind = Rotation.from_matrix(CAMERA.rotation @ np.diag([-1.0, -1.0, 1.0]))
    opposite = replace(CAMERA, rotation_vector=tuple(behind.as_rotvec().tolist()))
    assert averted_markers(beam, [camera, opposite]) == {}


def test_the_hull_tells_what_looks_away_from_every_camera() -> None:
    assert averted_markers(LAYOUT, [CAMERA]) == {"y-max": list(LAYOUT.names[16:])}
    one_plane = MarkerLayout(LAYOUT.names[:16], LAYOUT.positions[:16])
    assert averted_markers(one_plane, [CAMERA]) == {}


@pytest.mark.parametrize("name", ["fishtail-crude", "fishtail-fine"])
@pytest.mark.parametrize("bend", [0.0, 0.03])
def test_a_single_row_on_each_edge_of_a_hollow_flat_body(name: str, bend: float, random: np.random.Generator) -> None:
    """Fish-tails: a dot of the near edge hides each dot of the far edge, and the near edge is no flat side."""
    layout = read_layout(ROOT / "datasets" / "specimens" / f"{name}.yaml")
    near = [k for k, marker in enumerate(layout.names) if marker.startswith("L")]
    assert visible_markers(layout, CAMERA).tolist() == near
    positions = layout.positions[near].copy()
    positions[:, 2] -= bend * (positions[:, 0] / 0.1) ** 2
    mixed = random.permutation(len(near))
    assert name_by_layout(CAMERA.project(positions)[mixed], layout, CAMERA, "a video") == mixed.tolist()


@pytest.mark.parametrize(
    ("turn", "bend", "shift"),
    [(0, 0, 0), (0, 0.05, 0), (5, 0.03, 0.004), (90, 0.0, 0.0), (-150, 0.01, 0.0), (0, -0.06, 0.0)],
)
def test_dots_in_any_order_are_named(turn: float, bend: float, shift: float, random: np.random.Generator) -> None:
    dots = project_left_side(turn, bend, shift)
    mixed = random.permutation(16)
    names = name_by_layout(dots[mixed], LAYOUT, CAMERA, "a video")
    if abs(turn) < 90:
        assert names == mixed.tolist()
    else:  # a grid of two rows looks the same upside down; each name still occurs once
        assert sorted(names) == list(range(16))


def bend_cantilever(positions: np.ndarray, slope: float) -> np.ndarray:
    """Bent without stretching, with a cantilever's slope, which is `slope` [rad] at the tip."""
    s = np.linspace(0.0, 1.02 * positions[:, 0].max(), 500)
    angle = slope * (2.0 * s / s[-1] - (s / s[-1]) ** 2)
    step = s[1]
    line = np.cumsum(np.stack([np.cos(angle), -np.sin(angle)]) * step, axis=1) - step * np.array([[1.0], [0.0]])
    middle = 0.5 * (positions[:, 2].max() + positions[:, 2].min())
    x, z, own = (np.interp(positions[:, 0], s, values) for values in (*line, angle))
    bent = positions.copy()
    bent[:, 0] = x + (positions[:, 2] - middle) * np.sin(own)
    bent[:, 2] = middle + z + (positions[:, 2] - middle) * np.cos(own)
    return bent


@pytest.mark.parametrize("slope_deg", [-80, -60, 35, 50, 65, 80])
@pytest.mark.parametrize("name", ["canonical", "thinner", "longer", "shorter"])
@pytest.mark.parametrize("hidden", [0, 2])
def test_strongly_bent_beams_are_named(name: str, slope_deg: float, hidden: int) -> None:
    """Rows are closer together than columns, and the tip hangs below the clamp."""
    layout = read_layout(ROOT / "datasets" / "specimens" / f"{name}.yaml")
    seen = np.random.default_rng(hidden + 7).permutation(visible_markers(layout, CAMERA))[hidden:]
    dots = CAMERA.project(bend_cantilever(layout.positions[seen], np.radians(slope_deg)))
    assert name_by_layout(dots, layout, CAMERA, "a video") == seen.tolist()


@pytest.mark.parametrize(
    ("columns", "rows", "along_mm", "across_mm", "slope_deg"),
    [
        *((12, 4, 8, 4, slope_deg) for slope_deg in (-70, -30, 20, 45, 75)),
        *((20, 5, 5, 3, slope_deg) for slope_deg in (-70, 20, 75)),
    ],
)
def test_strongly_bent_sheets_of_many_dots_are_named(
    columns: int, rows: int, along_mm: float, across_mm: float, slope_deg: float, random: np.random.Generator
) -> None:
    x, z = np.meshgrid(5.0 + along_mm * np.arange(columns), across_mm * np.arange(rows))
    positions = 1e-3 * np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    layout = MarkerLayout(tuple(f"m{k}" for k in range(len(positions))), positions)
    seen = random.permutation(len(positions))[4:]
    dots = CAMERA.project(bend_cantilever(positions[seen], np.radians(slope_deg)))
    assert name_by_layout(dots, layout, CAMERA, "a video") == seen.tolist()


def test_missing_and_false_dots(random: np.random.Generator) -> None:
    dots = project_left_side(bend=0.02)
    kept = np.delete(np.arange(16), [3, 12])
    names = name_by_layout(np.vstack([dots[kept], [[20.0, 30.0], [1200.0, 700.0]]]), LAYOUT, CAMERA, "a video")
    assert names == [*kept.tolist(), -1, -1]


@pytest.mark.parametrize("bend", [0.005, *(pytest.param(bend, marks=pytest.mark.slow) for bend in (0.0, 0.002, 0.02))])
def test_static_dots_do_not_swap_the_sides(bend: float, random: np.random.Generator) -> None:
    """With the static dots, there are more dots than markers on the near side. The far side's would match them too."""
    layout = two_sided(shift=0.006)
    for _ in range(6):
        static = np.column_stack([random.uniform(-30, -6, 3), np.zeros(3), random.uniform(-15, 45, 3)]) / 1000.0
        names = name_by_layout(
            np.vstack([project_left_side(bend=bend), CAMERA.project(static)]), layout, CAMERA, "a video"
        )
        assert names == [*range(16), -1, -1, -1]


def test_all_sides_of_a_transparent_body_are_named(random: np.random.Generator) -> None:
    layout = two_sided(shift=0.006)
    mixed = random.permutation(32)
    assert name_by_layout(CAMERA.project(layout.positions)[mixed], layout, CAMERA, "a video") == mixed.tolist()


def test_another_pattern_is_refused(random: np.random.Generator) -> None:
    unrelated = np.array([[0.0, 0.0], [1200.0, 10.0], [600.0, 700.0], [10.0, 650.0]])
    single = MarkerLayout(LAYOUT.names[:1], LAYOUT.positions[:1])
    coincident = MarkerLayout(LAYOUT.names[:4], LAYOUT.positions[[0, 0, 0, 0]])
    for dots, layout in ((unrelated, LAYOUT), (project_left_side(), single), (project_left_side(), coincident)):
        with pytest.raises(InputError, match="a video: expected dots in the pattern"):
            name_by_layout(dots, layout, CAMERA, "a video")


def test_rows_and_columns_of_a_tilted_grid(random: np.random.Generator) -> None:
    """A grid with uneven columns is named in reading order."""
    x, y = np.meshgrid([10.0, 90, 160, 260], [20.0, 130, 240])
    dots = np.stack([x.ravel(), y.ravel() + 0.04 * x.ravel()], axis=1)
    mixed = random.permutation(12)
    names = name_by_rows(dots[mixed])
    for index, dot in enumerate(mixed):
        assert names[index] == f"r{dot // 4 + 1}c{dot % 4 + 1}"


def test_rows_of_a_bent_beam(random: np.random.Generator) -> None:
    """The tip is lowered by more than the row spacing."""
    x, y = np.meshgrid(30.0 * np.arange(10), 24.0 * np.arange(3))
    slope = 0.9 * x / x.max()
    dots = np.stack([x - 0.1 * x * slope - y * np.sin(slope), 0.45 * slope * x + y * np.cos(slope)], axis=-1)
    mixed = random.permutation(30)
    names = name_by_rows(dots.reshape(-1, 2)[mixed])
    expected = [f"r{row + 1}c{column + 1}" for row in range(3) for column in range(10)]
    assert names == [expected[k] for k in mixed]


def facing(rotation_vector: tuple[float, float, float]) -> PinholeCamera:
    """A pinhole camera 2 m from the beam's middle."""
    turn = Rotation.from_rotvec(rotation_vector).as_matrix()
    shift = np.array([0.0, 0.0, 2.0]) - turn @ [0.05, 0.015, 0.015]
    return PinholeCamera(
        image_size=(1280, 720),
        rotation_vector=rotation_vector,
        focal=(18000.0, 18000.0),
        centre=(640.0, 360.0),
        translation=tuple(shift.tolist()),
    )


def test_cameras_that_share_no_markers_get_the_planes_of_their_faces() -> None:
    left = facing((np.pi / 2, 0.0, 0.0))
    right = facing(tuple(Rotation.from_matrix([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]]).as_rotvec().tolist()))
    cameras = with_face_planes(Rig({"left": left, "right": right}), LAYOUT).cameras
    for name, normal, offset in (("left", -1.0, 0.0), ("right", 1.0, 0.03)):
        plane = cameras[name].plane
        assert plane is not None
        np.testing.assert_allclose(plane.normal, [0.0, normal, 0.0], atol=1e-12)
        assert plane.offset == pytest.approx(offset)
    beside = facing((np.pi / 2, 0.1, 0.0))
    shared = with_face_planes(Rig({"left": left, "beside": beside}), LAYOUT).cameras
    assert shared["left"].plane is None
    assert shared["beside"].plane is None


def test_a_world_that_is_not_the_specimen_frame_is_refused() -> None:
    """The world of a stereo pair is the first camera's frame. There the specimen's places are in the camera."""
    own = PinholeCamera(
        image_size=(1280, 720),
        rotation_vector=(0.0, 0.0, 0.0),
        focal=(9e3, 9e3),
        centre=(640.0, 360.0),
        translation=(0.0, 0.0, 0.0),
    )
    with pytest.raises(InputError, match=r"camera left: .* not the specimen frame: place it with rafl-calibrate"):
        with_face_planes(Rig({"left": own}), LAYOUT)
