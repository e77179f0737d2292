"""The calls of the page of a calibration, and what the command refuses."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from board_shots import RIG, SIZE, bend, make_boards
from starlette.testclient import TestClient
from support import Run, assert_refused

from rafl.calibration.camera import PinholeCamera
from rafl.calibration.rig import read_board_source, write_calibration
from rafl.review.calibration.boards import Boards
from rafl.review.calibration.calls import CalibrationView
from rafl.review.calibration.plane_grid import plane_grid
from rafl.review.server import create_server

PORT, TOKEN = 4321, "token-of-the-tests"


@pytest.fixture
def calib(tmp_path: Path) -> Path:
    return make_boards(tmp_path)


@pytest.fixture
def client(calib: Path) -> Iterator[TestClient]:
    app = create_server(CalibrationView(Boards(calib, None, None)), TOKEN, PORT)
    with TestClient(app, base_url=f"http://127.0.0.1:{PORT}") as found:
        assert found.get(f"/?token={TOKEN}").status_code == 200
        yield found


def test_boards_residuals_and_coverage(client: TestClient, calib: Path) -> None:
    bend(calib.parent / "calibration/left/03.png")
    about = client.get("/api/calibration").json()
    assert [camera["name"] for camera in about["cameras"]] == ["left", "right"]
    found = {name: client.get("/api/board", params={"name": name}).json() for name in about["cameras"][0]["images"]}
    assert len(found) == 5
    assert all(
        board["reason"] == "" and len(board["residual"]) == len(board["pixels"]) == 40 for board in found.values()
    )
    rms = {name: board["rms"] for name, board in found.items()}
    assert rms["left/03.png"] > 4 * max(value for name, value in rms.items() if name != "left/03.png")
    assert [found[f"left/0{k}.png"]["off_plane"] for k in (0, 1)] == pytest.approx([0.0, 20.0], abs=1e-6)
    assert found["left/02.png"]["known"] is False
    coverage = client.get("/api/coverage", params={"camera": "left"}).json()
    cells = np.array(coverage["cells"])
    assert coverage["share"] == pytest.approx(cells.mean())
    assert not cells[0].any()
    assert cells[4, 4]


def test_images_are_shown_as_they_are(client: TestClient) -> None:
    answer = client.get("/api/image", params={"name": "left/00.png"})
    assert answer.headers["content-type"] == "image/jpeg"
    assert simplejpeg.decode_jpeg(answer.content, "GRAY").shape == (SIZE[1], SIZE[0], 1)


def test_nothing_outside_the_folder_is_read(client: TestClient, calib: Path) -> None:
    shutil.copy(calib.parent / "calibration/left/00.png", calib.parent / "secret.png")
    for name in (
        "../secret.png",
        "left/../../secret.png",
        str(calib.parent / "secret.png"),
        "left/no.png",
        "",
        "left\0",
    ):
        for call in ("board", "image"):
            assert client.get(f"/api/{call}", params={"name": name}).status_code == 422, name
    assert client.get("/api/coverage", params={"camera": "../left"}).status_code == 422
    (calib.parent / "calibration/left/linked.png").symlink_to(calib.parent / "secret.png")
    assert "left/linked.png" not in Boards(calib, None, None).paths


def test_requests_without_the_token_are_refused(client: TestClient) -> None:
    fresh = TestClient(client.app, base_url=f"http://127.0.0.1:{PORT}", follow_redirects=False)
    for call in ("calibration", "board?name=left/00.png", "image?name=left/00.png", "coverage?camera=left"):
        assert fresh.get(f"/api/{call}").status_code == 403
        assert client.get(f"/api/{call}", headers={"origin": "http://evil.example"}).status_code == 403
        assert client.get(f"/api/{call}").status_code == 200


def test_page_holds_no_foreign_code(client: TestClient) -> None:
    assert "http:" not in client.get("/").text
    for script in ("frame", *(f"calibration/{name}" for name in ("main", "board_view", "panels"))):
        code = client.get(f"/static/{script}.js")
        assert code.status_code == 200
        assert "innerHTML" not in code.text
        assert "http" not in code.text


def test_grid_of_a_pinhole_lies_on_its_plane() -> None:
    """A camera 0.5 m from the plane y = 0 that looks along y: 10 mm are 20 px."""
    plane = RIG.cameras["left"].plane
    camera = PinholeCamera(
        image_size=(640, 480), rotation_vector=RIG.cameras["left"].rotation_vector, focal=(1000.0, 1000.0),
        centre=(319.5, 239.5), translation=(0.0, 0.0, 0.5), plane=plane,
    )  # fmt: skip
    grid = plane_grid(camera)
    assert grid.spacing == pytest.approx(0.05)
    upright = {value: path for axis, value, path in grid.lines if axis == "x"}
    np.testing.assert_allclose(upright[0.05][:, 0] - upright[0.0][:, 0], 100.0, atol=0.01)
    np.testing.assert_allclose(grid.axes["x"][0], (319.5, 239.5), atol=1e-6)
    behind = plane_grid(replace(camera, translation=(0.0, 0.0, -0.5)))
    assert (behind.axes, behind.lines) == ({}, ())


def test_source_is_recorded_only_below_the_file(tmp_path: Path, calib: Path) -> None:
    source = read_board_source(calib)
    assert source is not None
    assert source.images == calib.parent / "calibration"
    (tmp_path / "deep").mkdir()
    write_calibration(tmp_path / "deep/calib.yaml", RIG, source)
    assert read_board_source(tmp_path / "deep/calib.yaml") is None
    write_calibration(tmp_path / "bare.yaml", RIG)
    assert "calibrated_from" not in (tmp_path / "bare.yaml").read_text()


def test_command_refuses_what_it_cannot_show(tmp_path: Path, calib: Path, run: Run) -> None:
    text = calib.read_text()
    assert_refused(run("rafl-review", "no.yaml"), "no.yaml", "check the path")
    assert_refused(run("rafl-review", calib, "--videos", "."), "--videos", "expected a folder of tracks")
    assert_refused(run("rafl-review", calib, "--images", "nowhere"), "nowhere", "a folder of board images")
    (tmp_path / "tracks").mkdir()
    assert_refused(run("rafl-review", "tracks", "--images", "."), "--images", "calib.yaml")
    for images in ("../elsewhere", "/etc", "a\\..\\b"):
        calib.write_text(text.replace("images: calibration,", f"images: '{images}',"))
        assert_refused(run("rafl-review", calib), "calibrated_from.images", "in the same folder")
    (tmp_path / "link").symlink_to("/etc")
    calib.write_text(text.replace("images: calibration,", "images: link,"))
    assert_refused(run("rafl-review", calib), "link", "elsewhere")
    calib.write_text(text.replace("images: calibration,", "images: gone,"))
    assert_refused(run("rafl-review", calib), "gone", "--images")
    write_calibration(calib, RIG)
    assert_refused(run("rafl-review", calib), "does not say where its board images are", "--images")
    (tmp_path / "calibration/left").rename(tmp_path / "calibration/top")
    assert_refused(run("rafl-review", calib, "--images", "calibration"), "expected images of left, right", "top")
