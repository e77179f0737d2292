"""The objective in the image plane, and the views in the dataset file."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from filmed_markers import PIXELS_PER_METRE, POSE_SIGMA, filmed, frame_motion, pinhole_camera, side_camera
from scipy.spatial.transform import Rotation

from rafl.common.errors import InputError
from rafl.data.camera_terms import CameraTerm
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import damaged_parts, read_dataset, write_dataset
from rafl.data.objective import Recordings, frame_errors, loss_curvature, recording_losses, training_loss
from rafl.data.views import View, at_lags, seen_axes
from rafl.evaluation.metrics import compare
from rafl.fitting.fit import fit

CAMERAS = {"left": side_camera(0.0), "right": side_camera(np.pi / 2)}


def random_offsets(recordings: Recordings, size: float, seed: int = 0) -> torch.Tensor:
    """Offsets of markers [m], (T, B, M, 3)."""
    random = np.random.default_rng(seed)
    return torch.from_numpy(random.normal(0.0, size, tuple(recordings.markers.shape)))


def test_motion_along_the_line_of_sight_of_one_camera_costs_nothing(dataset: Dataset) -> None:
    """The other two directions cost as much as they do in space."""
    recordings = Recordings.of(filmed(dataset, {"left": side_camera(0.0)}), ["a", "b"])
    assert recordings.in_image
    along = torch.tensor([0.0, 0.004, 0.0], dtype=torch.float64)
    across = torch.tensor([0.0001, 0.0, 0.0002], dtype=torch.float64)
    nothing = torch.empty(0)
    assert float(training_loss(recordings, recordings.markers + along, nothing)) == pytest.approx(0.0, abs=1e-18)
    in_space = Recordings.of(dataset, ["a", "b"])
    expected = float(training_loss(in_space, in_space.markers + across, nothing))
    found = float(training_loss(recordings, recordings.markers + along + across, nothing))
    assert found == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(
        np.concatenate(frame_errors(recordings, recordings.markers + along + across)), np.sqrt(5e-8)
    )


def test_two_cameras_at_right_angles_count_the_shared_direction_twice(dataset: Dataset) -> None:
    recordings = Recordings.of(filmed(dataset, CAMERAS), ["a"])
    steps = len(recordings.markers) - 1
    markers = recordings.markers.shape[2]
    for direction, count in (([1.0, 0.0, 0.0], 1), ([0.0, 1.0, 0.0], 1), ([0.0, 0.0, 1.0], 2)):
        offset = 0.001 * torch.tensor(direction, dtype=torch.float64)
        loss = float(recording_losses(recordings, recordings.markers + offset))
        assert loss == pytest.approx(1e3 * count * markers * 1e-6 * steps / steps, rel=1e-9)
        np.testing.assert_allclose(frame_errors(recordings, recordings.markers + offset)[0], 0.001)


def test_pixels_count_by_their_covariance(dataset: Dataset) -> None:
    """A sigma four times as large counts for a sixteenth. One ten times smaller than the median counts as a fifth."""
    with_views = filmed(dataset, {"left": side_camera(0.0)})
    item = with_views.trajectories["a"]
    covariance = item.views["left"].covariance.copy()
    covariance[:, 0] *= 16.0
    covariance[:, 1] *= 0.01
    views = {"left": replace(item.views["left"], covariance=covariance)}
    changed = replace(with_views, trajectories={**with_views.trajectories, "a": replace(item, views=views)})
    recordings = Recordings.of(changed, ["a"])
    for marker, weight in ((0, 1 / 16), (1, 25.0), (2, 1.0)):
        offset = torch.zeros_like(recordings.markers)
        offset[:, :, marker, 0] = 0.00005
        loss = float(recording_losses(recordings, recordings.markers + offset))
        assert loss == pytest.approx(1e3 * weight * 0.00005**2, rel=1e-6)


@pytest.mark.parametrize("size", [2e-4, 2e-2])
@pytest.mark.parametrize("moving", [False, True])
def test_gradient_through_distorted_cameras_and_lags(dataset: Dataset, size: float, moving: bool) -> None:
    """Also where residuals are large and count linearly, and where the clamp moves."""
    cameras = {"left": side_camera(0.2, (0.03, -0.01)), "top": pinhole_camera(0.5)}
    with_views = filmed(dataset, cameras, moving=moving)
    lagging = {}
    for number, (name, item) in enumerate(with_views.trajectories.items()):
        views = {key: replace(view, lag=view.lag + 0.003 * (1 + number)) for key, view in item.views.items()}
        lagging[name] = replace(item, views=views)
    recordings = Recordings.of(replace(with_views, trajectories=lagging), ["a", "b"])
    simulated = (recordings.markers + random_offsets(recordings, size)).requires_grad_()
    (gradient,) = torch.autograd.grad(recording_losses(recordings, simulated).sum(), simulated)
    direction, step = random_offsets(recordings, 1.0, 1), 1e-7
    with torch.no_grad():
        ahead, behind = (recording_losses(recordings, simulated + s * direction).sum() for s in (step, -step))
    assert float((gradient * direction).sum()) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-5)


@pytest.mark.parametrize("moving", [False, True])
def test_curvature_is_that_of_the_loss_at_small_residuals(dataset: Dataset, moving: bool) -> None:
    recordings = Recordings.of(filmed(dataset, CAMERAS | {"top": pinhole_camera(0.5)}, moving=moving), ["a", "b"])
    slope = torch.stack([random_offsets(recordings, 1.0, seed) for seed in (1, 2)], dim=1)
    found = loss_curvature(recordings, recordings.markers, slope)
    step, none = 1e-6, torch.empty(0)

    def loss(a: float, b: float) -> float:
        return float(training_loss(recordings, recordings.markers + step * (a * slope[:, 0] + b * slope[:, 1]), none))

    expected = np.array([[2 * loss(1, 0), 0], [0, 2 * loss(0, 1)]]) / step**2
    expected[0, 1] = expected[1, 0] = (loss(1, 1) - loss(1, 0) - loss(0, 1)) / step**2
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-4)


def test_one_marker_far_off_counts_linearly(dataset: Dataset) -> None:
    recordings = Recordings.of(filmed(dataset, {"left": side_camera(0.0)}), ["a"])
    limit = float(recordings.limit.sqrt())
    losses = []
    for distance in (0.5 * limit, 4.0 * limit, 8.0 * limit):
        offset = torch.zeros_like(recordings.markers)
        offset[:, :, 0, 0] = distance
        losses.append(float(recording_losses(recordings, recordings.markers + offset)))
    assert losses[0] == pytest.approx(1e3 * 0.25 * limit**2)
    assert losses[1:] == pytest.approx([1e3 * 7.0 * limit**2, 1e3 * 15.0 * limit**2])


@pytest.mark.parametrize("frames", [2, 3, 5, 9])
def test_lags_are_exact_for_polynomials_through_six_frames(frames: int) -> None:
    """Of order 5, or lower by as many frames as there are fewer than 6."""
    random, terms = np.random.default_rng(0), min(frames, 6)
    time = torch.arange(frames, dtype=torch.float64)
    factors = torch.from_numpy(random.normal(size=(terms, 2, 5, 3)))

    def path(t: torch.Tensor) -> torch.Tensor:
        powers = torch.stack([(t / frames) ** k for k in range(terms)])
        return torch.einsum("ktb,kbmi->tbmi", powers, factors)

    lag = torch.from_numpy(random.uniform(-1.0, 1.0, (frames, 2)))
    own = path(time[:, None].repeat(1, 2))
    np.testing.assert_allclose(at_lags(own, lag).numpy(), path(time[:, None] + lag).numpy(), atol=1e-10)
    assert at_lags(own, torch.zeros(frames, 2)) is own


def test_lags_of_an_oscillation_are_nearly_exact() -> None:
    phase = 2.0 * np.pi / 14.0 * np.arange(60)
    late = 2.0 * np.pi / 14.0 * (np.arange(60) + 0.5)
    found = at_lags(torch.from_numpy(np.sin(phase))[:, None], torch.full((60, 1), 0.5, dtype=torch.float64))[:, 0]
    error = np.abs(found.numpy() - np.sin(late))
    assert error[2:-3].max() < 5e-5
    assert error[:-1].max() < 2e-4


def test_what_was_measured_after_the_last_frame_is_not_compared(dataset: Dataset) -> None:
    """A camera that is late by half a frame filmed the last row when a simulation up to there has ended."""
    step = dataset.simulator.time_step
    recordings = filmed(dataset, {"left": side_camera(0.3), "right": side_camera(-0.3)})
    item = recordings.trajectories["a"]
    frames = len(item.time)
    views = {"left": item.views["left"], "right": replace(item.views["right"], lag=np.full(frames, 0.5 * step))}
    late = Recordings.of(replace(recordings, trajectories={"a": replace(item, views=views)}), ["a"])
    for part, count in ((late, frames), (late.first_frames(5), 5)):
        seen = {name: term.seen.amax((1, 2)).bool().tolist() for name, term in part.terms.items()}
        assert seen == {"left": [True] * count, "right": [True] * (count - 1) + [False]}


def test_a_moving_frame_counts_at_the_times_of_the_camera(dataset: Dataset) -> None:
    """The camera lags by 0.4 frames; motion of the markers and of the frame are cubic in time, so both are exact."""
    frames, camera = len(dataset.trajectories["a"].time), pinhole_camera(0.5)

    def seen(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        markers = dataset.markers.rest + 0.004 * (time**3)[:, None, None] * [1.0, 0.5, -1.0]
        rotation = Rotation.from_rotvec(0.1 * time[:, None] * [0.5, 0.7, -0.5]).as_matrix()
        return markers, rotation, time[:, None] ** 2 * [0.003, -0.002, 0.004]

    time = np.arange(frames) / frames
    markers, rotation, translation = seen(time + 0.4 / frames)
    pixel = camera.project(np.einsum("tji,tmj->tmi", rotation, markers - translation[:, None]))
    lag = np.full(frames, 0.4 * dataset.simulator.time_step)
    covariance = np.broadcast_to(1e-4 * np.eye(2), (*pixel.shape, 2))
    view = View(camera, pixel, covariance, lag, rotation, translation)
    item = replace(dataset.trajectories["a"], markers=seen(time)[0], views={"top": view})
    recordings = Recordings.of(replace(dataset, trajectories={"a": item}), ["a"])
    (gap,) = recordings.gaps(recordings.markers)
    assert float(gap.abs().max()) < 1e-12
    late = replace(recordings, terms={"top": replace(recordings.terms["top"], lag=torch.zeros(frames, 1))})
    assert float(late.gaps(recordings.markers)[0].abs().max()) > 1e-5


def test_errors_of_a_frame_count_as_what_they_are(dataset: Dataset) -> None:
    """The loss is r . C^-1 r for the pixels of all cameras and the covariance of their own errors and the pose's."""
    with_views = filmed(dataset, CAMERAS, moving=True)
    recordings = Recordings.of(with_views, ["a"])
    offset = random_offsets(recordings, 1e-5)
    found = recordings.gaps(recordings.markers + offset)
    for frame in (0, 7):
        gaps, slopes, variances = [], [], []
        for view in with_views.trajectories["a"].views.values():
            markers = recordings.markers[:, 0].numpy()
            gaps.append((view.project(markers + offset[:, 0].numpy()) - view.pixel)[frame].ravel())
            slopes.append(view.pose_slope(markers)[frame].reshape(-1, 6))
            variances.append(np.diagonal(view.covariance[frame], axis1=1, axis2=2).ravel())
        gap, slope = np.concatenate(gaps), np.concatenate(slopes)
        whole = np.diag(np.concatenate(variances)) + slope @ np.diag(POSE_SIGMA**2) @ slope.T
        reference = 0.02 / PIXELS_PER_METRE
        square = sum(float(part[frame].square().sum()) for part in found) / reference**2
        assert square == pytest.approx(gap @ np.linalg.solve(whole, gap), rel=1e-6)
        assert square < gap @ (gap / np.concatenate(variances)) - 1.0


