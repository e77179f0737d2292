"""The web server: the page of one view, its static files, and what it answers to bad requests."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, Protocol

from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.types import ASGIApp

from rafl.common.errors import InputError
from rafl.review.security import Guard

TYPES = {".svg": "image/svg+xml", ".html": "text/html; charset=utf-8", ".js": "text/javascript", ".css": "text/css"}


class ReadOnlyError(Exception):
    """Another page has what was to be changed."""


class View(Protocol):
    """What `rafl-review` shows of one path.

    Attributes:
        page: HTML file in `static/`, here or in `rafl.evaluation`.
        title: what is shown, for the command's first line.
    """

    page: str
    title: str

    def add_calls(self, app: FastAPI) -> None:
        """Add the calls of the page, `/api/...`."""

    def close(self) -> None:
        """Free what is open."""


def create_server(view: View, token: str, port: int, ready: Callable[[], Any] | None = None) -> ASGIApp:
    """The application, guarded.

    Args:
        view: what is shown.
        token: that the address must hold.
        port: of the server.
        ready: called once when the server is up.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        if ready is not None:
            ready()
        yield
        view.close()

    app = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    _add_static_files(app, view.page)
    view.add_calls(app)
    _add_refusals(app)
    return Guard(app, token, port)


def _add_refusals(app: FastAPI) -> None:
    """Answer errors of the user and of the file system with their text."""

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


def _static_files(folder: Traversable, prefix: str = "") -> dict[str, bytes]:
    """Contents of all files below a folder, by their path in it."""
    found: dict[str, bytes] = {}
    for entry in folder.iterdir():
        if entry.is_dir():
            found |= _static_files(entry, f"{prefix}{entry.name}/")
        else:
            found[prefix + entry.name] = entry.read_bytes()
    return found


def _add_static_files(app: FastAPI, page: str) -> None:
    """Serve the files of the page, which are read once."""
    contents = _static_files(files("rafl.evaluation") / "static") | _static_files(files("rafl.review") / "static")

    def answer(name: str) -> Response:
        suffix = name[name.rfind(".") :]
        if name not in contents or suffix not in TYPES:
            raise HTTPException(404)
        return Response(contents[name], media_type=TYPES[suffix])

    @app.get("/")
    def start() -> Response:
        return answer(page)

    @app.get("/static/{name:path}")
    def static(name: str) -> Response:
        return answer(name)
