"""The markers' places on the undeformed body, from first frames of a body whose dots are off their described places."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed_markers import side_camera
from scipy.spatial.transform import Rotation

from rafl.capture.registration.averaging import average_views
from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.initial import fit_first_frame
from rafl.capture.registration.places import Places, find_places
from rafl.capture.registration.registration import fit_pose_near_clamp
from rafl.capture.registration.rigid import IDENTITY
from rafl.capture.specimen.specimen import Specimen
from rafl.data.markers import Markers, embed
from rafl.data.synthetic import loaded_equilibria, with_material
from rafl.data.views import View

LOADS = np.array([0.02, 0.05, 0.08, 0.11])
MARKER_SIGMA = 1e-5  # [m]
TURN, SHIFT = Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix(), np.array([0.003, -0.002, 0.004])


def misplacement(specimen: Specimen) -> np.ndarray:
    """Up to 0.5 mm along the skin for every dot [m], (M, 3)."""
    random = np.random.default_rng(3)
    offset = random.uniform(-0.35e-3, 0.35e-3, specimen.layout.positions.shape)
    offset[:, 1] = 0.0  # the dots are on the sides
    return offset


def first_frames(specimen: Specimen, offset: np.ndarray, stiffness: float = 1.0) -> list[FirstFrame]:
    """Equilibria of a body that is `stiffness` times as stiff as described, with dots off by `offset` [m]."""
    simulator = specimen.simulator(0.01)
    material = simulator.material
    true = with_material(simulator, stiffness * material.youngs_modulus, material.poissons_ratio)
    markers = specimen.markers(1e-6)
    dots = embed(simulator.mesh, markers.names, markers.rest + offset)
    random = np.random.default_rng(5)
    frames = []
    for load, q in zip(LOADS, loaded_equilibria(true, specimen.loaded, LOADS), strict=True):
        target = dots.positions(torch.from_numpy(q)).numpy() + random.normal(0.0, MARKER_SIGMA, offset.shape)
        sigma = np.full_like(target, MARKER_SIGMA)
        frames.append(FirstFrame(simulator, markers, specimen.loaded, target, sigma, f"{1e3 * load:.0f} g"))
    return frames


def one_camera_frames(specimen: Specimen, frames: list[FirstFrame]) -> list[FirstFrame]:
    """The same as seen by one camera that faces the front, to 0.02 px."""
    random, seen = np.random.default_rng(6), []
    for frame in frames:
        pixel = side_camera(0.0).project(frame.target) + random.normal(0.0, 0.02, (len(frame.target), 2))
        covariance = np.broadcast_to(0.02**2 * np.eye(2), (1, len(pixel), 2, 2))
        views = {"front": View(side_camera(0.0), pixel[None], covariance, np.zeros(1))}
        target, axes, sigma = average_views(views, frame.target * [1.0, 0.0, 1.0])
        seen.append(replace(frame, target=target, axes=axes, sigma=sigma))
    return seen


def find(specimen: Specimen, frames: list[FirstFrame], prior_sigma: float = 0.5e-3) -> Markers:
    return find_places(frames, [False] * len(frames), IDENTITY, np.full(len(frames[0].target), prior_sigma)).markers


def moved_away(frames: list[FirstFrame], loads: np.ndarray | None = None) -> list[FirstFrame]:
    """The same as recorded in another frame; with loads [kg] that are known, or not."""
    loads = np.zeros(len(frames)) if loads is None else loads
    return [
        replace(frame, target=frame.target @ TURN.T + SHIFT, load=float(load))
        for frame, load in zip(frames, loads, strict=True)
    ]


def find_in_other_frame(specimen: Specimen, frames: list[FirstFrame], prior_sigma: float) -> Places:
    pose = fit_pose_near_clamp(specimen, np.mean([frame.target for frame in frames], axis=0))
    return find_places(frames, [True] * len(frames), pose, np.full(len(frames[0].target), prior_sigma))


@pytest.mark.parametrize("stiffness", [1.0, 1.4])
def test_places_are_found_to_a_twentieth_of_a_millimetre(small_specimen: Specimen, stiffness: float) -> None:
    offset = misplacement(small_specimen)
    found = find(small_specimen, first_frames(small_specimen, offset, stiffness))
    assert found.moved is not None
    assert found.place_sigma is not None
    error = found.moved - offset
    assert np.sqrt((offset[:, [0, 2]] ** 2).mean()) > 0.18e-3
    assert np.sqrt((error[:, [0, 2]] ** 2).mean()) < 0.05e-3
    assert (np.abs(error) < 3.0 * found.place_sigma).all()
    np.testing.assert_allclose(found.rest, small_specimen.layout.positions + found.moved)


def test_places_from_one_camera_move_no_first_frame_sideways(front: Specimen) -> None:
    """Of a body with hung weights, softer than described; sideways forces would bend it by tenths of a millimetre."""
    exact = first_frames(front, np.zeros_like(front.layout.positions), 0.75)
    frames = one_camera_frames(front, exact)
    markers = find(front, frames)
    for frame, true in zip(frames, exact, strict=True):
        found = fit_first_frame(replace(frame, markers=markers))
        assert found.loading == "hanging weight"
        depth = (markers.positions(torch.from_numpy(found.q)).numpy() - true.target)[:, 1]
        assert np.abs(depth).max() < 0.15e-3


def test_places_are_found_in_an_unknown_frame(small_specimen: Specimen) -> None:
    """Without a known frame, the shape that the dots form is found; its position follows from their prior."""
    offset = misplacement(small_specimen)
    frames = moved_away(first_frames(small_specimen, offset))
    found = find_in_other_frame(small_specimen, frames, 0.5e-3).markers
    assert found.moved is not None
    sides = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (found.rest, found.rest - found.moved + offset)]
    described = np.linalg.norm(found.rest[:, None] - found.moved[:, None] - found.rest + found.moved, axis=-1)
    assert np.sqrt(((sides[0] - sides[1]) ** 2).mean()) < 0.06e-3
    assert np.sqrt(((described - sides[1]) ** 2).mean()) > 0.2e-3


@pytest.mark.parametrize("stiffness", [0.7, 1.6])
def test_known_loads_tell_the_frame_from_the_material(small_specimen: Specimen, stiffness: float) -> None:
    """Loads that hang within 5 % of the vertical give E to about that; the frame does not absorb its error."""
    frames = first_frames(small_specimen, np.zeros_like(small_specimen.layout.positions), stiffness)
    places = find_in_other_frame(small_specimen, moved_away(frames, LOADS), 0.0)
    error = np.log(places.modulus / (stiffness * small_specimen.material.youngs_modulus))
    assert abs(error) < 0.05
    assert abs(error) < 3.0 * places.modulus_sigma
    assert places.modulus_sigma < 0.1
    assert np.linalg.norm(places.pose.rotation @ TURN - np.eye(3)) < 0.01
    np.testing.assert_allclose(places.pose.apply(SHIFT[None])[0], 0.0, atol=0.2e-3)


def test_without_known_loads_frame_and_material_cannot_be_told_apart(small_specimen: Specimen) -> None:
    frames = first_frames(small_specimen, np.zeros_like(small_specimen.layout.positions), 1.6)
    places = find_in_other_frame(small_specimen, moved_away(frames), 0.5e-3)
    assert places.modulus_sigma > 0.25
    error = np.log(places.modulus / (1.6 * small_specimen.material.youngs_modulus))
    assert abs(error) < 3.0 * places.modulus_sigma


def test_places_that_are_exactly_known_stay(small_specimen: Specimen) -> None:
    found = find(small_specimen, first_frames(small_specimen, misplacement(small_specimen)), prior_sigma=0.0)
    assert found.moved is not None
    assert np.abs(found.moved).max() < 1e-8


def test_a_missing_marker_stays_with_its_prior(small_specimen: Specimen) -> None:
    frames = first_frames(small_specimen, misplacement(small_specimen))
    for frame in frames:
        frame.target[4] = np.nan
    found = find(small_specimen, frames)
    assert found.moved is not None
    assert found.place_sigma is not None
    np.testing.assert_allclose(found.moved[4], 0.0, atol=1e-9)
    np.testing.assert_allclose(found.place_sigma[4], 0.5e-3, rtol=1e-6)
