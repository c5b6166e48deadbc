"""What stands before every route: whom the server answers, how much it reads, what browsers may do with its answers.

- On this computer's own address nobody needs to show anything, but a request must name this computer as its host:
  a foreign page whose name was made to point here (DNS rebinding) does not.
- On any other address a browser must show the token: once in a link, afterwards in a cookie that no script can read
  and that no other site's request carries.
- A WebSocket, and every request that may change something, must come from a page of this server (its `Origin`).
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
from collections.abc import Mapping
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from annotator.types.errors import AnnotatorError, ConfigError
from annotator.web.errors import (
    ForbiddenError,
    NotSignedInError,
    TooLargeError,
    error_response,
    internal_error,
    status_of,
)
from annotator.web.settings import ServerSettings

BODY_LIMIT = 1 << 20
READ_ON = 8 * BODY_LIMIT
TOKEN_LENGTH = 16
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
# plotly draws with style attributes; scripts come from files only
POLICY = (
    "default-src 'self'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# The page goes on by itself: the browser would not send a strict cookie along a redirect that began on another site.
PLACE = re.compile(r"[a-z0-9_-]{1,64}/(label|review)")
WELCOME = (
    '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0;url={url}"><title>annotator</title>'
)
LOCKED = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>annotator</title>'
    "<p>This workbench opens with the link that the server printed when it started.</p></html>"
)


def is_loopback(host: str) -> bool:
    """True for an address that only this computer can reach."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def check_settings(settings: ServerSettings) -> None:
    """Refuses settings with which anybody could come in.

    Raises:
        ConfigError: another address than this computer's own without a token, or a token that could be guessed.
    """
    if settings.token is None and not is_loopback(settings.host):
        raise ConfigError(f"{settings.host} can be reached from elsewhere: serving there needs a token")
    if settings.token is not None and (len(settings.token) < TOKEN_LENGTH or not settings.token.isascii()):
        raise ConfigError(f"a token has {TOKEN_LENGTH} ASCII characters or more; leave it out to get a good one")


class Guard:
    """The outermost layer of the application."""

    def __init__(self, app: ASGIApp, settings: ServerSettings) -> None:
        self.app, self.settings = app, settings
        self.local = is_loopback(settings.host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes on what may pass, and refuses the rest."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        send = _with_headers(scope, send)
        connection = HTTPConnection(scope)
        try:
            self._check_host(connection)
            welcome = self._welcome(connection)
            if welcome is not None:
                await welcome(scope, receive, send)
                return
            self._check_token(connection)
            _check_origin(connection)
            body = await _whole_body(scope, connection.headers, receive)
        except AnnotatorError as error:
            await _refuse(error, scope, receive, send)
            return
        await self._pass_on(connection, receive if body is None else _again(body, receive), send)

    async def _pass_on(self, connection: HTTPConnection, receive: Receive, send: Send) -> None:
        """To the routes; a fault there is told without its details."""
        begun = False

        async def noticing(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self.app(connection.scope, receive, noticing)
        except Exception as error:
            if begun or connection.scope["type"] != "http":
                raise
            await internal_error(connection, error)(connection.scope, receive, send)

    def _check_host(self, connection: HTTPConnection) -> None:
        """A server on this computer's own address answers to its names only; elsewhere the token decides."""
        if self.local and _host_name(connection.headers.get("host", "")) not in (*LOCAL_NAMES, self.settings.host):
            raise ForbiddenError("this server answers to the name of its own computer only")

    def _check_token(self, connection: HTTPConnection) -> None:
        token = self.settings.token
        if token is not None and not _same(connection.cookies.get(cookie_name(token), ""), token):
            raise NotSignedInError("this server opens with the link that it printed when it started")

    def _welcome(self, connection: HTTPConnection) -> Response | None:
        """The answer to the printed link: the token becomes a cookie, and leaves the address."""
        token, scope = self.settings.token, connection.scope
        query = parse_qsl(connection.url.query, keep_blank_values=True)
        given = [value for name, value in query if name == "token"]
        if token is None or scope["type"] != "http" or scope["method"] != "GET" or not given:
            return None
        if not _same(given[-1], token):
            raise NotSignedInError("this is not the token of this server; take the link that it printed last")
        place = dict(query).get("go", "")
        url = f"/#/{place}" if PLACE.fullmatch(place) else "/"
        answer = HTMLResponse(WELCOME.format(url=url), headers={"Cache-Control": "no-store"})
        answer.set_cookie(cookie_name(token), token, httponly=True, samesite="strict", path="/")
        return answer


def cookie_name(token: str) -> str:
    """Cookies are shared by all ports of a host: servers with different tokens take different names."""
    return f"annotator_{hashlib.sha256(token.encode()).hexdigest()[:8]}"


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "replace"), token.encode())


