"""The error of the rest position: of what was not seen at the end, and of what one camera cannot see."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed_markers import filmed, side_camera

from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.data.views import View
from rafl.evaluation.metrics import BASELINE, compare, motion_table
from rafl.evaluation.rest_position import rest_distances

OFFSET = torch.tensor([0.0, 0.004, 0.003], dtype=torch.float64)  # the first camera looks along y


def hidden(view: View, frames: slice, marker: int) -> View:
    """The view without a marker in some frames."""
    pixel, covariance = view.pixel.copy(), view.covariance.copy()
    pixel[frames, marker], covariance[frames, marker] = np.nan, np.nan
    return replace(view, pixel=pixel, covariance=covariance)


def test_positions_are_compared_in_space_over_the_last_tenth(dataset: Dataset) -> None:
    """Each recording ends at its own time, and its marker 0 is not seen there. Errors of a zero mean do not count."""
    item, short = dataset.trajectories["a"], dataset.trajectories["b"].first_frames(11)
    valid = item.valid.copy()
    valid[-2:, 0] = False
    known = replace(dataset, trajectories={"a": replace(item, valid=valid), "b": short})
    recordings = Recordings.of(known, ["a", "b"])
    simulated = recordings.markers + OFFSET
    simulated[-2:, 0] += torch.tensor([[[0.0]], [[0.01]]]) - 0.005
    simulated[11:, 1] = 1.0
    found = rest_distances(recordings, simulated)
    assert np.isnan(found[0, 0])
    np.testing.assert_allclose(found[0, 1:], 0.005)
    np.testing.assert_allclose(found[1], 0.005)


@pytest.mark.parametrize("moving", [False, True])
def test_what_one_camera_saw_is_compared_in_the_image(dataset: Dataset, moving: bool) -> None:
    """Marker 0 is seen by both cameras at the end, marker 1 by the first, marker 2 by the first in the last frame."""
    cameras = {"left": side_camera(0.0), "right": side_camera(np.pi / 2)}
    with_views = filmed(dataset, cameras, moving=moving)
    item = with_views.trajectories["a"]
    right = hidden(hidden(item.views["right"], slice(-2, None), 1), slice(-1, None), 2)
    views = {"left": item.views["left"], "right": right}
    recordings = Recordings.of(replace(with_views, trajectories={"a": replace(item, views=views)}), ["a"])
    turn = item.views["left"].rotation[-1] if item.views["left"].rotation is not None else np.eye(3)
    simulated = recordings.markers + OFFSET
    simulated[-1, :, 2] += 1.0
    found = rest_distances(recordings, simulated)[0]
    along = float(OFFSET.numpy() @ turn @ [0.0, 1.0, 0.0])
    assert found[0] == pytest.approx(0.005)
    assert found[1] == pytest.approx(
        np.sqrt(0.005**2 - along**2), rel=1e-2 if moving else 1e-6
    )  # the mean of two frames
    assert found[2] == pytest.approx(0.005)


def test_the_depth_that_a_plane_assumes_is_no_error_of_the_rest_position(dataset: Dataset) -> None:
    """Positions 5 mm off along the line of sight of the only camera."""
    with_views = filmed(dataset, {"left": side_camera(0.0)})
    shift = np.array([0.0, 0.005, 0.0])

    def shifted(filmed: Dataset) -> Dataset:
        items = filmed.trajectories.items()
        return replace(filmed, trajectories={name: replace(item, markers=item.markers + shift) for name, item in items})

    tables = [motion_table(compare(each, {})) for each in (with_views, shifted(with_views), shifted(dataset))]
    errors = [table[table["method"] == BASELINE]["final_error_mm"].to_numpy() for table in tables]
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-6)
    assert (errors[2] > 4.9).all()
    assert (tables[0][tables[0]["method"] == "recorded"]["final_error_mm"] == 0.0).all()
