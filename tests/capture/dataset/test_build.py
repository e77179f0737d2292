from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic_tracks import tracks_of_positions

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.summary import warnings
from rafl.capture.dataset.table import RecordingRow, read_recording_rows
from rafl.capture.registration.registration import RestPose
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset, update_dataset, write_dataset
from rafl.data.synthetic import load_force
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.export import WRITERS, export_name
from rafl.tracking.reconstruction.tracks import read_tracks, write_tracks

SETTINGS = CaptureSettings()
FRAMES = 8
LAB_POSE = (Rotation.from_rotvec([0.3, -0.8, 1.2]).as_matrix(), np.array([0.4, -0.1, 1.5]))


@pytest.fixture(scope="module")
def truth(small_specimen: Specimen) -> np.ndarray:
    """Undeformed marker positions in row 0, followed by those after the release of 60 g [m], (1 + T, M, 3)."""
    motion = tip_load_release(small_specimen, small_specimen.material, 0.06, FRAMES, 100.0)
    markers = small_specimen.markers(1e-6)
    moving = markers.positions(torch.from_numpy(motion.q)).numpy()
    return np.concatenate([small_specimen.layout.positions[None], moving])


def build(specimen: Specimen, folder: Path, settings: CaptureSettings = SETTINGS, **row: object) -> Dataset:
    rows = [RecordingRow(**{"recording": "q0", "load_g": 60, "split": "train"} | row)]
    return build_dataset(specimen, folder, rows, settings, "", lambda: None)


def in_lab_frame(points: np.ndarray) -> np.ndarray:
    return points @ LAB_POSE[0].T + LAB_POSE[1]


def write_c3d(path: Path, names: list[str], points: np.ndarray) -> None:
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = names
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    data = np.ones((4, points.shape[1], len(points)))
    data[:3] = 1e3 * points.transpose(2, 1, 0)
    file["data"]["points"] = data
    file.write(str(path))


