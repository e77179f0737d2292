"""Recognition of free motions."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from swings import bent, slack_string, swing, touching_load

from rafl.capture.release.free_motion import FreeMotion
from rafl.capture.rendering.motion import tip_load_release, twist_release
from rafl.capture.specimen.specimen import Specimen


@pytest.mark.parametrize("noise", [1e-6, 1e-4])
@pytest.mark.parametrize("damping", [0.0, 0.05, 0.2])
def test_a_damped_oscillation_is_free_from_its_first_frame(damping: float, noise: float) -> None:
    motion = FreeMotion.of(bent(swing(100, -0.02, damping=damping), noise))
    assert motion is not None
    assert motion.period == pytest.approx(14.0, rel=0.15)
    assert motion.free_from() == 0
    assert not motion.moves()


def test_one_row_of_markers_is_enough() -> None:
    """The rotation about the row is not seen and must not count."""
    row = slice(0, 6)
    free, slack = FreeMotion.of(bent(swing(100, -0.02))[:, row]), FreeMotion.of(bent(slack_string())[:, row])
    assert free is not None
    assert slack is not None
    assert free.free_from() == 0
    assert slack.free_from() in (5, 6, 7)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"viscosity": 100.0},
        {"branch_shares": (0.1, 0.1), "branch_times": (0.01, 0.1)},
        {"youngs_modulus": 6e5},
        {"youngs_modulus": 5e4},
    ],
)
def test_simulated_releases_are_free_from_their_first_frame(
    small_specimen: Specimen, change: dict[str, object]
) -> None:
    """Elastic, viscous, relaxing, stiff and soft material; a load, and a twist by 126 degrees."""
    material = replace(small_specimen.material, **change)
    markers = small_specimen.markers(1e-6)
    for motion in (
        tip_load_release(small_specimen, material, 0.08, 80, 200.0),
        twist_release(small_specimen, material, 2.2, 80, 200.0),
    ):
        position = markers.positions(torch.from_numpy(motion.q)).numpy()
        found = FreeMotion.of(position + np.random.default_rng(1).normal(0.0, 1e-5, position.shape))
        assert found is None or found.free_from() == 0


def test_a_slack_string_and_a_load_that_touches_again_are_not_free() -> None:
    slack, touching = FreeMotion.of(bent(slack_string())), FreeMotion.of(bent(touching_load()))
    assert slack is not None
    assert touching is not None
    assert slack.free_from() in (5, 6, 7)
    assert touching.free_from() in (16, 17, 18)


@pytest.mark.parametrize(("first", "moving"), [(0, False), (1, True), (3, True), (10, True), (14, False)])
def test_a_specimen_moves_unless_it_starts_where_it_turns(first: int, moving: bool) -> None:
    motion = FreeMotion.of(bent(swing(100, -0.02)[first:]))
    assert motion is not None
    assert motion.moves() is moving


def test_markers_that_do_not_oscillate_have_no_free_motion() -> None:
    """All missing; too few frames; a specimen that creeps. Noise alone moves nothing."""
    assert FreeMotion.of(np.full((50, 12, 3), np.nan)) is None
    assert FreeMotion.of(bent(swing(8, -0.02))) is None
    assert FreeMotion.of(bent(-0.02 * np.exp(-np.arange(100) / 60.0))) is None
    noise = FreeMotion.of(bent(np.zeros(200)))
    assert noise is None or (noise.free_from() == 0 and not noise.moves())


def test_missing_markers_and_frames_are_left_out() -> None:
    """A tenth of all positions is missing at random; all markers are missing in frames 4 to 11."""
    position = bent(swing(100, -0.02))
    position[np.random.default_rng(2).random(position.shape[:2]) < 0.1] = np.nan
    position[4:12] = np.nan
    motion = FreeMotion.of(position)
    assert motion is not None
    assert np.isnan(motion.modes[4:12]).all()
    assert motion.free_from() == 0
