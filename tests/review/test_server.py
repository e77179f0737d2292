"""The server's calls without a browser: frames, corrections, and who is refused."""

import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import simplejpeg
from filmed import Film, read_counter
from starlette.testclient import TestClient

from rafl.review.server import create_server
from rafl.review.tracks.calls import TracksView
from rafl.review.tracks.recordings import Library
from rafl.tracking.reconstruction.corrected_tracks import read_corrected_tracks
from rafl.tracking.reconstruction.corrections import corrections_path, read_corrections
from rafl.tracking.reconstruction.tracks import read_tracks, write_tracks

PORT, TOKEN = 4321, "token-of-the-tests"
NAME = {"name": "swing"}
PAGE = NAME | {"page": "one"}


def correct(client: TestClient, **action: object) -> dict[str, object]:
    answer = client.post("/api/correct", params=PAGE, json=action)
    assert answer.status_code == 200, answer.text
    return answer.json()  # type: ignore[no-any-return]


def refused(client: TestClient, **action: object) -> str:
    answer = client.post("/api/correct", params=PAGE, json=action)
    assert answer.status_code == 422, answer.text
    return str(answer.json().get("error"))


def corrected(film: Film) -> np.ndarray:
    return read_corrected_tracks(film.path).tracks.position


def test_frames_are_those_asked_for(client: TestClient) -> None:
    for number in (0, 1, 79, 42, 41, 40, 39, 7):
        for camera in ("left", "right"):
            answer = client.get("/api/frame", params=NAME | {"camera": camera, "number": number})
            assert answer.headers["content-type"] == "image/jpeg"
            assert read_counter(simplejpeg.decode_jpeg(answer.content, "GRAY")[..., 0]) == number
    answer = client.get("/api/frame", params=NAME | {"camera": "left", "number": 80})
    assert answer.status_code == 404


def test_rows_hold_what_the_tracks_hold(client: TestClient, film: Film) -> None:
    about = client.get("/api/recording", params=NAME).json()
    assert (about["rows"], about["names"][0], about["has_calibration"]) == (80, "A1", True)
    tracks, markers = read_tracks(film.path), len(about["names"])
    values = np.frombuffer(client.get("/api/block", params=NAME | {"first": 30, "count": 9}).content, "<f4")
    np.testing.assert_allclose(values[:9], tracks.time[30:39], rtol=1e-6)
    start = 9 + 2 * 9 * markers
    position = values[start : start + 27 * markers].reshape(9, markers, 3)
    np.testing.assert_allclose(position, 1e3 * tracks.position[30:39], rtol=1e-6)
    assert len(values) == 9 + 8 * 9 * markers + 2 * (2 * 9 + 6 * 9 * markers)
    path = np.frombuffer(client.get("/api/series", params=NAME | {"marker": 3, "camera": "left"}).content, "<f4")
    np.testing.assert_allclose(path[:80], 1e3 * tracks.position[:, 3, 0], rtol=1e-6)
    assert client.get("/api/block", params=NAME | {"first": 80, "count": 9}).status_code == 422
    assert client.get("/api/series", params=NAME | {"marker": 99, "camera": "left"}).status_code == 422


def test_list_and_summaries(client: TestClient, film: Film) -> None:
    (film.path.parent / "broken.h5").write_bytes(b"no HDF5")
    (film.path.parent / "outside.h5").symlink_to("/etc/hostname")
    found = client.get("/api/recordings").json()["recordings"]
    assert found == [{"name": "broken", "corrected": False}, {"name": "swing", "corrected": False}]
    summary = client.post("/api/summaries", json=["swing", "broken", "nothing"]).json()
    assert (summary["swing"]["frames"], summary["swing"]["markers"], summary["swing"]["cameras"]) == (80, 15, 2)
    assert "broken.h5" in summary["broken"]["error"]
    assert "error" in summary["nothing"]


