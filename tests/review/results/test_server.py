"""The server of the page of results, and which view a path gets."""

import shutil
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from evaluated import make_evaluation
from filmed import Film
from served import Served
from starlette.testclient import TestClient

import rafl
from rafl.common.errors import InputError
from rafl.data.synthetic import release_dataset
from rafl.evaluation.evaluation_file import write_evaluation
from rafl.evaluation.page_data import pack_motion
from rafl.evaluation.page_file import static_text
from rafl.fem.mesh import HexMesh
from rafl.review.commands import open_view
from rafl.review.kinds import TRACKS, check_options
from rafl.review.results.calls import ResultsView
from rafl.review.server import create_server
from rafl.review.tracks.calls import TracksView

PORT, TOKEN = 4321, "token-of-the-tests"
MODULES = ["main", "source", "scene", "body", "labels", "orbit", "colours", "player", "plots", "tables", "keys", "save"]


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    write_evaluation(tmp_path / "run/evaluation.h5", make_evaluation())
    return tmp_path / "run"


@pytest.fixture
def client(run_folder: Path) -> Iterator[TestClient]:
    """A browser that has opened the address of a server on an evaluation."""
    app = create_server(ResultsView.of_run(run_folder), TOKEN, PORT)
    with TestClient(app, base_url=f"http://127.0.0.1:{PORT}") as found:
        assert found.get(f"/?token={TOKEN}").status_code == 200
        yield found


def test_calls_answer_with_what_the_page_shows(client: TestClient, run_folder: Path) -> None:
    data = ResultsView.of_run(run_folder).data
    summary = client.get("/api/summary").json()
    assert summary["title"] == "Evaluation run"
    assert [item["split"] for item in summary["recordings"]] == ["train", "val", "test"]
    assert client.get("/api/motion", params={"number": 1}).content == pack_motion(data.recordings[1])
    page = client.get("/api/file")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert 'id="motion-2"' in page.text
    for number in (-1, 3, "x"):
        answer = client.get("/api/motion", params={"number": number})
        assert answer.status_code == 422
        assert answer.json()["error"]


def test_page_is_served_under_the_strict_policy(client: TestClient) -> None:
    page = client.get("/")
    assert "script-src 'self'; style-src 'self'" in page.headers["content-security-policy"]
    assert " style=" not in page.text
    assert "<script>" not in page.text
    for name in MODULES:
        answer = client.get(f"/static/results/{name}.js")
        assert answer.status_code == 200
        assert answer.text == static_text(f"results/{name}.js")
        assert "innerHTML" not in answer.text
        assert "http" not in answer.text
    styles = ("page/page.css", "results/results.css")
    for name in ("three/three.module.min.js", "uplot/uPlot.esm.js", *styles, "icon.svg"):
        assert client.get(f"/static/{name}").status_code == 200
    for library in ("three", "uplot"):
        assert "MIT License" in static_text(f"{library}/LICENSE").replace("The MIT", "MIT")


def test_the_view_fits_the_path(run_folder: Path, film: Film, tmp_path: Path) -> None:
    mesh = HexMesh.box((2, 1, 1), (0.02, 0.01, 0.01))
    simulator = rafl.Simulator(mesh, rafl.Material(150e3, 0.4), mesh.face_nodes("x-min"), 0.01)
    dataset = release_dataset("beam", simulator, simulator, mesh.vertices[None], 3, {"a": "test"})
    rafl.write_dataset(tmp_path / "beam.h5", dataset)
    view = open_view(tmp_path / "beam.h5", None, "Ann")
    assert isinstance(view, ResultsView)
    assert view.data.tables == []
    assert "rafl-eval simulates" in view.data.note
    assert list(view.data.recordings[0].motions["body of the first frame"].vertices.shape) == [1, 12, 3]
    assert isinstance(open_view(run_folder, None, "Ann"), ResultsView)
    tracks = open_view(film.path.parent, None, "Ann")
    assert isinstance(tracks, TracksView)
    tracks.close()


def test_what_cannot_be_shown_is_refused(run_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "fitted").mkdir()
    (tmp_path / "fitted/model.pt").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    shutil.copy(run_folder / "evaluation.h5", tmp_path / "other.h5")
    for name, message in (
        ("fitted", r"rafl-eval .*fitted DATASET\.h5"),
        ("empty", r"expected tracks .* or an evaluated model"),
        ("other.h5", r"expected format rafl-dataset/4 .* found 'rafl-evaluation/1'"),
    ):
        with pytest.raises(InputError, match=message):
            open_view(tmp_path / name, None, "Ann")
    with pytest.raises(InputError, match="--videos: expected a folder of tracks"):
        check_options(run_folder, {"--videos": (tmp_path, TRACKS)})
    with (run_folder / "evaluation.h5").open("r+b") as file:
        file.truncate(3000)
    with pytest.raises(InputError, match=r"which cannot be read: .*run rafl-eval again"):
        open_view(run_folder, None, "Ann")


def test_command_shows_a_run(launch: Callable[[Path], Served], run_folder: Path) -> None:
    served = launch(run_folder)
    with urllib.request.build_opener(urllib.request.HTTPCookieProcessor()).open(served.address) as page:
        assert b"/static/results/main.js" in page.read()
    assert served.stop() == 0
