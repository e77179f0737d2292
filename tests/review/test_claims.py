"""Who may correct a recording, and corrections that were made on other tracks."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from filmed import Film
from starlette.testclient import TestClient

from rafl.common.errors import InputError
from rafl.review.tracks.recordings import Library
from rafl.tracking.reconstruction.corrected_tracks import read_corrected_tracks, tracks_digest
from rafl.tracking.reconstruction.corrections import corrections_path, read_corrections
from rafl.tracking.reconstruction.tracks import read_tracks, write_tracks

NAME = {"name": "swing"}
PAGE, TWO = NAME | {"page": "one"}, NAME | {"page": "two"}


def act(client: TestClient, **action: object) -> dict[str, object]:
    answer = client.post("/api/correct", params=PAGE, json=action)
    assert answer.status_code == 200, answer.text
    return answer.json()  # type: ignore[no-any-return]


def refused(client: TestClient, **action: object) -> str:
    answer = client.post("/api/correct", params=PAGE, json=action)
    assert answer.status_code == 422, answer.text
    return str(answer.json()["error"])


def test_a_second_page_takes_over(client: TestClient) -> None:
    assert client.post("/api/claim", params=PAGE).json()["writable"]
    assert not client.post("/api/claim", params=TWO).json()["writable"]
    assert client.post("/api/claim", params=TWO | {"take": True}).json()["writable"]
    assert not client.post("/api/claim", params=PAGE).json()["writable"]
    answer = client.post("/api/correct", params=PAGE, json={"kind": "undo"})
    assert answer.status_code == 409
    assert "take it over" in answer.json()["error"]
    client.post("/api/release", params=PAGE)
    assert client.post("/api/correct", params=TWO, json={"kind": "undo"}).status_code == 200


def test_corrections_of_other_tracks_are_named_and_kept_or_taken_out(client: TestClient, film: Film) -> None:
    """The tracks are made anew, with one marker a little elsewhere in one frame."""
    act(client, kind="swap", camera="left", marker="A1", other="B1", row=40)
    x, y = film.tracks.pixel["left"][10, 12].tolist()
    act(client, kind="place", camera="left", marker="C3", row=10, x=x, y=y)
    act(client, kind="accept", camera="left", marker="A2", row=3, last_row=5)
    path = corrections_path(film.path)
    digest = tracks_digest(read_tracks(film.path))
    assert {entry.tracks for entry in read_corrections(path)} == {digest}
    assert read_corrected_tracks(film.path).doubtful == ()
    other = read_tracks(film.path)
    other.pixel["left"][2, 3] += 0.5
    write_tracks(film.path, other)
    found = read_corrected_tracks(film.path)
    assert [line[:20] for line in found.doubtful] == ["correction 1 (swap, ", "correction 3 (accept"]
    assert found.unfit == ()
    assert set(found.doubtful) <= set(found.tracks.notes)
    state = client.get("/api/recording", params=NAME).json()
    assert [entry["doubtful"] for entry in state["corrections"]] == [True, False, True]
    assert "other tracks" in refused(client, kind="keep", entry=1)
    assert "other tracks" in refused(client, kind="drop", entry=7)
    after = act(client, kind="keep", entry=0)
    assert [entry["doubtful"] for entry in after["corrections"]] == [False, False, True]  # type: ignore[attr-defined]
    after = act(client, kind="drop", entry=2)
    assert [entry["kind"] for entry in after["corrections"]] == ["swap", "place"]  # type: ignore[attr-defined]
    assert read_corrected_tracks(film.path).doubtful == ()


def test_another_calibration_leaves_corrections_as_they_are(client: TestClient, film: Film) -> None:
    act(client, kind="swap", camera="left", marker="A1", other="B1", row=40)
    tracks = read_tracks(film.path)
    object.__setattr__(tracks, "calibration", tracks.calibration.replace("residual_px: 0.05", "residual_px: 0.06"))
    write_tracks(film.path, tracks)
    assert read_corrected_tracks(film.path).doubtful == ()


def test_a_position_by_hand_lies_in_the_image(client: TestClient, film: Film) -> None:
    for x, y in ((-30.0, 10.0), (10.0, 400.0), (430.0, 10.0), (1e5, -1e5)):
        text = refused(client, kind="place", camera="left", marker="C3", row=10, x=x, y=y, hand=True)
        assert "expected a position in the image of 400 x 320 px" in text
    act(client, kind="place", camera="left", marker="C3", row=10, x=-5.0, y=324.0, hand=True)


def test_frames_that_are_not_there_are_not_called_damaged(client: TestClient) -> None:
    for number in (-1, 80, 10**9):
        answer = client.get("/api/frame", params=NAME | {"camera": "left", "number": number})
        assert answer.status_code == 404
        assert answer.json()["error"] == f"the tracks have no frame {number} of camera left"


def test_a_reason_with_a_colon_is_whole(client: TestClient) -> None:
    text = refused(client, kind="rename", camera="left", marker="A1", other="B1")
    assert text == "there is a marker B1 already"
    text = refused(client, kind="swap", camera="left", marker="A1", other="a: b")
    assert text == "the tracks have no marker a: b"


def test_a_folder_that_cannot_be_written_is_told_at_opening(
    client: TestClient, film: Film, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert client.get("/api/recording", params=NAME).json()["locked"] == ""

    def refuse(path: Path) -> None:
        raise InputError(f"{path}: expected to be able to write there, found: Read-only file system; free or allow it")

    monkeypatch.setattr("rafl.review.tracks.recording.require_writable", refuse)
    shutil.copy(film.path, film.path.with_name("other.h5"))
    assert "Read-only file system" in client.get("/api/recording", params={"name": "other"}).json()["locked"]


def test_five_recordings_that_pages_use_stay_open(film: Film, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"take{number}" for number in range(5)]
    for name in names:
        shutil.copy(film.path, film.path.with_name(f"{name}.h5"))
    library = Library(film.path.parent, None, "Ann")
    first = [library.open(name) for name in names]
    assert [library.open(name) for name in names] == first
    later = np.inf
    monkeypatch.setattr("rafl.review.tracks.recordings.time.monotonic", lambda: later)
    library.open("swing")
    assert len(library.opened) == 3
    library.close()


def test_page_tells_of_them(client: TestClient) -> None:
    text = client.get("/").text
    for word in ("measured", "filled", "missing, expected here", "corrected", "selected"):
        assert re.search(rf'class="key".*{word}', text, re.DOTALL)