def test_speed_on_a_film_of_ten_thousand_frames(client: TestClient, film: Film) -> None:
    """Every correction, on markers of which all 10,000 rows are drawn; the limits leave room for a busy machine."""
    tracks, rows = film.tracks, np.arange(10_000)
    random = np.random.default_rng(1)
    periods = {key: getattr(tracks, key)[rows % 40 + 30] for key in ("position", "sigma", "state")}
    cameras = {
        key: {camera: values[rows % 40 + 30] for camera, values in getattr(tracks, key).items()}
        for key in ("pixel", "pixel_sigma", "residual", "damaged", "lag")
    }
    shown = {camera: rows for camera in tracks.pixel}
    long = replace(tracks, time=rows / 50.0, frame=shown, **periods, **cameras)
    write_tracks(film.path.parent / "long.h5", long)
    times = {}
    for number in range(20):
        row, marker = int(random.integers(100, 9900)), int(random.integers(0, 9))
        actions = {
            "hand": {"kind": "place", "x": 100.0, "y": 90.0, "hand": True},
            "delete": {"kind": "delete", "last_row": row + 3, "all_cameras": True},
            "accept": {"kind": "accept", "last_row": row + 3},
            "undo": {"kind": "undo"},
        }
        what = list(actions)[number % 4]
        action = {"camera": "left", "marker": tracks.names[marker], "row": row} | actions[what]
        start = time.perf_counter()
        answer = client.post("/api/correct", params={"name": "long", "page": "one"}, json=action)
        times[f"{number} {what}"] = time.perf_counter() - start
        assert answer.status_code == 200, answer.text
    print({key: f"{1e3 * value:.0f} ms" for key, value in times.items()})
    assert max(times.values()) < 2.0
    assert np.median(list(times.values())) < 0.5
    start = time.perf_counter()
    assert client.get("/api/frame", params=NAME | {"camera": "left", "number": 70}).status_code == 200
    assert time.perf_counter() - start < 1.0


def test_corrections_one_by_one_and_at_once_agree(client: TestClient, film: Film) -> None:
    """What the page computes after each correction, also after taking some back, is what reading the file gives."""
    correct(client, kind="swap", camera="left", marker="A1", other="B1", row=40)
    correct(client, kind="delete", camera="left", marker="C2", row=3, last_row=6, all_cameras=True)
    correct(client, kind="delete", camera="left", marker="C2", row=3, last_row=6)
    correct(client, kind="place", camera="left", marker="C2", row=5, x=101.0, y=222.0, hand=True, sigma=9.0)
    for kind in ("undo", "undo", "undo", "redo", "redo"):
        correct(client, kind=kind)
    found = read_corrected_tracks(film.path).tracks
    values = np.frombuffer(client.get("/api/block", params=NAME | {"first": 0, "count": 80}).content, "<f4")
    markers = len(found.names)
    np.testing.assert_array_equal(values[80 : 80 + 80 * markers].reshape(80, markers), found.state)
    position = values[80 + 160 * markers : 80 + 400 * markers].reshape(80, markers, 3)
    np.testing.assert_allclose(position, 1e3 * found.position, atol=1e-4)


def test_worst_stretches_come_first_and_accepted_ones_are_reviewed(client: TestClient) -> None:
    found = client.get("/api/stretches", params=NAME).json()
    first = found[0]
    assert (first["kind"], first["marker"], first["other"], first["camera"]) == ("jump", 0, 5, "left")
    assert (first["first"], first["last"]) == (39, 40)
    assert {item["kind"] for item in found[1:]} == {"missing"}
    correct(client, kind="accept", camera="left", marker="A1", row=found[0]["first"], last_row=found[0]["last"])
    again = client.get("/api/stretches", params=NAME).json()
    assert any(item["reviewed"] for item in again if item["marker"] == 0 and item["kind"] == "jump")


def test_swap_undo_redo(client: TestClient, film: Film) -> None:
    raw = film.path.read_bytes()
    answer = correct(client, kind="swap", camera="left", marker="A1", other="B1", row=40)
    assert answer["message"] == "A1 and B1 swapped from frame 40 of left on"
    np.testing.assert_allclose(corrected(film), film.tracks.position, atol=1e-9)
    correct(client, kind="undo")
    assert np.isnan(corrected(film)[40:, 0]).all()
    correct(client, kind="redo")
    np.testing.assert_allclose(corrected(film), film.tracks.position, atol=1e-9)
    assert film.path.read_bytes() == raw
    assert correct(client, kind="redo")["message"] == "nothing to make again"


