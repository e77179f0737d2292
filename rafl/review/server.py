"""The web server: its calls, each of which reads or corrects one recording."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.resources import files
from typing import Annotated, Any

from fastapi import Body, FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.types import ASGIApp

from rafl.calibration.rig import Rig, parse_calibration
from rafl.common.errors import InputError
from rafl.review.blocks import block, series
from rafl.review.edits import Action, perform
from rafl.review.recording import OpenRecording, ReadOnlyError
from rafl.review.recordings import Library
from rafl.review.security import Guard
from rafl.review.stretches import find_stretches

TYPES = {".svg": "image/svg+xml", ".html": "text/html; charset=utf-8", ".js": "text/javascript", ".css": "text/css"}
MAX_SUMMARIES = 50  # of one call
NO_VIDEO = 404


def create_server(library: Library, token: str, port: int, ready: Callable[[], Any] | None = None) -> ASGIApp:
    """The application, guarded.

    Args:
        library: the recordings.
        token: that the address must hold.
        port: of the server.
        ready: called once when the server is up.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        if ready is not None:
            ready()
        yield
        library.close()

    app = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    _add_static_files(app)
    _add_reading_calls(app, library)
    _add_correcting_calls(app, library)

    @app.exception_handler(InputError)
    async def refuse(request: Request, error: InputError) -> JSONResponse:
        return JSONResponse({"error": str(error)}, 422)

    @app.exception_handler(RequestValidationError)
    async def refuse_request(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        return JSONResponse({"error": f"{first['loc'][-1]}: {first['msg'][0].lower()}{first['msg'][1:]}"}, 422)

    @app.exception_handler(UnicodeDecodeError)
    async def refuse_text(request: Request, error: UnicodeDecodeError) -> JSONResponse:
        return JSONResponse({"error": "expected UTF-8"}, 422)

    @app.exception_handler(ReadOnlyError)
    async def refuse_second(request: Request, error: ReadOnlyError) -> JSONResponse:
        return JSONResponse({"error": str(error)}, 409)

    @app.exception_handler(OSError)
    async def refuse_file(request: Request, error: OSError) -> JSONResponse:
        return JSONResponse({"error": f"{error.filename or 'a file'}: {error.strerror or error}"}, 500)

    return Guard(app, token, port)


def _add_static_files(app: FastAPI) -> None:
    """Serve the files of the page, which are read once."""
    contents = {
        entry.name: entry.read_bytes()
        for folder in (files("rafl.review") / "static", files("rafl.review") / "static" / "uplot")
        for entry in folder.iterdir()
        if entry.is_file()
    }

    def answer(name: str) -> Response:
        suffix = name[name.rfind(".") :]
        if name not in contents or suffix not in TYPES:
            raise HTTPException(404)
        return Response(contents[name], media_type=TYPES[suffix])

    @app.get("/")
    def page() -> Response:
        return answer("index.html")

    @app.get("/static/{name}")
    def static(name: str) -> Response:
        return answer(name)


def _rig(recording: OpenRecording) -> Rig | None:
    """The cameras with which a recording was tracked; None if the tracks do not hold them."""
    try:
        return parse_calibration(recording.raw.calibration, recording.path) if recording.raw.calibration else None
    except InputError:
        return None


def _state(recording: OpenRecording) -> dict[str, object]:
    """What changes with a correction."""
    entries = [
        entry.model_dump(mode="json", exclude={"path"})
        | ({"frames": len(entry.positions)} if entry.kind == "place" else {})
        for entry in recording.corrections
    ]
    return {
        "revision": recording.revision,
        "names": recording.tracks.names,
        "corrections": entries,
        "unfit": recording.found.unfit,
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
        rig = _rig(found)
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
        }

    @app.get("/api/block")
    def rows(name: str, first: int, count: int) -> Response:
        found = library.open(name)
        return Response(block(found, _rig(found), first, count), media_type="application/octet-stream")

    @app.get("/api/series")
    def values(name: str, marker: int, camera: str) -> Response:
        return Response(series(library.open(name), marker, camera), media_type="application/octet-stream")

    @app.get("/api/stretches")
    def stretches(name: str) -> list[dict[str, object]]:
        return [vars(item) for item in find_stretches(library.open(name).found)]

    @app.get("/api/frame")
    def frame(name: str, camera: str, number: int) -> Response:
        try:
            content = library.open(name).frames(camera).jpeg(number)
        except InputError as error:
            return JSONResponse({"error": str(error)}, NO_VIDEO)
        if content is None:
            return JSONResponse({"error": f"frame {number} of camera {camera} is damaged"}, NO_VIDEO)
        return Response(content, media_type="image/jpeg")


def _add_correcting_calls(app: FastAPI, library: Library) -> None:
    @app.post("/api/claim")
    def claim(name: str, page: str) -> dict[str, object]:
        found = library.open(name)
        return {"writable": found.claim_for(page), "revision": found.revision}

    @app.post("/api/release")
    def release(name: str, page: str) -> None:
        library.open(name).release(page)

    @app.post("/api/correct")
    def correct(name: str, page: str, action: Action) -> dict[str, object]:
        found = library.open(name)
        with found.editing:
            return perform(found, page, action) | _state(found)
