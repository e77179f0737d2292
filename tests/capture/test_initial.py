import numpy as np
import pytest
import torch

from capture.initial import fit_first_frame
from capture.specimen import Specimen
from rafl.synthetic import hung


@pytest.mark.parametrize("force", [(0.0, 0.0, -0.4), (0.05, 0.1, 0.3)])
def test_the_true_state_is_found_from_exact_markers(
    small_specimen: Specimen, force: tuple[float, float, float]
) -> None:
    """Markers of a known equilibrium: they are met to 20 um and the whole mesh to 50 um."""
    simulator = small_specimen.simulator(0.01)
    markers = small_specimen.markers(1e-6)
    loaded = np.zeros_like(simulator.mesh.vertices)
    loaded[small_specimen.loaded] = np.array(force) / len(small_specimen.loaded)
    truth = simulator.equilibrium((simulator.weight + loaded)[None])[0]
    target = markers.positions(torch.from_numpy(truth)).numpy()
    sigma = np.full_like(target, 1e-5)
    found = fit_first_frame(simulator, markers, small_specimen.loaded, target, sigma, "test")
    assert found.residual < 2e-5
    assert np.linalg.norm(found.q - truth, axis=1).max() < 5e-5
    np.testing.assert_allclose(found.force.sum(0), force, atol=0.01)


def test_unseen_markers_and_unobserved_axes_do_not_count(small_specimen: Specimen) -> None:
    """Depth 2 mm wrong with a sigma of 5 mm, and three markers missing: the shape is still found."""
    simulator = small_specimen.simulator(0.01)
    markers = small_specimen.markers(1e-6)
    truth = hung(simulator, small_specimen.loaded, np.array([0.05]))[0]
    target = markers.positions(torch.from_numpy(truth)).numpy()
    target[:, 1] += 2e-3
    sigma = np.full_like(target, 1e-5)
    sigma[:, 1] = 5e-3
    target[[0, 7, 13]] = np.nan
    found = fit_first_frame(simulator, markers, small_specimen.loaded, target, sigma, "test")
    assert np.linalg.norm(found.q - truth, axis=1).max() < 2e-4
    assert found.residual < 5e-5