def test_marker_is_fitted_to_the_dot_or_set_by_hand(client: TestClient, film: Film) -> None:
    truth = film.tracks.pixel["left"][10, 12]
    x, y = (truth + np.array([4.0, -3.0])).tolist()
    correct(client, kind="place", camera="left", marker="C3", row=10, x=x, y=y)
    found = read_corrected_tracks(film.path).tracks
    np.testing.assert_allclose(found.pixel["left"][10, 12], truth, atol=0.05)
    assert found.pixel_sigma["left"][10, 12].max() < 0.2
    correct(client, kind="place", camera="left", marker="C3", row=10, x=x, y=y, hand=True, sigma=2.0)
    found = read_corrected_tracks(film.path).tracks
    np.testing.assert_allclose(found.pixel["left"][10, 12], (x, y), atol=1e-3)
    np.testing.assert_allclose(found.pixel_sigma["left"][10, 12], 2.0)
    between = ((film.tracks.pixel["left"][10, 12] + film.tracks.pixel["left"][10, 6]) / 2).tolist()
    text = refused(client, kind="place", camera="left", marker="C3", row=10, x=between[0], y=between[1])
    assert "no dot" in text
    x, y = film.tracks.pixel["left"][10, 13].tolist()
    answer = correct(client, kind="place", camera="left", marker="C3", row=10, x=x, y=y)
    assert "C4 has this dot too" in str(answer["message"])


def test_lost_marker_is_added_and_followed(client: TestClient, film: Film) -> None:
    """C5 is deleted for good in the left camera from frame 30 on, put back at frame 32, and followed to the end."""
    column = film.tracks.names.index("C5")
    correct(client, kind="delete", camera="left", marker="C5", row=30, last_row=79)
    x, y = film.tracks.pixel["left"][32, column].tolist()
    correct(client, kind="place", camera="left", marker="C5", row=32, x=x, y=y)
    row, more = 32, True
    while more:
        answer = correct(client, kind="follow", camera="left", marker="C5", row=row)
        row, more = int(str(answer["row"])), bool(answer["more"])
    assert row == 79
    assert [entry["kind"] for entry in answer["corrections"]] == ["delete", "place", "place"]  # type: ignore[attr-defined]
    found = read_corrected_tracks(film.path).tracks
    assert np.abs(found.pixel["left"][32:, column] - film.tracks.pixel["left"][32:, column]).max() < 0.2
    correct(client, kind="undo")
    assert np.isfinite(read_corrected_tracks(film.path).tracks.pixel["left"][30:, column, 0]).sum() == 1


def test_new_marker_rename_and_delete_everywhere(client: TestClient, film: Film) -> None:
    x, y = film.tracks.pixel["left"][0, 3].tolist()
    correct(client, kind="place", camera="left", marker="<b>new", new=True, row=0, x=x, y=y)
    correct(client, kind="rename", camera="left", marker="A2", other="Tip")
    correct(client, kind="delete", camera="left", marker="C1", row=5, last_row=20, all_cameras=True)
    found = read_corrected_tracks(film.path).tracks
    assert found.names[-1] == "<b>new"
    assert found.names[1] == "Tip"
    assert (found.state[5:21, film.tracks.names.index("C1")] == 0).all()
    correct(client, kind="undo")
    assert (read_corrected_tracks(film.path).tracks.state[5:21, film.tracks.names.index("C1")] == 1).all()


