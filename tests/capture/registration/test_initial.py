from dataclasses import replace

import numpy as np
import pytest
import torch
from support import ROOT

from rafl.capture.registration import force_search
from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.force_search import ForceSearch
from rafl.capture.registration.initial import PULL, WEIGHT, fit_first_frame
from rafl.capture.registration.rigid import IDENTITY
from rafl.capture.registration.sequence import fit_by_sequence
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.data.synthetic import load_force, loaded_equilibria, twisted_shapes

CANONICAL = ROOT / "datasets" / "specimens" / "canonical.yaml"


@pytest.mark.parametrize("force", [(0.0, 0.0, -0.4), (0.05, 0.1, 0.3)])
def test_the_true_state_is_found_from_exact_markers(
    small_specimen: Specimen, force: tuple[float, float, float]
) -> None:
    """Markers of a known equilibrium are matched to 20 um, and all nodes to 100 um."""
    simulator = small_specimen.simulator(0.01)
    markers = small_specimen.markers(1e-6)
    loaded = np.zeros_like(simulator.mesh.vertices)
    loaded[small_specimen.loaded] = np.array(force) / len(small_specimen.loaded)
    truth = simulator.equilibrium((simulator.weight + loaded)[None])[0]
    target = markers.positions(torch.from_numpy(truth)).numpy()
    sigma = np.full_like(target, 1e-5)
    found = fit_first_frame(FirstFrame(simulator, markers, small_specimen.loaded, target, sigma, "test"))
    assert found.residual < 2e-5
    assert np.linalg.norm(found.q - truth, axis=1).max() < 1e-4
    np.testing.assert_allclose(found.force.sum(0), force, atol=0.01)


@pytest.mark.parametrize(("pull", "hangs"), [(-0.4, True), (0.4, False)])
def test_a_weight_pulls_downwards(small_specimen: Specimen, pull: float, hangs: bool) -> None:
    """What pushes the tip upwards is no weight, though it acts along gravity."""
    simulator, markers = small_specimen.simulator(0.01), small_specimen.markers(1e-6)
    force = simulator.weight.copy()
    force[small_specimen.loaded, 2] += pull / len(small_specimen.loaded)
    target = markers.positions(torch.from_numpy(simulator.equilibrium(force[None])[0])).numpy()
    frame = FirstFrame(simulator, markers, small_specimen.loaded, target, np.full_like(target, 1e-5), "test")
    assert (fit_first_frame(frame).loading == WEIGHT.name) == hangs
    assert fit_first_frame(replace(frame, moving=True)).loading != WEIGHT.name


def test_missing_markers_and_unobserved_axes_are_ignored(small_specimen: Specimen) -> None:
    """The shape is found although the depth is 2 mm off, with a sigma of 0.5 mm, and three markers are missing."""
    simulator = small_specimen.simulator(0.01)
    markers = small_specimen.markers(1e-6)
    truth = loaded_equilibria(simulator, small_specimen.loaded, np.array([0.05]))[0]
    target = markers.positions(torch.from_numpy(truth)).numpy()
    target[:, 1] += 2e-3
    sigma = np.full_like(target, 1e-5)
    sigma[:, 1] = 5e-4
    target[[0, 7, 13]] = np.nan
    found = fit_first_frame(FirstFrame(simulator, markers, small_specimen.loaded, target, sigma, "test"))
    assert np.linalg.norm(found.q - truth, axis=1).max() < 2e-4
    assert found.residual < 5e-5


@pytest.mark.parametrize("local", [0.0, 0.03])
def test_accuracy_under_noise_of_five_micrometres(local: float) -> None:
    """Canonical beam under a tip load, without and with random forces at every loaded node.

    The markers are matched within 1.5 sigma, and without random forces all nodes within 0.05 mm.
    """
    specimen = read_specimen(CANONICAL)
    simulator, markers, random = specimen.simulator(0.01), specimen.markers(1e-6), np.random.default_rng(6)
    force = simulator.weight + load_force(simulator, specimen.loaded, 0.12)
    force[specimen.loaded] += random.normal(0, local, (len(specimen.loaded), 3))
    truth = simulator.equilibrium(force[None])[0]
    target = markers.positions(torch.from_numpy(truth)).numpy()
    sigma = np.full_like(target, 5e-6)
    noisy = target + random.normal(0, 1, target.shape) * sigma
    found = fit_first_frame(FirstFrame(simulator, markers, specimen.loaded, noisy, sigma, "test"))
    assert found.residual / np.sqrt(3.0) < 1.5 * 5e-6
    assert np.linalg.norm(found.q - truth, axis=1).max() < (5e-5 if local == 0.0 else 5e-4)


