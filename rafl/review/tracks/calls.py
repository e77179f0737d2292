"""The calls of the page of tracks, each of which reads or corrects one recording."""

from pathlib import Path
from typing import Annotated

from fastapi import Body, FastAPI, Response
from fastapi.responses import JSONResponse

from rafl.common.errors import InputError
from rafl.review.specimen.calls import ShownTracks, add_specimen_calls
from rafl.review.tracks.blocks import block, series
from rafl.review.tracks.edits import Action, perform
from rafl.review.tracks.recording import OpenRecording
from rafl.review.tracks.recordings import Library
from rafl.review.tracks.stretches import find_stretches
from rafl.tracking.reconstruction.corrected_tracks import is_doubtful

MAX_SUMMARIES = 50  # of one call
NO_VIDEO = 404


class TracksView:
    """The view of a folder of tracks; see `View`.

    Args:
        library: the folder.
        specimens: folder to which specimens that are described on the page are written.
    """

    page = "tracks/tracks.html"

    def __init__(self, library: Library, specimens: Path = Path()) -> None:
        self.library, self.specimens = library, specimens
        self.title = f"{len(library.names())} recordings in {library.folder}"

    def add_calls(self, app: FastAPI) -> None:
        """Add the calls that read and those that correct."""
        _add_reading_calls(app, self.library)
        _add_correcting_calls(app, self.library)
        add_specimen_calls(app, self._tracks_of, self.specimens)

    def _tracks_of(self, name: str) -> ShownTracks:
        recording = self.library.open(name)
        return ShownTracks(recording.path, recording.found, recording.rig)

    def close(self) -> None:
        """Close all videos."""
        self.library.close()


def _state(recording: OpenRecording) -> dict[str, object]:
    """What changes with a correction."""
    entries = [
        entry.model_dump(mode="json", exclude={"path", "tracks"})
        | ({"frames": len(entry.positions)} if entry.kind == "place" else {})
        | {"doubtful": is_doubtful(entry, recording.found.digest)}
        for entry in recording.corrections
    ]
    return {
        "revision": recording.revision,
        "names": recording.tracks.names,
        "corrections": entries,
        "unfit": recording.found.unfit,
        "doubtful": recording.found.doubtful,
        "redo": len(recording.undone),
    }


def _add_reading_calls(app: FastAPI, library: Library) -> None:
    @app.get("/api/recordings")
    def recordings() -> dict[str, object]:
        names = library.names()
        return {
            "folder": library.folder.resolve().name,
            "recordings": [{"name": name, "corrected": library.has_corrections(name)} for name in names],
        }

    @app.post("/api/summaries")
    def summaries(names: Annotated[list[str], Body(max_length=MAX_SUMMARIES)]) -> dict[str, object]:
        found: dict[str, object] = {}
        for name in names:
            try:
                found[name] = library.summary(name)
            except InputError as error:
                found[name] = {"error": str(error)}
        return found

    @app.get("/api/recording")
    def recording(name: str) -> dict[str, object]:
        found = library.open(name, anew=True)
        rig = found.rig
        tracks = found.raw
        return _state(found) | {
            "name": name,
            "rows": len(tracks.time),
            "fps": tracks.fps,
            "notes": tracks.notes,
            "has_calibration": rig is not None,
            "cameras": [
                {"name": camera, "size": rig.cameras[camera].image_size if rig and camera in rig.cameras else None}
                for camera in tracks.pixel
            ],
            "corrections_file": found.beside.name,
            "locked": found.locked,
        }

    @app.get("/api/block")
    def rows(name: str, first: int, count: int) -> Response:
        found = library.open(name)
        return Response(block(found, found.rig, first, count), media_type="application/octet-stream")

    @app.get("/api/series")
    def values(name: str, marker: int, camera: str) -> Response:
        return Response(series(library.open(name), marker, camera), media_type="application/octet-stream")

    @app.get("/api/stretches")
    def stretches(name: str) -> list[dict[str, object]]:
        return [vars(item) for item in find_stretches(library.open(name).found)]

    @app.get("/api/frame")
    def frame(name: str, camera: str, number: int) -> Response:
        try:
            recording = library.open(name)
            store = recording.frames(camera)
            if number not in recording.raw.frame[camera]:
                return JSONResponse({"error": f"the tracks have no frame {number} of camera {camera}"}, NO_VIDEO)
            content = store.jpeg(number)
        except InputError as error:
            return JSONResponse({"error": str(error)}, NO_VIDEO)
        if content is None:
            return JSONResponse({"error": f"frame {number} of camera {camera} is damaged"}, NO_VIDEO)
        return Response(content, media_type="image/jpeg")


def _add_correcting_calls(app: FastAPI, library: Library) -> None:
    @app.post("/api/claim")
    def claim(name: str, page: str, take: bool = False) -> dict[str, object]:
        found = library.open(name)
        if take:
            found.take_over(page)
        return {"writable": found.claim_for(page), "revision": found.revision}

    @app.post("/api/release")
    def release(name: str, page: str) -> None:
        library.open(name).release(page)

    @app.post("/api/correct")
    def correct(name: str, page: str, action: Action) -> dict[str, object]:
        found = library.open(name)
        with found.editing:
            return perform(found, page, action) | _state(found)