def _host_name(host: str) -> str | None:
    """`[::1]:80` -> `::1`; None for what is no host."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _check_origin(connection: HTTPConnection) -> None:
    """The page that asks must be one of this server: browsers say which it is, and let no page lie about it."""
    if connection.scope["type"] == "http" and connection.scope["method"] in SAFE_METHODS:
        return
    origin, host = connection.headers.get("origin", ""), connection.headers.get("host", "")
    scheme, _, place = origin.partition("://")
    if scheme not in ("http", "https") or not host or place.lower() != host.lower():
        raise ForbiddenError("this request does not come from a page of this server (its Origin differs from its Host)")


async def _whole_body(scope: Scope, headers: Headers, receive: Receive) -> bytes | None:
    """The body of a request that may have one; None for all else.

    Raises:
        TooLargeError: there is more than the limit, whatever the headers say.
    """
    if scope["type"] != "http" or scope["method"] in SAFE_METHODS:
        return None
    declared = headers.get("content-length", "0")
    size, parts, more = 0, list[bytes](), True
    too_large = not declared.isdecimal() or int(declared) > BODY_LIMIT
    # what is too large is read on for a while: a browser that is cut off while it sends never sees the answer
    while more and size <= READ_ON:
        message = await receive()
        if message["type"] == "http.disconnect":
            break
        size += len(message.get("body", b""))
        more = message.get("more_body", False)
        too_large = too_large or size > BODY_LIMIT
        if too_large:
            parts.clear()
        else:
            parts.append(message.get("body", b""))
    if too_large:
        raise TooLargeError(f"the request's body has more than {BODY_LIMIT} bytes")
    return b"".join(parts)


def _again(body: bytes, receive: Receive) -> Receive:
    """Gives the body that was read, and then whatever comes."""
    pending: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def next_message() -> Message:
        return pending.pop() if pending else await receive()

    return next_message


def _with_headers(scope: Scope, send: Send) -> Send:
    """Adds the headers that an answer does not bring itself."""
    never_kept = scope["path"].startswith("/api/")

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
            if never_kept:
                headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return sending


async def _refuse(error: AnnotatorError, scope: Scope, receive: Receive, send: Send) -> None:
    status = status_of(error)
    if scope["type"] == "websocket":
        await receive()  # the request to connect
        if "websocket.http.response" not in scope.get("extensions", {}):
            await send({"type": "websocket.close", "code": 4000 + status, "reason": type(error).__name__})
            return
    wants_page = "text/html" in Headers(scope=scope).get("accept", "") and status == 401
    if wants_page and not scope["path"].startswith("/api/"):
        answer: Response = HTMLResponse(LOCKED, status)
    else:
        answer = error_response(type(error).__name__, str(error), status)
    answer.headers["Cache-Control"] = "no-store"
    # the rest of a body that was not read must not be taken for the next request
    answer.headers["Connection"] = "close"
    await answer(scope, receive, send)


def link(address: str, token: str | None, place: str | None = None) -> str:
    """What to open in a browser, to begin at a place of the page such as `room/review`."""
    if token is None:
        return address if place is None else f"{address}#/{place}"
    return f"{address}?{urlencode({'token': token} if place is None else {'token': token, 'go': place})}"
