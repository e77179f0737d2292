"""The calls by which a specimen is described: sizes from corners, places, and what is written."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient
from stills import SIDES, SIZE_MM, STILL_RIG, corner_pixels, still_tracks

from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import Rig
from rafl.capture.specimen.specimen import read_specimen
from rafl.common.errors import InputError
from rafl.review.server import create_server
from rafl.review.specimen.corners import measure_body
from rafl.review.tracks.calls import TracksView
from rafl.review.tracks.recordings import Library
from rafl.tracking.reconstruction.tracks import write_tracks

PORT, TOKEN = 4321, "token-of-the-tests"
NAME = {"name": "still"}
FORM = {"size_mm": list(SIZE_MM)}


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    write_tracks(tmp_path / "tracks/still.h5", still_tracks())
    view = TracksView(Library(tmp_path / "tracks", None, "Ann"), tmp_path)
    with TestClient(create_server(view, TOKEN, PORT), base_url=f"http://127.0.0.1:{PORT}") as found:
        assert found.get(f"/?token={TOKEN}").status_code == 200
        yield found


def test_corners_give_the_size(client: TestClient) -> None:
    """The box sags by 13 mm; its length is that along the body, within 0.3 mm."""
    pixels = {
        camera: np.random.default_rng(3).permutation(corner_pixels(camera)).tolist() for camera in STILL_RIG.cameras
    }
    found = client.post("/api/specimen/corners", params=NAME, json=pixels).json()
    assert found["size_mm"] == pytest.approx(SIZE_MM, abs=0.3)
    assert found["remarks"] == []
    assert len(found["outline"]["left"]) == 12
    np.testing.assert_allclose(
        found["outline"]["left"][0][0], STILL_RIG.cameras["left"].project(np.zeros(3)), atol=0.01
    )


def test_a_world_that_is_not_the_specimens_frame_is_told() -> None:
    moved = corner_pixels("left") + 60.0
    (remark,) = measure_body(STILL_RIG, {"left": moved}).remarks
    assert "17.0 mm from the world's origin" in remark


def test_a_camera_above_tells_the_width() -> None:
    """It films the upper face, 100 mm x 20 mm, of a body that lies; the height stays unknown."""
    above = OrthographicCamera(
        image_size=(640, 240), scale=(5000.0, 5000.0), offset=(70.0, 170.0), rotation_vector=(np.pi, 0.0, 0.0),
        plane=Plane((0.0, 0.0, 1.0), 0.02, 5e-4),
    )  # fmt: skip
    ends = np.array([(x, y, 0.02) for x in (0.0, 0.1) for y in (0.0, 0.02)])
    found = measure_body(Rig({"above": above}), {"above": above.project(ends)})
    assert found.size_mm == (100.0, 20.0, None)
    assert found.remarks == ("the corners do not tell the height: measure and type it",)
    tip = replace(above, plane=Plane((1.0, 0.0, 0.0), 0.1, 5e-4))
    with pytest.raises(InputError, match="films an end of the body"):
        measure_body(Rig({"tip": tip}), {"tip": above.project(ends)})


@pytest.mark.parametrize(
    ("pixels", "part"),
    [
        ({}, "found none"),
        ({"left": [[1, 2], [3, 4]]}, "found 2"),
        ({"left": [[1, 2]] * 4}, "corners at the clamp and at the tip"),
        ({"top": [[1, 2]] * 4}, "'top'"),
        ({"left": [[1e9, 2]] * 4}, "less than or equal"),
        ({"left": [["NaN", 2]] * 4}, ""),
    ],
)
def test_corners_that_tell_no_size_are_refused(client: TestClient, pixels: dict[str, object], part: str) -> None:
    answer = client.post("/api/specimen/corners", params=NAME, json=pixels)
    assert answer.status_code == 422
    assert part in answer.json()["error"]


def test_what_is_written_is_what_rafl_specimen_writes(client: TestClient, tmp_path: Path, run) -> None:  # type: ignore[no-untyped-def]
    found = client.post("/api/specimen/describe", params=NAME, json=FORM).json()
    assert found["dots"][0]["name"] == "L1"
    assert len(found["dots"]) == len(SIDES)
    assert len(found["outline"]["right"]) == 12
    body = {"key": found["key"], "file": "beam"}
    answer = client.post("/api/specimen/write", params=NAME, json=body).json()
    assert answer == {"written": True, "there": [], "file": str(tmp_path / "beam.yaml")}
    (tmp_path / "other").mkdir()
    result = run("rafl-specimen", "tracks/still.h5", "--box", "100x20x20", "--out", "other/beam.yaml")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "beam.yaml").read_text() == (tmp_path / "other/beam.yaml").read_text()
    assert (tmp_path / "beam.png").stat().st_size > 5000
    specimen = read_specimen(tmp_path / "beam.yaml")
    assert np.abs(1e3 * specimen.layout.positions - SIDES).max() < 0.5


def test_no_file_is_replaced_without_asking(client: TestClient, tmp_path: Path) -> None:
    key = client.post("/api/specimen/describe", params=NAME, json=FORM).json()["key"]
    (tmp_path / "beam.yaml").write_text("mine")
    answer = client.post("/api/specimen/write", params=NAME, json={"key": key, "file": "beam"}).json()
    assert (answer["written"], answer["there"]) == (False, ["beam.yaml"])
    assert (tmp_path / "beam.yaml").read_text() == "mine"
    assert not (tmp_path / "beam.png").exists()
    body = {"key": key, "file": "beam", "replace_files": True}
    assert client.post("/api/specimen/write", params=NAME, json=body).json()["written"]
    assert read_specimen(tmp_path / "beam.yaml").name == "beam"
    for file in ("../beam", "a/b", "", "..", "a\0b", "x" * 300):
        answer = client.post("/api/specimen/write", params=NAME, json={"key": key, "file": file})
        assert answer.status_code == 422, file
    assert {path.name for path in tmp_path.iterdir()} == {"tracks", "beam.yaml", "beam.png"}
    other = client.post("/api/specimen/write", params=NAME, json={"key": key + 1, "file": "other"})
    assert "an older one" in other.json()["error"]


def test_a_dot_that_is_none_is_left_out(client: TestClient) -> None:
    first = client.post("/api/specimen/describe", params=NAME, json=FORM).json()["dots"][0]["track"]
    found = client.post("/api/specimen/describe", params=NAME, json=FORM | {"left_out": [first]}).json()
    assert first not in {dot["track"] for dot in found["dots"]}
    assert len(found["dots"]) == len(SIDES) - 1


@pytest.mark.parametrize(
    ("form", "part"),
    [
        ({"size_mm": [100, 60, 20]}, "the size of the body is wrong"),
        ({"size_mm": [100, 0, 20]}, "greater than 0"),
        ({"size_mm": [100, 20]}, "size_mm"),
        ({"size_mm": [1e5, 1e5, 1e-3]}, "at most 5000 elements"),
        (FORM | {"left_out": ["nobody"]}, "'nobody'"),
        (FORM | {"surface": "/etc/passwd"}, "surface"),
        (FORM | {"lying": True}, "leave out --lying"),
    ],
)
def test_bodies_that_do_not_fit_are_refused(client: TestClient, form: dict[str, object], part: str) -> None:
    answer = client.post("/api/specimen/describe", params=NAME, json=form)
    assert answer.status_code == 422, answer.text
    assert part in answer.json()["error"] or part == "size_mm"


def test_requests_without_the_token_are_refused(client: TestClient) -> None:
    fresh = TestClient(client.app, base_url=f"http://127.0.0.1:{PORT}", follow_redirects=False)
    for call in ("corners", "describe", "write"):
        assert fresh.post(f"/api/specimen/{call}", params=NAME, json={}).status_code == 403
        headers = {"origin": "http://evil.example"}
        assert client.post(f"/api/specimen/{call}", params=NAME, headers=headers, json={}).status_code == 403
        assert client.post(f"/api/specimen/{call}", params={"name": "../still"}, json=FORM).status_code == 422
