"""Places and names of dots, from recordings of a sagging box whose truth is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stills import SIDES, SIZE_MM, TOP_AND_TIP, box_body, still

from rafl.capture.description.describe import Description, describe
from rafl.capture.description.specimen_text import body_of_box
from rafl.capture.registration.recording import Recording
from rafl.capture.specimen.specimen import Body
from rafl.common.errors import InputError

LEFT_AND_RIGHT = [f"{side}{number}" for side in "LR" for number in range(1, 17)]


BODY = box_body()


def described(recording: Recording, body: Body = BODY, lying: bool = False) -> Description:
    return describe(recording, body, Path(), lying, "still.h5")


def errors_mm(found: Description, places_mm: np.ndarray) -> np.ndarray:
    return np.linalg.norm(1e3 * found.undeformed.carried.rest - places_mm, axis=1)


@pytest.mark.parametrize("stiffness", [0.6, 1.5])
def test_places_on_the_sides_are_found_whatever_the_stiffness(stiffness: float) -> None:
    """The tip sags by 24 and 9 mm; with the assumed stiffness the places would be off by 9 and 4 mm."""
    found = described(still(SIDES, stiffness))
    assert [found.names[k] for k in found.listed] == LEFT_AND_RIGHT
    assert list(found.names) == LEFT_AND_RIGHT
    errors = errors_mm(found, SIDES)
    assert errors.max() < 0.2
    assert (errors < 3.0 * 1e3 * found.undeformed.sigma).all()
    assert found.sag_tells
    assert found.youngs_modulus == pytest.approx(stiffness * BODY.material.youngs_modulus, rel=0.05)


def test_places_of_dots_that_a_hand_placed(random: np.random.Generator) -> None:
    places = SIDES + random.normal(0.0, 0.3, SIDES.shape) * [1.0, 0.0, 1.0]
    found = described(still(places, 1.5))
    errors = errors_mm(found, places)
    assert (errors < 3.0 * 1e3 * found.undeformed.sigma).all()
    assert np.sqrt((errors**2).mean()) < 0.25


def test_dots_on_the_top_tell_the_sag_without_rows(random: np.random.Generator) -> None:
    places = np.column_stack([random.uniform(8, 95, 20), random.uniform(3, 17, 20), np.full(20, 20.0)])
    found = described(still(places, 1.4))
    assert set(found.faces) == {"z-max"}
    assert errors_mm(found, places).max() < 0.2


def test_scattered_dots_on_the_sides_leave_the_stiffness_as_assumed(random: np.random.Generator) -> None:
    y = np.repeat([0.0, SIZE_MM[1]], 12)
    places = np.column_stack([random.uniform(8, 95, 24), y, random.uniform(3, 17, 24)])
    found = described(still(places))
    assert not found.sag_tells
    assert (errors_mm(found, places) < 3.0 * 1e3 * found.undeformed.sigma).all()
    assert found.undeformed.sigma.max() > 1e-3


def test_a_specimen_that_lies_flat_is_not_bent_back() -> None:
    found = described(still(SIDES, lying=True), lying=True)
    assert errors_mm(found, SIDES).max() < 0.05
    assert found.youngs_modulus == BODY.material.youngs_modulus


@pytest.mark.parametrize("stiffness", [0.7, 1.0, 1.6])
def test_a_specimen_that_hangs_does_not_lie_flat(stiffness: float) -> None:
    with pytest.raises(InputError, match=r"found them bent as if it hung, .* leave out --lying"):
        described(still(SIDES, stiffness), lying=True)


def test_a_sag_that_contradicts_the_material_is_refused() -> None:
    with pytest.raises(InputError, match=r"a sag of the assumed material, 216 kPa, .* say that it lies flat"):
        described(still(SIDES, lying=True))


def test_names_of_a_file_are_kept_unless_they_are_of_row_and_column() -> None:
    recording = still(SIDES)
    names = tuple(f"dot {k}" for k in range(len(SIDES)))
    assert described(replace(recording, names=names)).names == names
    shuffled = np.random.default_rng(4).permutation(len(SIDES))
    unnamed = replace(still(SIDES[shuffled]), names=None)  # such a file has the order of the specimen
    found = described(unnamed)
    assert list(found.listed) == list(range(len(SIDES)))
    assert [found.names[k] for k in np.argsort(shuffled)] == LEFT_AND_RIGHT


def test_a_few_dots_off_the_body_are_left_out() -> None:
    recording = still(SIDES)
    position = recording.position.copy()
    position[:, 5, 2] += 0.03
    found = described(replace(recording, position=position))
    assert list(found.left_out) == ["left-r1c6"]
    assert found.left_out["left-r1c6"] == pytest.approx(0.024, abs=2e-3)  # above the top
    assert len(found.names) == len(SIDES) - 1


def test_a_wrong_world_and_a_wrong_size_are_told_apart() -> None:
    recording = still(SIDES)
    moved = replace(recording, position=recording.position + np.array([0.0, 0.008, 0.0]))
    with pytest.raises(InputError, match=r"moved by about -?0, -8, -?0 mm .* the world of the recording is not"):
        described(moved)
    with pytest.raises(InputError, match=r"the body 100\.0 x 32\.0 x 20\.0 mm, .* correct the size or shape"):
        described(recording, body_of_box("wide", (100.0, 32.0, 20.0), None))


def test_a_foreign_frame_is_found_where_the_dots_tell_it() -> None:
    places = np.concatenate([SIDES, TOP_AND_TIP])
    recording = still(places, 1.2)
    turn = Rotation.from_rotvec([0.0, 0.0, 2.0]).as_matrix()

    def elsewhere(recording: Recording) -> Recording:
        position, sigma = recording.position @ turn.T + [1.0, 0.5, -0.3], np.full_like(recording.sigma, 1e-4)
        return replace(recording, position=position, sigma=sigma, in_specimen_frame=False)

    found = described(elsewhere(recording))
    errors = errors_mm(found, places)
    assert np.sqrt((errors**2).mean()) < 0.25
    assert (errors < 3.0 * 1e3 * found.undeformed.sigma).all()
    with pytest.raises(InputError, match="put dots on the tip and the top too"):
        described(elsewhere(still(SIDES, 1.2)))
