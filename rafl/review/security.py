"""Who may use the server: only pages that it served itself, to somebody who has its address with the token."""

import hmac
from collections.abc import Awaitable, Callable
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# Own scripts, styles and frames only; nothing inline, nothing from elsewhere, no page may show this one in itself.
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
LOCAL_NAMES = ("127.0.0.1", "localhost")
MAX_BODY_BYTES = 100_000
HTTP_PORT = 80


class Guard:
    """Refuses requests without the token, from other origins, or with a body too large for a correction.

    The first request carries the token in its address. The answer sets it as a cookie and leads to the page.
    """

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self.app, self.token = app, token
        self.hosts = {f"{name}:{port}" for name in LOCAL_NAMES}
        if port == HTTP_PORT:  # which browsers leave out
            self.hosts.update(LOCAL_NAMES)
        self.cookie = f"rafl-review-{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or refuse a request."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        headers = Headers(scope=scope)
        guarded = _with_headers(send)
        if reason := self._foreign(headers):
            await PlainTextResponse(reason, 403)(scope, receive, guarded)
        elif scope["path"] == "/" and self._matches(
            parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        ):
            response = RedirectResponse("/", 303)
            response.set_cookie(self.cookie, self.token, httponly=True, samesite="strict")
            await response(scope, receive, guarded)
        elif not self._matches(self._cookie_of(headers)):
            reason = "expected the address that rafl-review printed, with its token; open that one"
            await PlainTextResponse(reason, 403)(scope, receive, guarded)
        elif int(headers.get("content-length") or 0) > MAX_BODY_BYTES or "transfer-encoding" in headers:
            await PlainTextResponse("expected a smaller request", 413)(scope, receive, guarded)
        else:
            await self.app(scope, receive, guarded)

    def _foreign(self, headers: Headers) -> str:
        """Why a request comes from elsewhere; empty if it does not."""
        if headers.get("host", "").lower() not in self.hosts:
            return "expected a request to this machine"
        origin = headers.get("origin")
        if origin is not None and origin.removeprefix("http://") not in self.hosts:
            return "expected a request from a page of this server"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return "expected a request from a page of this server"
        return ""

    def _cookie_of(self, headers: Headers) -> str:
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return ""
        return cookies[self.cookie].value if self.cookie in cookies else ""

    def _matches(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())


def _with_headers(send: Send) -> Callable[[Message], Awaitable[None]]:
    """`send` with the headers that every answer has."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers[name] = value
        await send(message)

    return sending