def test_a_tip_held_by_a_hand_is_found_from_one_side(front: Specimen) -> None:
    """The tip is turned by 50 degrees and held as it is; one camera with 0.02 px sees the dots of one face.

    Linear forces alone would leave the tip 1 mm off.
    """
    simulator, markers, random = front.simulator(0.01), front.markers(1e-6), np.random.default_rng(2)
    held = replace(simulator, fixed=np.union1d(simulator.fixed, front.loaded))
    start = twisted_shapes(front.mesh, np.array([np.radians(50.0)]))
    weight, zero = simulator.weight[None], np.zeros((1, len(front.mesh.vertices)))
    truth = held.minimise(start.copy(), zero, start, weight, held.constitutive_state(1), "held")[0]
    target = markers.positions(torch.from_numpy(truth)).numpy()
    sigma = np.tile([2.2e-6, np.inf, 2.2e-6], (len(target), 1))
    target = target + random.normal(0.0, 2.2e-6, target.shape)
    target[:, 1] = 0.0  # in a plane that is assumed
    axes = np.tile(np.eye(3), (len(target), 1, 1))
    found = fit_first_frame(FirstFrame(simulator, markers, front.loaded, target, sigma, "test", axes=axes))
    assert np.linalg.norm(found.q - truth, axis=1).max() < 1.5e-4


def test_surface_forces_fit_shapes_that_tip_forces_cannot() -> None:
    """The canonical beam pushed to both sides, at its middle and at its tip."""
    specimen = read_specimen(CANONICAL)
    simulator, markers = specimen.simulator(0.01), specimen.markers(1e-6)
    vertices, force = simulator.mesh.vertices, simulator.weight.copy()
    force[np.isclose(vertices[:, 0], 0.05), 1] += 0.1
    force[specimen.loaded, 1] -= 0.04
    truth = simulator.equilibrium(force[None])[0]
    target = markers.positions(torch.from_numpy(truth)).numpy()
    sigma = np.full_like(target, 2e-5)
    surface = np.setdiff1d(np.unique(simulator.mesh.surface), simulator.fixed)
    tip_fit = fit_first_frame(FirstFrame(simulator, markers, specimen.loaded, target, sigma, "test"))
    surface_fit = fit_first_frame(FirstFrame(simulator, markers, surface, target, sigma, "test", whole_surface=True))
    surface_error, tip_error = (np.linalg.norm(found.q - truth, axis=1).max() for found in (surface_fit, tip_fit))
    assert surface_error < 5e-4
    assert surface_error < 0.6 * tip_error
    assert surface_fit.residual < 0.5 * tip_fit.residual


def test_the_sequence_of_forces_approaches_the_same_shape(small_specimen: Specimen) -> None:
    """12 iterations of Adam halve the error; the direct fit is at least ten times as accurate."""
    simulator, markers = small_specimen.simulator(0.01), small_specimen.markers(1e-6)
    truth = loaded_equilibria(simulator, small_specimen.loaded, np.array([0.05]))[0]
    target = markers.positions(torch.from_numpy(truth)).numpy()
    frame = FirstFrame(simulator, markers, small_specimen.loaded, target, np.full_like(target, 1e-5), "test")
    by_sequence = fit_by_sequence(frame, 12)
    rest = simulator.equilibrium(simulator.weight[None])[0]
    error = np.linalg.norm(by_sequence.q - truth, axis=1).max()
    assert error < 0.5 * np.linalg.norm(rest - truth, axis=1).max()
    assert np.linalg.norm(fit_first_frame(frame).q - truth, axis=1).max() < 0.1 * error


def test_a_start_that_leads_to_no_equilibrium_is_left(
    small_specimen: Specimen, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator, markers = small_specimen.simulator(0.01), small_specimen.markers(1e-6)
    target, sigma = markers.rest, np.full_like(markers.rest, 1e-5)
    frame = FirstFrame(simulator, markers, small_specimen.loaded, target, sigma, "test")
    search = ForceSearch(frame, PULL, np.eye(target.size), with_pose=False, with_material=False, pull=0.0)
    monkeypatch.setattr(force_search, "MAX_NEWTON_ITERATIONS", 0)  # no start leads to one
    rest = simulator.mesh.vertices
    found = search.minimise(np.zeros_like(rest), IDENTITY, rest)
    np.testing.assert_allclose(found.q, simulator.equilibrium(simulator.weight[None])[0], atol=1e-9)