@pytest.mark.parametrize(
    "action",
    [
        {"kind": "swap", "camera": "left", "marker": "A1", "other": "A1"},
        {"kind": "swap", "camera": "left", "marker": "A1", "other": "Z"},
        {"kind": "swap", "camera": "top", "marker": "A1", "other": "B1"},
        {"kind": "delete", "camera": "left", "marker": "Z", "row": 3, "last_row": 9},
        {"kind": "place", "camera": "left", "marker": "Z", "x": 3, "y": 4, "hand": True},
        {"kind": "place", "camera": "left", "marker": "a/b", "x": 3, "y": 4, "hand": True, "new": True},
        {"kind": "rename", "camera": "left", "marker": "A1", "other": "../x"},
        {"kind": "rename", "camera": "left", "marker": "A1", "other": "B1"},
        {"kind": "accept", "camera": "left", "marker": "A1", "row": 10**9},
        {"kind": "magic"},
        {"kind": "swap", "path": "/etc/passwd"},
    ],
)
def test_actions_that_do_not_fit_change_nothing(client: TestClient, film: Film, action: dict[str, object]) -> None:
    refused(client, **action)
    assert not (film.path.parent / "swing.corrections.yaml").exists()


def test_second_page_is_told_until_the_first_leaves(client: TestClient) -> None:
    two = NAME | {"page": "two"}
    assert client.post("/api/claim", params=PAGE).json()["writable"]
    assert not client.post("/api/claim", params=two).json()["writable"]
    answer = client.post("/api/correct", params=two, json={"kind": "undo"})
    assert answer.status_code == 409
    assert "another page" in answer.json()["error"]
    client.post("/api/release", params=two)
    assert not client.post("/api/claim", params=two).json()["writable"]
    client.post("/api/release", params=PAGE)
    assert client.post("/api/claim", params=two).json()["writable"]


def test_another_program_that_writes_the_file_is_noticed(client: TestClient, film: Film) -> None:
    correct(client, kind="accept", camera="left", marker="A1", row=3, last_row=5)
    path = film.path.parent / "swing.corrections.yaml"
    path.write_text(path.read_text().replace("Ann", "Bob"))
    assert "by another program" in refused(client, kind="undo")
    assert client.get("/api/recording", params=NAME).json()["corrections"][0]["by"] == "Bob"
    correct(client, kind="undo")


def test_corrections_are_taken_back_one_by_one_after_a_restart(client: TestClient, film: Film) -> None:
    for row in (3, 5, 7):
        correct(client, kind="accept", camera="left", marker="A1", row=row, last_row=row)
    path = corrections_path(film.path)
    assert len({entry.at for entry in read_corrections(path)}) == 3
    for left in (2, 1, 0):
        path.touch()
        Library(film.path.parent, None, "Ann").open("swing").undo()
        assert len(read_corrections(path) if path.exists() else ()) == left


def test_tracks_that_are_made_anew_are_noticed(client: TestClient, film: Film) -> None:
    correct(client, kind="accept", camera="left", marker="A1", row=3, last_row=5)
    os.utime(film.path, ns=(1, 1))
    assert "by another program" in refused(client, kind="undo")


def test_odd_requests_are_refused(client: TestClient, film: Film) -> None:
    assert "x" in refused(client, kind="place", camera="left", marker="A1", x="NaN")
    assert "camera" in refused(client, kind="delete", camera="nope", marker="A1", row=3)
    answer = client.post("/api/correct", params=PAGE, content=b"\xff\xfe", headers={"content-type": "application/json"})
    assert answer.status_code in (400, 422)


def test_a_damaged_file_leaves_the_others_in_the_list(client: TestClient, film: Film) -> None:
    damaged = film.path.with_name("flat.h5")
    shutil.copy(film.path, damaged)
    with h5py.File(damaged, "a") as file:
        del file["state"]
        file["state"] = np.zeros(5, np.uint8)
    found = client.post("/api/summaries", json=["flat", "swing"]).json()
    assert "state" in found["flat"]["error"]
    assert found["swing"]["frames"] == 80


def test_tracks_of_earlier_programs(client: TestClient, film: Film, tmp_path: Path) -> None:
    """They name no videos. `--videos` does, by name and content."""
    with h5py.File(film.path, "a") as file:
        for camera in ("left", "right"):
            del file[f"cameras/{camera}/lag"], file[f"cameras/{camera}"].attrs["video"]
        del file.attrs["longest_gap"]
    query = NAME | {"camera": "left", "number": 5}
    client.get("/api/recording", params=NAME)
    answer = client.get("/api/frame", params=query)
    assert answer.status_code == 404
    assert "--videos" in answer.json()["error"]
    shutil.move(film.folder / "videos", tmp_path / "moved")
    with TestClient(
        create_server(TracksView(Library(film.path.parent, tmp_path / "moved", "Ann")), TOKEN, PORT),
        base_url=f"http://127.0.0.1:{PORT}",
    ) as other:
        other.get(f"/?token={TOKEN}")
        assert other.get("/api/frame", params=query).status_code == 200
        shutil.copy(tmp_path / "moved/swing/left.mp4", tmp_path / "moved/swing/right.mp4")
        answer = other.get("/api/frame", params=query | {"camera": "right"})
        assert "is not the video of camera right" in answer.json()["error"]