def test_npy_files_are_registered_by_their_rest_row(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    np.save(tmp_path / "q0.npy", 1e3 * in_lab_frame(truth))
    built = build(small_specimen, tmp_path)
    item = built.trajectories["q0"]
    np.testing.assert_allclose(item.markers, truth[1:], atol=1e-9)
    np.testing.assert_allclose(item.time, 0.01 * np.arange(FRAMES))
    assert item.attributes["registration_residual_mm"] < 1e-6
    assert item.attributes["fit_residual_mm"] < 0.1
    # The virtual force equals the load of 60 g.
    load = load_force(built.simulator, small_specimen.loaded, 0.06)
    np.testing.assert_allclose(item.virtual_force.sum(0), load.sum(0), atol=0.03)


def with_clamp(specimen: Specimen) -> Specimen:
    positions = np.array([[-0.01, -0.02, 0.0], [-0.01, 0.04, 0.0], [-0.01, 0.01, 0.05], [-0.02, 0.0, 0.0]])
    return replace(specimen, clamp_layout=MarkerLayout(("C1", "C2", "C3", "C4"), positions))


def test_motion_capture_is_registered_to_a_moving_clamp(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    """The clamp shakes by 1 mm and 1 degree, which the registration removes. One clamp marker is always missing."""
    specimen = with_clamp(small_specimen)
    random = np.random.default_rng(5)
    points = np.concatenate([truth[1:], np.broadcast_to(specimen.clamp_layout.positions, (FRAMES, 4, 3))], axis=1)
    turns = Rotation.from_rotvec(random.normal(0, np.radians(1), (FRAMES, 3))).as_matrix()
    shaken = np.einsum("tij,tmj->tmi", turns, points) + random.normal(0, 1e-3, (FRAMES, 1, 3))
    shaken[:, -1] = np.nan
    write_c3d(tmp_path / "q0.c3d", [*specimen.layout.names, *specimen.clamp_layout.names], in_lab_frame(shaken))
    item = build(specimen, tmp_path).trajectories["q0"]
    assert [text.split()[0] for text in str(item.attributes["registration_markers"]).split(", ")] == ["C1", "C2", "C3"]
    assert item.attributes["registration_residual_mm"] < 1e-3
    np.testing.assert_allclose(item.markers, truth[1:], atol=1e-6)  # C3D holds single precision
    unregistered = build(specimen, tmp_path, replace(SETTINGS, moving_clamp=False)).trajectories["q0"]
    assert np.abs(unregistered.markers - truth[1:]).max() > 5e-4


def test_a_rest_pose_registers_files_without_a_clamp(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    """The rest pose is the mean over 30 frames of a separate recording; it is better than one frame."""
    names, random = list(small_specimen.layout.names), np.random.default_rng(2)
    write_c3d(tmp_path / "q0.c3d", names, in_lab_frame(truth[1:]))
    straight = np.broadcast_to(truth[:1], (30, *truth.shape[1:])) + random.normal(0, 1e-4, (30, *truth.shape[1:]))
    write_c3d(tmp_path / "straight.c3d", names, in_lab_frame(np.concatenate([truth[5:], straight])))
    averaged = build(small_specimen, tmp_path, replace(SETTINGS, rest=RestPose("straight", 4, 33))).trajectories["q0"]
    single = build(small_specimen, tmp_path, replace(SETTINGS, rest=RestPose("straight", 4, 4))).trajectories["q0"]
    errors = [np.abs(item.markers - truth[1:]).max() for item in (averaged, single)]
    assert errors[0] < 3e-5
    assert errors[0] < 0.5 * errors[1]
    assert averaged.attributes["registration"] == "rest pose"
    sigma = np.sqrt(np.diag(np.asarray(averaged.attributes["registration_covariance"])))
    assert sigma[3:].max() < 2e-4
    with pytest.raises(InputError, match="frames within 0 to 33"):
        build(small_specimen, tmp_path, replace(SETTINGS, rest=RestPose("straight", 4, 34)))
    with pytest.raises(InputError, match=r"recording nowhere.*nowhere\.h5"):
        build(small_specimen, tmp_path, replace(SETTINGS, rest=RestPose("nowhere")))


def test_without_a_rest_pose_the_pose_is_fitted_with_the_model(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    """The first frame is bent by 60 g, and the pose of the lab frame is unknown."""
    write_c3d(tmp_path / "q0.c3d", list(small_specimen.layout.names), in_lab_frame(truth[1:]))
    built = build(small_specimen, tmp_path)
    item = built.trajectories["q0"]
    assert str(item.attributes["registration"]).startswith("through the model")
    assert built.registered_through_model == ["q0"]
    assert "film the undeformed specimen (--rest)" in warnings(built)[0]
    assert np.abs(item.markers - truth[1:]).max() < 5e-4
    assert item.attributes["fit_residual_mm"] < 0.05


def test_a_frame_found_through_the_model_does_not_absorb_a_wrong_modulus(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    """The specimen is half as stiff as assumed. The known load tells; an unknown one leaves E and the frame open."""
    write_c3d(tmp_path / "q0.c3d", list(small_specimen.layout.names), in_lab_frame(truth[1:]))
    stiff = replace(small_specimen.material, youngs_modulus=2.0 * small_specimen.material.youngs_modulus)
    assumed = replace(small_specimen, material=stiff)
    built = build(assumed, tmp_path)
    item = built.trajectories["q0"]
    found, sigma = (float(str(item.attributes[f"registration_modulus{end}"])) for end in ("", "_sigma"))
    assert abs(np.log(found / small_specimen.material.youngs_modulus)) < 2.0 * sigma
    assert sigma < 0.1
    assert np.abs(item.markers - truth[1:]).max() < 5e-4
    assert (np.abs(item.markers - truth[1:]) < 4.0 * item.sigma).all()
    assert "from the loads in recordings.csv" in warnings(built)[0]
    contradicting = replace(item, attributes=item.attributes | {"swing_modulus": 1.3 * found})
    swung = warnings(replace(built, trajectories={"q0": contradicting}))[0]
    assert f"where their swing shows {1.3e-3 * found:.0f} kPa: the two cannot be told apart" in swung
    assert "give load_g" not in swung
    unknown = build(assumed, tmp_path, load_g=0)
    assert "cannot be told apart" in warnings(unknown)[0]
    assert "or give load_g" in warnings(unknown)[0]


def test_an_outlier_is_left_out_and_named(small_specimen: Specimen, truth: np.ndarray, tmp_path: Path) -> None:
    recorded = truth.copy()
    recorded[:, 6] += [0.0, 0.004, 0.003]
    np.save(tmp_path / "q0.npy", 1e3 * in_lab_frame(recorded))
    item = build(small_specimen, tmp_path).trajectories["q0"]
    assert item.attributes["set_aside"] == small_specimen.layout.names[6]
    assert not item.valid[:, 6].any()
    others = np.arange(20) != 6
    np.testing.assert_allclose(item.markers[:, others], truth[1:, others], atol=1e-9)


def test_frames_at_rest_are_averaged(small_specimen: Specimen, truth: np.ndarray, tmp_path: Path) -> None:
    """The mean of 20 noisy frames at rest gives a more accurate first frame than one of them."""
    random = np.random.default_rng(4)
    at_rest = np.repeat(truth[1:2], 20, axis=0)
    recorded = np.concatenate([truth[:1], at_rest, truth[2:]])
    recorded[1:] += random.normal(0, 5e-5, recorded[1:].shape)
    np.save(tmp_path / "q0.npy", 1e3 * recorded)
    dataset = build(small_specimen, tmp_path)
    item = dataset.trajectories["q0"]
    assert (item.attributes["first_frame"], item.attributes["first_frame_from"]) == (19, "the motion")
    assert int(str(item.attributes["still_frames"])) >= 15
    assert len(item.time) == FRAMES
    fitted = dataset.markers.positions(torch.from_numpy(item.q)).numpy()
    assert np.sqrt(((fitted - truth[1]) ** 2).mean()) < 2.5e-5
    given = build(small_specimen, tmp_path, replace(SETTINGS, start=21)).trajectories["q0"]
    assert (given.attributes["first_frame"], len(given.time)) == (21, FRAMES - 2)


def test_a_recording_that_starts_in_motion(small_specimen: Specimen, tmp_path: Path) -> None:
    """Positions and velocities of all nodes in the middle of a swing are fitted to the markers."""
    fine = tip_load_release(small_specimen, small_specimen.material, 0.06, 300, 1000.0).q
    markers = small_specimen.markers(1e-6).positions(torch.from_numpy(fine[::10])).numpy()
    np.save(tmp_path / "q0.npy", 1e3 * np.concatenate([small_specimen.layout.positions[None], markers]))
    settings = replace(SETTINGS, initial="moving", forces="surface", start=6)
    item = build(small_specimen, tmp_path, settings).trajectories["q0"]
    velocity = (fine[61] - fine[59]) / 2e-3
    assert np.abs(item.q - fine[60]).max() < 1e-4
    assert np.linalg.norm(item.v - velocity) < 0.05 * np.linalg.norm(velocity)
    at_rest = build(small_specimen, tmp_path, replace(SETTINGS, initial="rest", start=6)).trajectories["q0"]
    assert np.abs(at_rest.v).max() == 0.0


def test_the_state_of_the_first_frame_is_found(small_specimen: Specimen, tmp_path: Path) -> None:
    """The same motion from its release on, and from a frame on in which it is fast."""
    fine = tip_load_release(small_specimen, small_specimen.material, 0.06, 400, 1000.0).q
    markers = small_specimen.markers(1e-6).positions(torch.from_numpy(fine)).numpy()
    for first, state in ((0, "rest"), (15, "moving")):
        recorded = np.concatenate([small_specimen.layout.positions[None], markers[first::5]])
        np.save(tmp_path / "q0.npy", 1e3 * recorded)
        dataset = build(small_specimen, tmp_path, replace(SETTINGS, fps=200.0))
        item = dataset.trajectories["q0"]
        found = (item.attributes["initial"], item.attributes["first_frame"], item.attributes["not_free_frames"])
        assert found == (state, 0, 0)
        velocity = (fine[first + 1] - fine[max(first - 1, 0)]) / (1e-3 * (first + 1 - max(first - 1, 0)))
        error = np.linalg.norm(item.v - (velocity if state == "moving" else 0.0))
        assert error <= 0.1 * np.linalg.norm(velocity) * (state == "moving")
        assert warnings(dataset) == []
    slack = replace(item, attributes=item.attributes | {"first_frame": 16, "not_free_frames": 7})
    (line,) = warnings(replace(dataset, trajectories={"q0": slack}))
    assert "none in frames 9 to 15" in line


def write_q0_tracks(specimen: Specimen, folder: Path, position: np.ndarray, sigma: np.ndarray) -> None:
    """Write q0.h5 with every marker measured."""
    tracks = tracks_of_positions(specimen.layout.names, position, sigma)
    write_tracks(folder / "q0.h5", replace(tracks, sources={"v.mp4": "0"}))


def test_tracks_need_no_registration_but_must_be_in_the_specimen_frame(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    """Tracks are in the specimen frame already; a shift of 20 mm is refused, because no bending explains it."""
    moving, sigma = truth[1:], np.full_like(truth[1:], 1e-5)
    write_q0_tracks(small_specimen, tmp_path, moving, sigma)
    item = build(small_specimen, tmp_path).trajectories["q0"]
    np.testing.assert_array_equal(item.markers, moving)
    write_q0_tracks(small_specimen, tmp_path, moving + np.array([0.0, 0.02, 0.0]), sigma)
    with pytest.raises(InputError, match="world is not the specimen's frame, or the calibration belongs to another"):
        build(small_specimen, tmp_path)


def test_markers_named_from_the_other_end_are_refused_at_once(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    moving, sigma = truth[1:], np.full_like(truth[1:], 1e-5)
    write_q0_tracks(small_specimen, tmp_path, moving[:, ::-1], sigma)
    message = r"frame 0: expected marker \w+ near its at_mm, [0-9.]+ mm from the clamp, found it [0-9.]+ mm off"
    with pytest.raises(InputError, match=message):
        build(small_specimen, tmp_path)


def test_frames_are_selected_and_gaps_kept(small_specimen: Specimen, truth: np.ndarray, tmp_path: Path) -> None:
    recorded = in_lab_frame(truth)
    recorded[4, 2:5] = np.nan
    np.save(tmp_path / "q0.npy", 1e3 * recorded)
    item = build(small_specimen, tmp_path, first_frame=1, last_frame=6).trajectories["q0"]
    assert len(item.time) == 6
    assert item.time[0] == 0.0
    assert not item.valid[2, 2:5].any()
    assert item.valid.sum() == 6 * 20 - 3


def test_a_hanging_load_is_kept_as_force_and_mass(small_specimen: Specimen, truth: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "q0.npy", 1e3 * truth)
    item = build(small_specimen, tmp_path, load="hanging").trajectories["q0"]
    assert item.added_mass.sum() == pytest.approx(0.06)
    np.testing.assert_allclose(item.load.sum(0), [0, 0, -0.06 * 9.80709])
    released = build(small_specimen, tmp_path).trajectories["q0"]
    assert released.added_mass.sum() == 0.0
    assert np.abs(released.load).sum() == 0.0


def test_invalid_files_and_frames_are_refused(small_specimen: Specimen, truth: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "q0.npy"
    for content, message in (
        (1e3 * truth[:, :-1], "expected 20 markers .* found 19"),
        (1e3 * truth[:, ::-1], "mm off"),
        (1e3 * truth[:, :, :2], r"found \(9, 20, 2\)"),
        (1e6 * truth, "expected mm"),
    ):
        np.save(path, content)
        with pytest.raises(InputError, match=message):
            build(small_specimen, tmp_path)
    np.save(path, 1e3 * truth)
    with pytest.raises(InputError, match="frames within 0 to 7"):
        build(small_specimen, tmp_path, last_frame=8)
    np.save(path, np.array([{}]), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read"):
        build(small_specimen, tmp_path)
    path.unlink()
    with pytest.raises(InputError, match=r"q0\.h5, \.csv, \.c3d, \.trc, \.tsv or \.npy"):
        build(small_specimen, tmp_path)


def test_a_marker_farther_away_than_anything_is_refused(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    recorded = truth[1:].copy()
    recorded[4, 2, 1] = 1e5
    write_q0_tracks(small_specimen, tmp_path, recorded, np.full_like(recorded, 1e-5))
    with pytest.raises(InputError, match=r"q0\.h5: expected positions within 1000 m, found 1e\+05 m"):
        build(small_specimen, tmp_path)


def test_a_marker_without_one_coordinate_is_missing(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    recorded = 1e3 * truth
    recorded[4, 2, 1] = np.nan
    np.save(tmp_path / "q0.npy", recorded)
    valid = build(small_specimen, tmp_path).trajectories["q0"].valid
    assert np.argwhere(~valid).tolist() == [[3, 2]]


@pytest.mark.parametrize("least", [0.0, 1e-200])
def test_an_impossible_sigma_is_refused(
    least: float, small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    sigma = np.full_like(truth[1:], 1e-5)
    sigma[4, 2] = least
    write_q0_tracks(small_specimen, tmp_path, truth[1:], sigma)
    with pytest.raises(InputError, match=r"q0\.h5: expected a sigma of at least 1e-12 m"):
        build(small_specimen, tmp_path)


def test_a_dot_far_from_its_description_is_found_and_named(
    small_specimen: Specimen, truth: np.ndarray, tmp_path: Path
) -> None:
    """The places are in the dataset and its file; recordings that are added later get the same ones."""
    layout = small_specimen.layout
    described = replace(layout, positions=layout.positions + np.eye(len(layout.names))[:, :1] * [4e-3, 0.0, 0.0])
    material = replace(small_specimen.material, integration="enhanced")
    specimen = replace(small_specimen, layout=described, material=material)
    write_q0_tracks(specimen, tmp_path, truth[1:], np.full_like(truth[1:], 1e-5))
    built = build(specimen, tmp_path)
    assert built.markers.moved is not None
    np.testing.assert_allclose(built.markers.moved[0], [-4e-3, 0.0, 0.0], atol=5e-4)
    assert np.abs(built.markers.moved[1:]).max() < 5e-4
    assert build(replace(specimen, material=small_specimen.material), tmp_path).markers.moved is None
    (line,) = warnings(built)
    assert line.startswith(f"marker {layout.names[0]}: found ")
    more = built.markers.moved + np.where(np.arange(len(layout.names))[:, None] < 4, [3e-3, 0.0, 0.0], 0.0)
    (line,) = warnings(replace(built, markers=replace(built.markers, moved=more)))
    assert line.startswith("markers found far from their at_mm in the first frames, in mm: ")
    assert f"{layout.names[3]} 3.0. Correct at_mm" in line
    assert "the calibration belongs to another set-up" in line
    write_dataset(tmp_path / "small.h5", built)
    again = read_dataset(tmp_path / "small.h5").markers
    for key in ("rest", "moved", "place_sigma"):
        np.testing.assert_array_equal(getattr(again, key), getattr(built.markers, key))
    rows = [RecordingRow(recording="q0", load_g=60, split="val")]
    added = build_dataset(specimen, tmp_path, rows, SETTINGS, "", lambda: None, again)
    update_dataset(tmp_path / "small.h5", added)
    assert read_dataset(tmp_path / "small.h5").split("val") == ["q0"]
    with pytest.raises(InputError, match="without --update"):
        build_dataset(replace(specimen, layout=layout), tmp_path, rows, SETTINGS, "", lambda: None, again)


def places_of(specimen: Specimen) -> dict[str, np.ndarray]:
    return dict(zip(specimen.layout.names, specimen.layout.positions, strict=True))


@pytest.mark.parametrize("kind", ["csv", "c3d", "trc", "npy"])
def test_exports_are_read_back(kind: str, small_specimen: Specimen, truth: np.ndarray, tmp_path: Path) -> None:
    """Every export gives the positions of the tracks, in the specimen frame, without any option."""
    write_q0_tracks(small_specimen, tmp_path, truth[1:], np.full_like(truth[1:], 1e-5))
    tracks = read_tracks(tmp_path / "q0.h5")
    own = build(small_specimen, tmp_path).trajectories["q0"]
    (tmp_path / "q0.h5").unlink()
    WRITERS[kind](tmp_path / export_name(kind, "q0", 0), tracks, places_of(small_specimen))
    read = build(small_specimen, tmp_path).trajectories["q0"]
    np.testing.assert_allclose(read.markers, own.markers, atol=1e-7)
    np.testing.assert_allclose(read.time, own.time)
    np.testing.assert_allclose(read.q, own.q, atol=3e-5)


def test_the_richest_file_of_a_recording_is_read(small_specimen: Specimen, truth: np.ndarray, tmp_path: Path) -> None:
    write_q0_tracks(small_specimen, tmp_path, truth[1:], np.full_like(truth[1:], 1e-5))
    for kind in WRITERS:
        path = tmp_path / export_name(kind, "q0", 0)
        WRITERS[kind](path, read_tracks(tmp_path / "q0.h5"), places_of(small_specimen))
    source = str(build(small_specimen, tmp_path).trajectories["q0"].attributes["source"])
    assert source.startswith("q0.h5 ")
    assert source.endswith("beside it, not read: q0.csv, q0.c3d, q0.trc, q0.npy")


def test_a_dataset_of_test_recordings_alone(small_specimen: Specimen, truth: np.ndarray, tmp_path: Path) -> None:
    """A shape that nobody trains on; a line for spreadsheets before the table is skipped."""
    write_q0_tracks(small_specimen, tmp_path, truth[1:], np.full_like(truth[1:], 1e-5))
    (tmp_path / "recordings.csv").write_text("\ufeffsep=;\r\nrecording;load_g;split\r\nq0;60,5;test\r\n")
    rows = read_recording_rows(tmp_path / "recordings.csv")
    assert [(row.recording, row.load_g, row.split) for row in rows] == [("q0", 60.5, "test")]
    built = build_dataset(small_specimen, tmp_path, rows, SETTINGS, "", lambda: None)
    assert built.split("test") == ["q0"]
