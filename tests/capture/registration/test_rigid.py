import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rafl.capture.registration.rigid import IDENTITY, kabsch


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


def test_points_of_weight_zero_may_be_missing(random: np.random.Generator) -> None:
    target = random.normal(0, 0.05, (6, 3))
    source, rotation = moved(target, random)
    source[2] = np.nan
    fit = kabsch(source, target, np.array([1.0, 1.0, 0.0, 2.0, 1.0, 1.0]))
    np.testing.assert_allclose(fit.rotation, rotation, atol=1e-12)


def test_the_identity_keeps_points() -> None:
    points = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(IDENTITY.apply(points), points)