def test_tracks_without_cameras_can_be_looked_at(client: TestClient, film: Film) -> None:
    tracks = read_tracks(film.path)
    object.__setattr__(tracks, "calibration", "")
    write_tracks(film.path, tracks)
    assert not client.get("/api/recording", params=NAME).json()["has_calibration"]
    assert client.get("/api/block", params=NAME | {"first": 0, "count": 5}).status_code == 200
    assert "expected the calibration" in refused(
        client, kind="place", camera="left", marker="A1", x=3, y=4, hand=True, row=3
    )


def test_requests_from_elsewhere_are_refused(client: TestClient, film: Film) -> None:
    fresh = TestClient(client.app, base_url=f"http://127.0.0.1:{PORT}", follow_redirects=False)
    for path in ("/", "/static/tracks/main.js", "/api/recordings", "/?token=wrong", "/api/recording?name=swing"):
        assert fresh.get(path).status_code == 403
    fresh.cookies.set(f"rafl-review-{PORT}", "wrong")
    assert fresh.get("/api/recordings").status_code == 403
    assert client.get("/api/recordings").status_code == 200
    for headers in (
        {"host": "evil.example"},
        {"host": f"evil.example:{PORT}"},
        {"host": "127.0.0.1:80"},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": f"http://127.0.0.1:{PORT + 1}"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ):
        assert client.get("/api/recordings", headers=headers).status_code == 403, headers
        answer = client.post("/api/correct", params=PAGE, headers=headers, json={"kind": "undo"})
        assert answer.status_code == 403, headers
    assert client.post("/api/correct", params=PAGE, content=b"x" * 200_000).status_code == 413
    same = {"origin": f"http://127.0.0.1:{PORT}", "sec-fetch-site": "same-origin"}
    assert client.get("/api/recordings", headers=same).status_code == 200


def test_nothing_outside_the_folder_is_read(client: TestClient, film: Film) -> None:
    secret = film.folder / "secret.h5"
    shutil.copy(film.path, secret)
    for name in ("../secret", "..%2fsecret", "/etc/passwd", str(secret.with_suffix("")), "swing\0", "", ".", ".."):
        for call in ("recording", "stretches"):
            assert client.get(f"/api/{call}", params={"name": name}).status_code == 422, name
        assert client.get("/api/frame", params={"name": name, "camera": "left", "number": 0}).status_code == 404
        assert client.post("/api/claim", params={"name": name, "page": "x"}).status_code == 422
    for path in ("/static/../server.py", "/static/..%2fserver.py", "/static/%2e%2e/server.py", "/static/uplot/LICENSE"):
        assert client.get(path).status_code in (403, 404), path
    assert client.get("/api/frame", params=NAME | {"camera": "../left", "number": 0}).status_code == 404


def test_every_answer_forbids_foreign_scripts(client: TestClient) -> None:
    for path in ("/", "/static/tracks/main.js", "/api/recordings", "/nothing"):
        headers = client.get(path).headers
        assert "default-src 'none'; script-src 'self'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
    text = client.get("/").text
    assert "http:" not in text
    assert "https:" not in text
    for script in (
        "api",
        "frame",
        *(
            f"tracks/{name}"
            for name in ("main", "view", "plots", "list", "panels", "recording", "corrector", "keyboard")
        ),
    ):
        answer = client.get(f"/static/{script}.js")
        assert answer.status_code == 200
        code = answer.text
        assert "innerHTML" not in code
        assert "http" not in code
    assert json.loads(client.get("/api/recordings").text)
