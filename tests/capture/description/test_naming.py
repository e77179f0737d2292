"""Names of dots by face, row and column."""

import numpy as np
from support import ROOT

from rafl.capture.description.naming import faces_of, name_dots
from rafl.capture.specimen.specimen import read_specimen


def test_names_are_those_of_the_canonical_specimen() -> None:
    layout = read_specimen(ROOT / "datasets" / "specimens" / "canonical.yaml").layout
    order = np.random.default_rng(0).permutation(len(layout.names))
    places = layout.positions[order]
    faces = ["y-min" if y == 0 else "y-max" for y in places[:, 1]]
    assert name_dots(faces, places) == tuple(layout.names[k] for k in order)


def test_every_face_has_its_letter_and_reading_order() -> None:
    tops = [(0.02, 0.02, 0.03), (0.01, 0.02, 0.03), (0.01, 0.01, 0.03), (0.02, 0.01, 0.03)]
    places = np.array([*tops, (0.1, 0.02, 0.01), (0.1, 0.01, 0.01), (0.05, 0.01, 0.0)])
    faces = faces_of(np.array([(0.1, 0.0, 0.9)] * 4 + [(1.0, 0.0, 0.0)] * 2 + [(0.2, 0.3, -0.9)]))
    assert faces == ["z-max"] * 4 + ["x-max"] * 2 + ["z-min"]
    assert name_dots(faces, places) == ("T4", "T3", "T1", "T2", "E2", "E1", "B1")


def test_dots_in_no_grid_are_named_in_reading_order() -> None:
    x, z = np.array([12, 40, 71, 20, 55, 33]), np.array([25, 24, 26, 15, 14, 5])
    places = 1e-3 * np.column_stack([x, np.zeros(6), z])
    assert name_dots(["y-min"] * 6, places) == ("L1", "L2", "L3", "L4", "L5", "L6")