def test_an_error_of_the_frame_costs_little(dataset: Dataset) -> None:
    """As large as its sigma says, it costs at most 1, however many pixels show it."""
    recordings = Recordings.of(filmed(dataset, CAMERAS, moving=True), ["a"])
    markers = recordings.markers
    turn = torch.tensor([1e-4, 0.0, 0.0], dtype=torch.float64)
    turned = markers + torch.linalg.cross(turn.expand_as(markers), markers)
    exact = replace(recordings, terms={name: _exact(term) for name, term in recordings.terms.items()})
    squares = [
        sum(part.square().sum((1, 2, 3)) for part in each.gaps(turned)) / (0.02 / PIXELS_PER_METRE) ** 2
        for each in (recordings, exact)
    ]
    assert float(squares[0].max()) < 1.0
    assert float(squares[1].min()) > 10.0


def _exact(term: CameraTerm) -> CameraTerm:
    """What a camera measured, if the poses were exact."""
    return replace(term, by_pose=torch.zeros_like(term.by_pose))


def test_seen_directions_turn_with_the_frame(dataset: Dataset) -> None:
    """The direction that one camera does not see is its line of sight, in the specimen frame of each time."""
    recordings = Recordings.of(filmed(dataset, {"left": side_camera(0.0)}, moving=True), ["a"])
    last = len(recordings.markers) - 1
    rotation = frame_motion(last + 1)[0]
    for frame in (0, last):
        unseen = torch.eye(3) - recordings.seen_directions(frame)[0, 3]
        sight = rotation[frame] @ [0.0, 1.0, 0.0]
        np.testing.assert_allclose(unseen.numpy(), np.outer(sight, sight), atol=1e-9)


