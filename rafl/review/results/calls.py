"""The calls of the page of results, which read one evaluation or one dataset."""

from pathlib import Path

from fastapi import FastAPI, Response

from rafl.common.errors import InputError
from rafl.data.dataset_file import read_dataset
from rafl.evaluation.evaluation_file import EVALUATION_FILE, read_evaluation
from rafl.evaluation.page_data import PageData, pack_motion
from rafl.evaluation.page_file import PAGE, page_file


class ResultsView:
    """The view of an evaluation or of a dataset; see `View`."""

    page = PAGE

    def __init__(self, data: PageData, path: Path) -> None:
        self.data = data
        self.title = f"{len(data.recordings)} recordings in {path}"

    @classmethod
    def of_run(cls, folder: Path) -> "ResultsView":
        """The evaluation in a run folder.

        Raises:
            InputError: the folder has none, or it cannot be read.
        """
        path = folder / EVALUATION_FILE
        if not path.exists():
            raise InputError(
                f"expected an evaluation ({EVALUATION_FILE}) in {folder}, found none; simulate the recordings first: "
                f"rafl-eval {folder} DATASET.h5"
            )
        data = PageData.of_evaluation(read_evaluation(path), f"Evaluation {folder.resolve().name}")
        return cls(data, folder)

    @classmethod
    def of_dataset(cls, path: Path) -> "ResultsView":
        """The recordings of a dataset file.

        Raises:
            InputError: it cannot be read.
        """
        return cls(PageData.of_dataset(read_dataset(path)), path)

    def add_calls(self, app: FastAPI) -> None:
        """Add the calls; none of them changes anything."""

        @app.get("/api/summary")
        def summary() -> dict[str, object]:
            return self.data.summary()

        @app.get("/api/motion")
        def motion(number: int) -> Response:
            if not 0 <= number < len(self.data.recordings):
                raise InputError("expected a recording of this page, found another; load the page again")
            return Response(pack_motion(self.data.recordings[number]), media_type="application/octet-stream")

        @app.get("/api/file")
        def file() -> Response:
            return Response(page_file(self.data), media_type="text/html; charset=utf-8")

    def close(self) -> None:
        """Nothing is open."""
