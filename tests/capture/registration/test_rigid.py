import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rafl.capture.registration.rigid import IDENTITY, fit_clamp_poses, fit_pose, kabsch


def moved(points: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points after a random rigid motion, and the rotation of the inverse motion."""
    rotation = Rotation.random(random_state=int(random.integers(1000))).as_matrix()
    return (points - random.normal(0, 0.3, 3)) @ rotation, rotation


@settings(deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.integers(0, 1000))
def test_kabsch_recovers_a_rigid_motion(motion: list[float], seed: int) -> None:
    source = np.random.default_rng(seed).normal(0, 0.05, (5, 3))
    rotation = Rotation.from_rotvec(motion[:3]).as_matrix()
    target = source @ rotation.T + motion[3:]
    fit = kabsch(source, target)
    np.testing.assert_allclose(fit.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(fit.apply(source), target, atol=1e-10)


def test_the_fit_of_a_mirror_image_is_a_proper_rotation() -> None:
    source = np.random.default_rng(0).normal(0, 0.05, (6, 3))
    fit = fit_pose(source, source * [1, 1, -1], np.full_like(source, 1e-5))
    assert np.linalg.det(fit.transform.rotation) == pytest.approx(1.0)
    assert fit.rms_residual > 0.01


def test_points_of_weight_zero_may_be_missing(random: np.random.Generator) -> None:
    target = random.normal(0, 0.05, (6, 3))
    source, rotation = moved(target, random)
    source[2] = np.nan
    fit = kabsch(source, target, np.array([1.0, 1.0, 0.0, 2.0, 1.0, 1.0]))
    np.testing.assert_allclose(fit.rotation, rotation, atol=1e-12)


def test_few_outliers_are_excluded(random: np.random.Generator) -> None:
    """One of four, and two of eight, several millimetres off; markers with small errors stay in the fit."""
    for count, outliers in ((4, [1]), (8, [0, 5]), (8, [])):
        layout = random.normal(0, 0.04, (count, 3))
        source, rotation = moved(layout, random)
        source += random.normal(0, 2e-5, source.shape)
        source[outliers] += random.choice([-1, 1], (len(outliers), 3)) * 4e-3
        fit = fit_pose(source, layout, np.full_like(source, 2e-5))
        assert np.flatnonzero(fit.outliers).tolist() == outliers
        np.testing.assert_allclose(fit.transform.rotation, rotation, atol=5e-3)
        assert fit.rms_residual < 1e-4
        assert (fit.residual[outliers] > 3e-3).all()


def test_coordinates_are_weighted_by_their_sigma(random: np.random.Generator) -> None:
    """The sigma of the depth is 100 times larger; its errors do not change the fit along the other axes."""
    layout = random.normal(0, 0.04, (10, 3))
    sigma = np.broadcast_to([1e-5, 1e-3, 1e-5], layout.shape)
    fit = fit_pose(layout + random.normal(0, 1, layout.shape) * sigma, layout, sigma)
    shift = fit.transform.apply(layout) - layout
    assert np.abs(shift[:, [0, 2]]).max() < 1e-4
    unweighted = kabsch(layout + random.normal(0, 1, layout.shape) * sigma, layout).apply(layout) - layout
    assert np.abs(shift[:, [0, 2]]).max() < 0.5 * np.abs(unweighted).max()


def test_the_covariance_matches_the_scatter(random: np.random.Generator) -> None:
    layout = random.normal(0, 0.04, (7, 3))
    sigma = np.broadcast_to([2e-5, 1e-4, 5e-5], layout.shape)
    steps, predicted = [], []
    for _ in range(300):
        fit = fit_pose(layout + random.normal(0, 1, layout.shape) * sigma, layout, sigma)
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
    pose, distance = fit_clamp_poses(recorded, layout, np.full_like(recorded, 1e-5))
    np.testing.assert_allclose(pose.apply(source), np.broadcast_to(layout, source.shape), atol=1e-4)
    assert np.isnan(distance[3, 1])
    assert np.nanmax(distance[[0, 1, 2, 5, 6, 7, 8]]) < 1e-12


def test_the_identity_keeps_points() -> None:
    points = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(IDENTITY.apply(points), points)
