import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rafl.capture.registration.rigid import IDENTITY, fit_pose, follow_clamp, kabsch
from scipy.spatial.transform import Rotation


def turned(points: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points somewhere else, and the rotation that leads back."""
    turn = Rotation.random(random_state=int(random.integers(1000))).as_matrix()
    return (points - random.normal(0, 0.3, 3)) @ turn, turn


@settings(deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.integers(0, 1000))
def test_a_rigid_motion_is_found_exactly(motion: list[float], seed: int) -> None:
    source = np.random.default_rng(seed).normal(0, 0.05, (5, 3))
    turn = Rotation.from_rotvec(motion[:3]).as_matrix()
    target = source @ turn.T + motion[3:]
    fit = kabsch(source, target)
    np.testing.assert_allclose(fit.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(fit.apply(source), target, atol=1e-10)


def test_a_mirror_image_is_not_matched() -> None:
    source = np.random.default_rng(0).normal(0, 0.05, (6, 3))
    fit = fit_pose(source, source * [1, 1, -1], np.full_like(source, 1e-5))
    assert np.linalg.det(fit.rigid.rotation) == pytest.approx(1.0)
    assert fit.size > 0.01


def test_points_of_no_weight_may_be_missing(random: np.random.Generator) -> None:
    target = random.normal(0, 0.05, (6, 3))
    source, turn = turned(target, random)
    source[2] = np.nan
    fit = kabsch(source, target, np.array([1.0, 1.0, 0.0, 2.0, 1.0, 1.0]))
    np.testing.assert_allclose(fit.rotation, turn, atol=1e-12)


def test_single_wrong_markers_are_set_aside(random: np.random.Generator) -> None:
    """One of four, and two of eight, several millimetres off; small errors are left alone."""
    for count, wrong in ((4, [1]), (8, [0, 5]), (8, [])):
        layout = random.normal(0, 0.04, (count, 3))
        source, turn = turned(layout, random)
        source += random.normal(0, 2e-5, source.shape)
        source[wrong] += random.choice([-1, 1], (len(wrong), 3)) * 4e-3
        fit = fit_pose(source, layout, np.full_like(source, 2e-5))
        assert np.flatnonzero(fit.wrong).tolist() == wrong
        np.testing.assert_allclose(fit.rigid.rotation, turn, atol=5e-3)
        assert fit.size < 1e-4
        assert (fit.residual[wrong] > 3e-3).all()


def test_axes_count_by_their_uncertainty(random: np.random.Generator) -> None:
    """Depth is a hundred times less sure: errors in depth do not move what the other axes show."""
    layout = random.normal(0, 0.04, (10, 3))
    sigma = np.broadcast_to([1e-5, 1e-3, 1e-5], layout.shape)
    fit = fit_pose(layout + random.normal(0, 1, layout.shape) * sigma, layout, sigma)
    shift = fit.rigid.apply(layout) - layout
    assert np.abs(shift[:, [0, 2]]).max() < 1e-4
    alike = kabsch(layout + random.normal(0, 1, layout.shape) * sigma, layout).apply(layout) - layout
    assert np.abs(shift[:, [0, 2]]).max() < 0.5 * np.abs(alike).max()


def test_the_covariance_is_the_scatter(random: np.random.Generator) -> None:
    layout = random.normal(0, 0.04, (7, 3))
    sigma = np.broadcast_to([2e-5, 1e-4, 5e-5], layout.shape)
    steps, stated = [], []
    for _ in range(300):
        fit = fit_pose(layout + random.normal(0, 1, layout.shape) * sigma, layout, sigma)
        turn = Rotation.from_matrix(fit.rigid.rotation).as_rotvec()
        steps.append(np.concatenate([turn, fit.rigid.translation]))
        stated.append(np.diag(fit.covariance))
    np.testing.assert_allclose(np.std(steps, axis=0), np.sqrt(np.mean(stated, axis=0)), rtol=0.25)


def test_every_frame_has_its_own_motion_and_gaps_are_bridged(random: np.random.Generator) -> None:
    layout = random.normal(0, 0.05, (3, 3))
    turns = Rotation.from_rotvec(np.linspace(0, 0.1, 9)[:, None] * [0.3, -1.0, 0.5]).as_matrix()
    source = np.stack([layout @ turn.T + 0.001 * k for k, turn in enumerate(turns)])
    seen = source.copy()
    seen[[3, 4], 1] = np.nan
    pose, away = follow_clamp(seen, layout, np.full_like(seen, 1e-5))
    np.testing.assert_allclose(pose.apply(source), np.broadcast_to(layout, source.shape), atol=1e-4)
    assert np.isnan(away[3, 1])
    assert np.nanmax(away[[0, 1, 2, 5, 6, 7, 8]]) < 1e-12


def test_identity() -> None:
    points = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(IDENTITY.apply(points), points)