def test_seen_axes_of_one_and_two_cameras() -> None:
    def view(angle: float, sigma: float, seen: list[bool]) -> View:
        pixel = np.where(np.array(seen)[None, :, None], 100.0, np.nan)
        covariance = np.where(np.array(seen)[None, :, None, None], sigma**2 * np.eye(2), np.nan)
        return View(side_camera(angle), pixel, covariance, np.zeros(1))

    views = {"a": view(0.0, 0.02, [True, True, False]), "b": view(np.pi / 2, 0.04, [True, False, False])}
    axes, sigma = seen_axes(views, np.zeros((3, 3)))
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-12)
    metres = 0.02 / PIXELS_PER_METRE
    np.testing.assert_allclose(sigma[0], [metres * np.sqrt(0.8), metres, 2.0 * metres])  # z twice, x, y
    np.testing.assert_allclose(sigma[1], [metres, metres, np.inf])
    np.testing.assert_allclose(axes[1, 2], [0.0, 1.0, 0.0], atol=1e-12)  # away from the camera
    assert np.isinf(sigma[2]).all()


def test_views_are_stored_with_their_cameras(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "filmed.h5"
    noisy = filmed(dataset, CAMERAS | {"top": pinhole_camera(0.5)}, noise=np.random.default_rng(0))
    moving = filmed(dataset, CAMERAS, moving=True).trajectories["b"]
    noisy = replace(noisy, trajectories={**noisy.trajectories, "b": moving})
    write_dataset(path, noisy)
    found = read_dataset(path)
    for name, item in noisy.trajectories.items():
        for key, view in item.views.items():
            own = found.trajectories[name].views[key]
            np.testing.assert_array_equal(own.pixel, view.pixel)
            np.testing.assert_array_equal(own.covariance, view.covariance)
            np.testing.assert_allclose(own.project(item.markers), view.project(item.markers), atol=1e-9)
            assert (own.rotation is not None) == (name == "b")
            if name == "b":
                np.testing.assert_array_equal(own.pose_covariance, view.pose_covariance)
    assert damaged_parts(path) == []
    with h5py.File(path, "r+") as file:
        file["trajectories/a/views/left/pixel"][3, 2] += 1.0
    assert damaged_parts(path) == ["trajectories/a"]


def test_files_of_the_third_format_are_read(dataset: Dataset, tmp_path: Path) -> None:
    """Their moving frames have poses without errors."""
    path = tmp_path / "old.h5"
    write_dataset(path, filmed(dataset, CAMERAS, moving=True))
    with h5py.File(path, "r+") as file:
        for view in (file[f"trajectories/{name}/views/{camera}"] for name in "ab" for camera in CAMERAS):
            del view["pose_covariance"]
        file.attrs["format"] = "rafl-dataset/3"
    found = Recordings.of(read_dataset(path), ["a"])
    assert float(recording_losses(found, found.markers)) < 1e-18
    assert not found.terms["left"].by_pose.any()


def test_files_of_the_second_format_are_read(dataset: Dataset, tmp_path: Path) -> None:
    """They hold cameras of a frame at rest only."""
    path = tmp_path / "old.h5"
    with_views = filmed(dataset, CAMERAS)
    write_dataset(path, with_views)
    with h5py.File(path, "r+") as file:
        assert set(file["trajectories/a/views/left"]) == {"pixel", "covariance", "lag"}
        file.attrs["format"] = "rafl-dataset/2"
    found = Recordings.of(read_dataset(path), ["a"])
    assert float(recording_losses(found, found.markers)) < 1e-18


def test_files_of_the_first_format_are_read(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "old.h5"
    write_dataset(path, dataset)
    with h5py.File(path, "r+") as file:
        assert "views" not in file["trajectories/a"]
        file.attrs["format"] = "rafl-dataset/1"
    found = read_dataset(path)
    assert found.trajectories["a"].views == {}
    assert not Recordings.of(found, ["a"]).in_image


def test_pixels_that_are_not_there_cannot_be_compared(dataset: Dataset) -> None:
    with pytest.raises(InputError, match="recording a: expected the pixels"):
        Recordings.of(dataset, ["a"], objective="image")
    nothing = filmed(dataset, CAMERAS).trajectories["a"]
    views = {
        key: replace(view, pixel=np.full_like(view.pixel, np.nan), covariance=np.full_like(view.covariance, np.nan))
        for key, view in nothing.views.items()
    }
    unseen = replace(dataset, trajectories={"a": replace(nothing, views=views)})
    unseen.check()
    assert not Recordings.of(unseen, ["a"]).in_image
    with pytest.raises(InputError, match="recording a: expected the pixels"):
        Recordings.of(unseen, ["a"], objective="image")
    with_views = filmed(dataset, CAMERAS)
    assert not Recordings.of(with_views, ["a"], objective="3d").in_image


@pytest.mark.parametrize("moving", [False, True])
def test_parts_of_recordings_keep_their_pixels(dataset: Dataset, moving: bool) -> None:
    with_views = filmed(dataset, CAMERAS, noise=np.random.default_rng(0), moving=moving)
    recordings = Recordings.of(with_views, ["a", "b", "c"])
    part = recordings.select([2, 0]).first_frames(7).select_markers(np.array([3, 5]))
    for name, term in part.terms.items():
        assert bool(term.by_pose.any()) == moving
        assert torch.equal(term.by_pose, recordings.terms[name].by_pose[:7, [2, 0]][:, :, [3, 5]])
    # Errors of the pose couple the markers of a frame.
    recordings, part = (
        replace(each, terms={name: _exact(term) for name, term in each.terms.items()}) for each in (recordings, part)
    )
    simulated = recordings.markers[:7, [2, 0]][:, :, [3, 5]] + 1e-3
    whole = [gap[:7][:, [2, 0]][:, :, [3, 5]] for gap in recordings.gaps(recordings.markers + 1e-3)]
    for own, expected in zip(part.gaps(simulated), whole, strict=True):
        np.testing.assert_allclose(own.numpy(), expected.numpy(), atol=1e-15)
    np.testing.assert_allclose(part.limit.numpy(), recordings.limit[[2, 0]].numpy())


def test_settings_without_effect_on_pixels_are_told(dataset: Dataset, tmp_path: Path) -> None:
    with_views = filmed(dataset, CAMERAS)
    mixed = {**with_views.trajectories, "c": dataset.trajectories["c"]}
    write_dataset(tmp_path / "all.h5", with_views)
    write_dataset(tmp_path / "some.h5", replace(with_views, trajectories=mixed))
    for name, message in (("all", "--by-sigma has no effect"), ("some", "some recordings have no pixels")):
        told: list[str] = []
        options = {"method": "sysid-e", "epochs": 1, "frames": 3, "by_sigma": True, "notify": told.append}
        fit(tmp_path / f"{name}.h5", tmp_path / name, **options)  # type: ignore[arg-type]
        assert len(told) == 1
        assert message in told[0]


def test_recordings_with_nothing_to_compare_are_named(dataset: Dataset, tmp_path: Path) -> None:
    """A simulation begins in the first frame: what was measured there, or after the last frame, tells nothing."""
    with_views = filmed(dataset, CAMERAS)
    item, step = with_views.trajectories["a"], dataset.simulator.time_step

    def only(frame: int, lag: float) -> Recordings:
        views = {}
        for name, view in item.views.items():
            pixel, covariance = np.full_like(view.pixel, np.nan), np.full_like(view.covariance, np.nan)
            pixel[frame], covariance[frame] = view.pixel[frame], view.covariance[frame]
            late = np.full(len(item.time), lag)
            views[name] = replace(view, pixel=pixel, covariance=covariance, lag=late)
        items = with_views.trajectories | {"a": replace(item, views=views)}
        return Recordings.of(replace(with_views, trajectories=items), ["a", "b"])

    only(-1, 0.0).require_measurements()
    only(1, 0.5 * step).require_measurements()
    for frame, lag in ((0, 0.0), (-1, 0.5 * step)):
        with pytest.raises(InputError, match="small, recordings a: expected a pixel after the first frame"):
            only(frame, lag).require_measurements()
    valid = np.zeros_like(item.valid)
    valid[0] = True
    first = replace(dataset, trajectories={"a": replace(dataset.trajectories["a"], valid=valid)})
    with pytest.raises(InputError, match="recordings a: expected a marker's position after the first frame"):
        compare(first, {})
    unknown = replace(dataset.trajectories["a"], sigma=np.full_like(dataset.trajectories["a"].sigma, np.inf))
    recordings = Recordings.of(replace(dataset, trajectories={"a": unknown}), ["a"], by_sigma=True)
    with pytest.raises(InputError, match="recordings a: expected a position of finite sigma"):
        recordings.require_measurements()
    write_dataset(tmp_path / "first.h5", first)
    with pytest.raises(InputError, match="recordings a: expected a marker's position"):
        fit(tmp_path / "first.h5", tmp_path / "run", "sysid-e")
    assert not (tmp_path / "run").exists()
