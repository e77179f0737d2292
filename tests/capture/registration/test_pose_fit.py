"""Fits of poses to positions, and to lines of sight of one camera or two."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rafl.capture.registration.pose_fit import Measured, fit_pose, fit_poses
from rafl.capture.registration.rigid import kabsch


def moved(points: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points after a random rigid motion, and the rotation of the inverse motion."""
    rotation = Rotation.random(random_state=int(random.integers(1000))).as_matrix()
    return (points - random.normal(0, 0.3, 3)) @ rotation, rotation


def test_the_fit_of_a_mirror_image_is_a_proper_rotation() -> None:
    source = np.random.default_rng(0).normal(0, 0.05, (6, 3))
    fit = fit_pose(Measured.of(source, np.full_like(source, 1e-5)), source * [1, 1, -1])
    assert np.linalg.det(fit.transform.rotation) == pytest.approx(1.0)
    assert fit.rms_residual > 0.01


def test_few_outliers_are_excluded(random: np.random.Generator) -> None:
    """One of four, and two of eight, several millimetres off; markers with small errors stay in the fit."""
    for count, outliers in ((4, [1]), (8, [0, 5]), (8, [])):
        layout = random.normal(0, 0.04, (count, 3))
        source, rotation = moved(layout, random)
        source += random.normal(0, 2e-5, source.shape)
        source[outliers] += random.choice([-1, 1], (len(outliers), 3)) * 4e-3
        fit = fit_pose(Measured.of(source, np.full_like(source, 2e-5)), layout)
        assert np.flatnonzero(fit.outliers).tolist() == outliers
        np.testing.assert_allclose(fit.transform.rotation, rotation, atol=5e-3)
        assert fit.rms_residual < 1e-4
        assert (fit.residual[outliers] > 3e-3).all()


def test_coordinates_are_weighted_by_their_sigma(random: np.random.Generator) -> None:
    """The sigma of the depth is 100 times larger; its errors do not change the fit along the other axes."""
    layout = random.normal(0, 0.04, (10, 3))
    sigma = np.broadcast_to([1e-5, 1e-3, 1e-5], layout.shape)
    fit = fit_pose(Measured.of(layout + random.normal(0, 1, layout.shape) * sigma, sigma), layout)
    shift = fit.transform.apply(layout) - layout
    assert np.abs(shift[:, [0, 2]]).max() < 1e-4
    unweighted = kabsch(layout + random.normal(0, 1, layout.shape) * sigma, layout).apply(layout) - layout
    assert np.abs(shift[:, [0, 2]]).max() < 0.5 * np.abs(unweighted).max()


def test_the_covariance_matches_the_scatter(random: np.random.Generator) -> None:
    layout = random.normal(0, 0.04, (7, 3))
    sigma = np.broadcast_to([2e-5, 1e-4, 5e-5], layout.shape)
    steps, predicted = [], []
    for _ in range(300):
        fit = fit_pose(Measured.of(layout + random.normal(0, 1, layout.shape) * sigma, sigma), layout)
        rotation = Rotation.from_matrix(fit.transform.rotation).as_rotvec()
        steps.append(np.concatenate([rotation, fit.transform.translation]))
        predicted.append(np.diag(fit.covariance))
    np.testing.assert_allclose(np.std(steps, axis=0), np.sqrt(np.mean(predicted, axis=0)), rtol=0.25)


def test_clamp_poses_are_fitted_per_frame_and_interpolated_over_gaps(random: np.random.Generator) -> None:
    layout = random.normal(0, 0.05, (3, 3))
    rotations = Rotation.from_rotvec(np.linspace(0, 0.1, 9)[:, None] * [0.3, -1.0, 0.5]).as_matrix()
    source = np.stack([layout @ rotation.T + 0.001 * k for k, rotation in enumerate(rotations)])
    recorded = source.copy()
    recorded[[3, 4], 1] = np.nan
    pose, _, distance = fit_poses(Measured.of(recorded, np.full_like(recorded, 1e-5)), layout)
    np.testing.assert_allclose(pose.apply(source), np.broadcast_to(layout, source.shape), atol=1e-4)
    assert np.isnan(distance[3, 1])
    assert np.nanmax(distance[[0, 1, 2, 5, 6, 7, 8]]) < 1e-12
