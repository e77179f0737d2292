"""The error of a mesh: its covariance against dense formulas, its sizes, and first frames of another material."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed_markers import side_camera

from rafl.capture.registration.averaging import average_views
from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.initial import WEIGHT, fit_first_frame
from rafl.capture.registration.mesh_error import CORRELATION_LENGTH, ErrorSizes, MeshError
from rafl.capture.specimen.specimen import Specimen
from rafl.data.views import View

SIZES = ErrorSizes(0.02, 3.0)


def observe(specimen: Specimen, positions: np.ndarray, seed: int = 0) -> FirstFrame:
    """One camera, which looks along y, measures the markers at positions (M, 3) [m] to 0.02 px."""
    pixel = side_camera(0.0).project(positions) + np.random.default_rng(seed).normal(0.0, 0.02, (len(positions), 2))
    covariance = np.broadcast_to(0.02**2 * np.eye(2), (1, len(positions), 2, 2))
    views = {"left": View(side_camera(0.0), pixel[None], covariance, np.zeros(1))}
    target, axes, sigma = average_views(views, positions * [1.0, 0.0, 1.0])
    markers = specimen.markers(1e-6)
    return FirstFrame(specimen.simulator(0.01), markers, specimen.loaded, target, sigma, "test", axes=axes)


@pytest.fixture(scope="module")
def frame(front: Specimen) -> FirstFrame:
    rest = front.markers(1e-6).rest
    return observe(front, rest - 0.2 * rest[:, :1] * [0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def error(frame: FirstFrame) -> MeshError:
    return MeshError.of(frame, frame.target)


def measured_covariance(frame: FirstFrame) -> np.ndarray:
    """Covariance of the measurements about the mesh, (K, K), by its definition."""
    assert frame.axes is not None
    rest = frame.markers.rest
    moved = np.einsum("mij,mj->mi", frame.axes, frame.target - rest)[frame.observed_axes]
    size, length = SIZES.smooth**2 * (moved**2).mean(), CORRELATION_LENGTH * np.ptp(frame.simulator.mesh.vertices[:, 0])
    observed = np.argwhere(frame.observed_axes)
    covariance = np.diag((1.0 + SIZES.single**2) * frame.sigma[frame.observed_axes] ** 2)
    for i, (m, a) in enumerate(observed):
        for j, (n, b) in enumerate(observed):
            alike = np.exp(-((rest[m] - rest[n]) ** 2).sum() / (2.0 * length**2))
            covariance[i, j] += size * alike * frame.axes[m, a] @ frame.axes[n, b]
    return covariance


def test_whitened_errors_are_independent(frame: FirstFrame, error: MeshError) -> None:
    whitening = error.whitening(SIZES)[:, error.observed]
    identity = whitening @ measured_covariance(frame) @ whitening.T
    np.testing.assert_allclose(identity, np.eye(len(identity)), atol=1e-7)


def test_sizes_of_a_drawn_error_are_found(frame: FirstFrame, error: MeshError) -> None:
    """The mean over thirty errors, beside two unknowns that are not known beforehand."""
    random, found = np.random.default_rng(2), []
    root = np.linalg.cholesky(measured_covariance(frame))
    slopes = np.zeros((3 * len(frame.target), 2))
    slopes[error.observed] = random.normal(size=(len(error.observed), 2))
    for _ in range(30):
        offset = np.zeros(len(slopes))
        offset[error.observed] = root @ random.normal(size=len(root))
        offset += slopes @ [0.3, -0.2]
        sizes = error.most_probable(
            np.column_stack([offset, slopes]), np.zeros((0, 3)), np.zeros((2, 2)), ErrorSizes(1e-2, 1.0)
        )
        found.append(np.log(sizes.values))
    smooth, single = np.exp(np.mean(found, axis=0)) / SIZES.values
    assert smooth == pytest.approx(1.0, rel=0.25)
    assert 0.5 < single < 2.0  # five dots in a row do not tell it well from the smooth part


def test_the_depth_of_an_unlike_material_is_not_told_by_its_law(front: Specimen) -> None:
    """A beam of rubber, softer by 40 %, in one camera, fitted by a corotated one of the assumed modulus.

    If all the markers' errors were independent, sideways and axial forces would make up for the law, and leave the tip
    far off along the line of sight.
    """
    physical = replace(front, material=replace(front.material, law="corotated", integration="enhanced"))
    modulus = 0.6 * front.material.youngs_modulus
    rubber = replace(physical.material, law="neo-hookean", poissons_ratio=0.499, youngs_modulus=modulus)
    true = physical.simulator(0.01, rubber)
    force = np.zeros_like(front.mesh.vertices)
    force[front.loaded, 2] = -0.3 / len(front.loaded)
    truth = true.equilibrium((true.weight + force)[None])[0]
    exact = front.markers(1e-6).positions(torch.from_numpy(truth)).numpy()
    deflection = np.abs(exact - front.markers(1e-6).rest).max()
    found = fit_first_frame(observe(physical, exact))
    markers = front.markers(1e-6).positions(torch.from_numpy(found.q)).numpy()
    assert deflection > 5e-3
    assert found.loading == WEIGHT.name
    assert np.abs(markers - exact)[:, [0, 2]].max() < 0.01 * deflection
    assert np.abs(markers - exact)[:, 1].max() < 0.04 * deflection
