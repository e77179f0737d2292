import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from capture.registration import IDENTITY, rigid_fit


@settings(deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.integers(0, 1000))
def test_a_rigid_motion_is_found_exactly(motion: list[float], seed: int) -> None:
    source = np.random.default_rng(seed).normal(0, 0.05, (5, 3))
    turn = Rotation.from_rotvec(motion[:3]).as_matrix()
    target = source @ turn.T + motion[3:]
    fit = rigid_fit(source, target)
    np.testing.assert_allclose(fit.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(fit.apply(source), target, atol=1e-10)
    assert fit.residual < 1e-10


def test_a_mirror_image_is_not_matched() -> None:
    source = np.random.default_rng(0).normal(0, 0.05, (6, 3))
    fit = rigid_fit(source, source * [1, 1, -1])
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)
    assert fit.residual > 0.01


def test_every_frame_has_its_own_motion(random: np.random.Generator) -> None:
    target = random.normal(0, 0.05, (3, 3))
    turns = Rotation.from_rotvec(random.normal(0, 0.1, (7, 3))).as_matrix()
    source = np.stack([target @ turn.T + 0.01 * k for k, turn in enumerate(turns)])
    fit = rigid_fit(source, target)
    np.testing.assert_allclose(fit.apply(source), np.broadcast_to(target, source.shape), atol=1e-12)
    assert fit.residual.shape == (7,)


def test_identity() -> None:
    points = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(IDENTITY.apply(points), points)
