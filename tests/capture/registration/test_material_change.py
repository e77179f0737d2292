"""The material of a first frame that is not the assumed one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed_markers import side_camera

from rafl.capture.registration.averaging import average_views
from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.force_search import node_force_slopes
from rafl.capture.registration.initial import fit_first_frame
from rafl.capture.registration.material_change import (
    COMPRESSION_UNIT,
    TENSION_UNIT,
    UNCHANGED,
    material_loads,
    with_changed_material,
)
from rafl.capture.specimen.specimen import Specimen
from rafl.data.synthetic import loaded_equilibria
from rafl.data.views import View
from rafl.fitting.quantities import POISSON

LOAD = np.array([0.06])  # [kg]


@pytest.mark.parametrize("change", [(0.0, 0.0, 0.0), (0.2, -1.5, 0.3), (-0.3, -3.0, -0.4)])
def test_slopes_are_those_of_equilibria(small_specimen: Specimen, change: tuple[float, float, float]) -> None:
    simulator, markers = small_specimen.simulator(0.01), small_specimen.markers(1e-6)
    target = np.zeros((len(markers.names), 3))
    frame = FirstFrame(simulator, markers, small_specimen.loaded, target, np.ones_like(target), "test")

    def found(at: np.ndarray) -> np.ndarray:
        return loaded_equilibria(with_changed_material(simulator, at), small_specimen.loaded, LOAD)[0]

    def positions(at: np.ndarray) -> np.ndarray:
        return markers.positions(torch.from_numpy(found(at))).numpy()

    middle, step = np.array(change), 1e-3
    changed = replace(frame, simulator=with_changed_material(simulator, middle))
    by_force = node_force_slopes(changed, found(middle))
    slopes = np.tensordot(by_force, material_loads(simulator, middle, found(middle)))
    for k, unit in enumerate(np.eye(3)):
        expected = (positions(middle + step * unit) - positions(middle - step * unit)) / (2.0 * step)
        np.testing.assert_allclose(slopes[:, k], expected.ravel(), atol=2e-3 * np.abs(expected).max())


def test_a_changed_material_stays_within_its_bounds(small_specimen: Specimen) -> None:
    simulator = small_specimen.simulator(0.01)
    assert with_changed_material(simulator, UNCHANGED) is simulator
    softer = with_changed_material(simulator, np.array([-0.5, 0.0, 0.0])).material
    assert softer.youngs_modulus == pytest.approx(simulator.material.youngs_modulus * np.exp(-0.5))
    assert softer.energy_weights == ()
    for gap, end in ((-20.0, POISSON.high), (20.0, POISSON.low)):
        ratio = with_changed_material(simulator, np.array([0.0, gap, 0.0])).material.poissons_ratio
        assert ratio == pytest.approx(end)
    for weight, unit in ((5.0, TENSION_UNIT), (-5.0, COMPRESSION_UNIT)):
        weights = np.array(with_changed_material(simulator, np.array([0.0, 0.0, weight])).material.energy_weights)
        assert weights[unit] == weights.sum() == 0.75


@pytest.mark.parametrize("ratio", [0.3, 0.499])
def test_poissons_ratio_of_elements_that_lock_moves_no_first_frame(front: Specimen, ratio: float) -> None:
    """One camera sees one side of a body under a hung weight; its elements lock."""
    simulator, markers, random = front.simulator(0.01), front.markers(1e-6), np.random.default_rng(4)
    assert simulator.material.integration == "full"
    true = simulator.with_material(replace(simulator.material, poissons_ratio=ratio))
    q = loaded_equilibria(true, front.loaded, LOAD)[0]
    exact = markers.positions(torch.from_numpy(q)).numpy()
    pixel = side_camera(0.0).project(exact) + random.normal(0.0, 0.02, (len(exact), 2))
    covariance = np.broadcast_to(0.02**2 * np.eye(2), (1, len(exact), 2, 2))
    views = {"front": View(side_camera(0.0), pixel[None], covariance, np.zeros(1))}
    target, axes, sigma = average_views(views, exact * [1.0, 0.0, 1.0])
    found = fit_first_frame(FirstFrame(simulator, markers, front.loaded, target, sigma, "test", axes=axes))
    assert found.loading == "hanging weight"
    assert found.residual < 2e-5
    assert np.linalg.norm(found.q - q, axis=1).max() < 2e-4  # with nu as assumed, 0.8 and 4 mm
