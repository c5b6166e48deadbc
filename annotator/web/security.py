"""The checks before every route: host, token, origin and size of a request; and the security headers of the response.

- A browser must present the token once, in a link. It gets a cookie for it that scripts cannot read and that requests
  from other sites do not carry. The cookie is another secret, so it cannot be guessed by guessing tokens.
- On a loopback address, a request's `Host` must also be a name of this computer. This refuses a foreign page whose name
  resolves to this computer (DNS rebinding).
- WebSockets, and requests that may change something, must come from a page of this server, as stated by `Origin`.
- Those who have not signed in may send few requests a second, and guess few tokens a minute. On a WebSocket, the
  number of messages a second is limited. `annotator.web.limits` has the limits of connections.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import math
import os
import re
import secrets
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from annotator.files import make_private, private_folder, read_file
from annotator.types.errors import AnnotatorError, ConfigError
from annotator.web.errors import (
    ForbiddenError,
    NotSignedInError,
    TooLargeError,
    TooManyError,
    error_response,
    internal_error,
    status_of,
)
from annotator.web.limits import Rate, address_key

LOG = logging.getLogger("annotator.web")


@dataclass(frozen=True)
class ServerSettings:
    """Settings of one server.

    Attributes:
        folders: folders that recordings may be added from; browsers cannot list anything else. On an address that other
            computers reach, recordings of projects are only read there, too.
        port: port to listen on; 0 = a free one.
        token: secret that a browser must present once, in the link that the server prints; None is permitted on
            loopback addresses only.
        cookie: secret that a browser gets for the token, and presents from then on.
    """

    projects_root: Path
    folders: tuple[Path, ...] = ()
    host: str = "127.0.0.1"
    port: int = 8080
    token: str | None = field(default=None, repr=False)
    cookie: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)


BODY_LIMIT = 1 << 20
# The same for the files that pages send, on the one path that takes them.
UPLOAD_LIMIT = 64 << 20
UPLOADS = re.compile(r"/api/projects/[^/]+/boxes-files")
# How much is read beyond the limit.
READ_ON = 8 * BODY_LIMIT
TOKEN_LENGTH = 16
# Requests of one address without the cookie: a second in the long run, and at once. Wrong tokens likewise.
STRANGERS_PER_S, STRANGERS_BURST = 20.0, 60
GUESSES_PER_S, GUESSES_BURST = 0.1, 10
# Messages on one WebSocket. A drag in the 3D view sends some 60 a second.
MESSAGES_PER_S, MESSAGES_BURST = 200.0, 1000
TOO_MANY = 1008
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
# inline styles are needed by plotly; scripts come from files only
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
PLACE = re.compile(r"[a-z0-9_-]{1,64}/(annotate|label|review)")
# A refresh, not a redirect: browsers do not send SameSite=Strict cookies with a redirect from another site.
WELCOME = (
    '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0;url={url}"><title>annotator</title>'
)
LOCKED = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>annotator</title>'
    "<p>This workbench opens with the link that the server printed when it started.</p></html>"
)


def is_loopback(host: str) -> bool:
    """True for a loopback address, which only this computer can reach."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def check_settings(settings: ServerSettings) -> None:
    """Refuses settings that would open the server to the network."""
    if settings.token is None and not is_loopback(settings.host):
        raise ConfigError(
            f"{settings.host} can be reached from other computers: it needs a token; leave --no-token out"
        )
    if settings.token is not None and (len(settings.token) < TOKEN_LENGTH or not settings.token.isascii()):
        raise ConfigError(f"a token needs at least {TOKEN_LENGTH} ASCII characters; without one, the server makes one")


class Guard:
    """The ASGI middleware that checks each request before the application gets it."""

    def __init__(self, app: ASGIApp, settings: ServerSettings) -> None:
        self.app, self.settings = app, settings
        self.local = is_loopback(settings.host)
        self.requests, self.guesses = Rate(STRANGERS_PER_S, STRANGERS_BURST), Rate(GUESSES_PER_S, GUESSES_BURST)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Checks a request; passes it on or refuses it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        send = _with_headers(scope, send)
        connection = HTTPConnection(scope)
        is_known = self._is_known(connection)
        try:
            if not is_known:
                _count(self.requests, connection)
            self._check_host(connection)
            welcome = self._welcome(connection, is_known)
            if welcome is not None:
                await welcome(scope, receive, send)
                return
            if not is_known:
                raise NotSignedInError("sign in with the link that the server printed when it started")
            _check_origin(connection)
            body = await _whole_body(scope, connection.headers, receive)
        except AnnotatorError as error:
            await _refuse(error, scope, receive, send)
            return
        if scope["type"] == "websocket":
            receive = _few_messages(scope, receive, send)
        await self._pass_on(connection, receive if body is None else _replay(body, receive), send)

    async def _pass_on(self, connection: HTTPConnection, receive: Receive, send: Send) -> None:
        """Passes a request on to the routes; the response to an unexpected exception contains no details."""
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
        """On a loopback address, `Host` must be a name of this computer; elsewhere the token is checked instead."""
        if self.local and _host_name(connection.headers.get("host", "")) not in (*LOCAL_NAMES, self.settings.host):
            raise ForbiddenError("the request's Host must be a name of this computer, such as localhost")

    def _is_known(self, connection: HTTPConnection) -> bool:
        """True for a browser that has presented the token, or if none is needed."""
        if self.settings.token is None:
            return True
        return _same(connection.cookies.get(cookie_name(connection.headers.get("host", "")), ""), self.settings.cookie)

    def _welcome(self, connection: HTTPConnection, is_known: bool) -> Response | None:
        """The response to the printed link, which exchanges the token in the URL for the cookie."""
        token, scope = self.settings.token, connection.scope
        query = parse_qsl(connection.url.query, keep_blank_values=True)
        tokens = [value for name, value in query if name == "token"]
        if token is None or scope["type"] != "http" or scope["method"] != "GET" or not tokens:
            return None
        # the link of an earlier start leads a known browser to the page, too
        if not is_known:
            self._check_guess(tokens[-1], token, connection)
        place = dict(query).get("go", "")
        url = f"/#/{place}" if PLACE.fullmatch(place) else "/"
        response = HTMLResponse(WELCOME.format(url=url), headers={"Cache-Control": "no-store"})
        name = cookie_name(connection.headers.get("host", ""))
        response.set_cookie(name, self.settings.cookie, httponly=True, samesite="strict", path="/")
        return response

    def _check_guess(self, guess: str, token: str, connection: HTTPConnection) -> None:
        """Compares a token, unless its sender has guessed too often: then not even the right one is told apart."""
        address = _address(connection)
        if not self.guesses.allows(address):
            _count(self.guesses, connection)
        if not _same(guess, token):
            self.guesses.take(address)
            raise NotSignedInError(
                "this is not the token of this server; open the link that it printed when it started"
            )


def cookie_name(host: str) -> str:
    """The name of the cookie. All servers on a host share their cookies, so it has the port as the browser knows it."""
    try:
        port = urlsplit(f"//{host}").port
    except ValueError:
        port = None
    return f"annotator_{port or 80}"


def _address(connection: HTTPConnection) -> str:
    return address_key(connection.client.host if connection.client else "")


def _count(rate: Rate, connection: HTTPConnection) -> None:
    """Counts something that an address may not do often."""
    address = _address(connection)
    if not rate.take(address):
        raise TooManyError(f"too many requests without the right token; wait {math.ceil(rate.wait_s(address))} s")


def _same(candidate: str, token: str) -> bool:
    return hmac.compare_digest(candidate.encode("utf-8", "replace"), token.encode())


def _host_name(host: str) -> str | None:
    """The host of a `Host` header: `[::1]:80` -> `::1`; None for an invalid one."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _check_origin(connection: HTTPConnection) -> None:
    """Requires that `Origin`, which browsers set and pages cannot forge, is this server."""
    if connection.scope["type"] == "http" and connection.scope["method"] in SAFE_METHODS:
        return
    origin, host = connection.headers.get("origin", ""), connection.headers.get("host", "")
    scheme, _, place = origin.partition("://")
    if scheme not in ("http", "https") or not host or place.lower() != host.lower():
        raise ForbiddenError("the request does not come from a page of this server (its Origin differs from its Host)")


async def _whole_body(scope: Scope, headers: Headers, receive: Receive) -> bytes | None:
    """Reads the body of a request; None for requests without one."""
    if scope["type"] != "http" or scope["method"] in SAFE_METHODS:
        return None
    declared = headers.get("content-length", "0")
    size, parts, more = 0, list[bytes](), True
    limit = UPLOAD_LIMIT if UPLOADS.fullmatch(scope["path"]) else BODY_LIMIT
    too_large = not declared.isdecimal() or int(declared) > limit
    # reads on by READ_ON: a browser loses the response if the connection is closed while it still sends
    while more and size <= limit + READ_ON:
        message = await receive()
        if message["type"] == "http.disconnect":
            break
        size += len(message.get("body", b""))
        more = message.get("more_body", False)
        too_large = too_large or size > limit
        if too_large:
            parts.clear()
        else:
            parts.append(message.get("body", b""))
    if too_large:
        raise TooLargeError(f"the request's body has more than {limit} bytes")
    return b"".join(parts)


def _replay(body: bytes, receive: Receive) -> Receive:
    """A `receive` that returns the body already read, then further messages."""
    pending: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def next_message() -> Message:
        return pending.pop() if pending else await receive()

    return next_message


def _few_messages(scope: Scope, receive: Receive, send: Send) -> Receive:
    """A `receive` that closes the WebSocket of a page that sends too many messages."""
    rate = Rate(MESSAGES_PER_S, MESSAGES_BURST)

    async def next_message() -> Message:
        message = await receive()
        if message["type"] != "websocket.receive" or rate.take(None):
            return message
        LOG.warning("%s: a page sent too many messages, and was disconnected", scope["path"])
        await send({"type": "websocket.close", "code": TOO_MANY, "reason": "too many messages"})
        return {"type": "websocket.disconnect", "code": TOO_MANY}

    return next_message


def _with_headers(scope: Scope, send: Send) -> Send:
    """A `send` that adds missing security headers to the response."""
    is_api = scope["path"].startswith("/api/")

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
            if is_api:
                headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return sending


async def _refuse(error: AnnotatorError, scope: Scope, receive: Receive, send: Send) -> None:
    status = status_of(error)
    if scope["type"] == "websocket":
        await receive()  # the connect message
        if "websocket.http.response" not in scope.get("extensions", {}):
            await send({"type": "websocket.close", "code": 4000 + status, "reason": type(error).__name__})
            return
    wants_page = "text/html" in Headers(scope=scope).get("accept", "") and status == 401
    if wants_page and not scope["path"].startswith("/api/"):
        response: Response = HTMLResponse(LOCKED, status)
    else:
        response = error_response(type(error).__name__, str(error), status)
    response.headers["Cache-Control"] = "no-store"
    # closes the connection: an unread rest of the body must not be parsed as the next request
    response.headers["Connection"] = "close"
    await response(scope, receive, send)


def link(address: str, token: str | None, place: str | None = None) -> str:
    """The URL to open in a browser, optionally at a place of the page such as `room/annotate`."""
    if token is None:
        return address if place is None else f"{address}#/{place}"
    return f"{address}?{urlencode({'token': token} if place is None else {'token': token, 'go': place})}"


VARIABLE = "ANNOTATOR_TOKEN"
MOST_BYTES = 4096
KEY_BYTES = 32


def with_token(settings: ServerSettings, token_file: Path | None = None, *, no_token: bool = False) -> ServerSettings:
    """Returns the settings with the token of a file, of the variable `ANNOTATOR_TOKEN`, or a new one; and its cookie.

    On a loopback address, browsers stay signed in when the server is started again with a new token: whoever opened the
    link was a user of this computer, to whom the operator had given it. Elsewhere, a new token ends that, as a changed
    one always does. The variable is removed, so that the programs started by this one do not get it.

    Args:
        no_token: everyone who can reach the server may use it; on loopback addresses only.
    """
    named = os.environ.pop(VARIABLE, None)
    if no_token:
        if token_file is not None:
            raise ConfigError("--token-file and --no-token exclude each other; leave one of them out")
        check_settings(settings)
        return settings
    given = _of_file(token_file) if token_file is not None else named or None
    settings = replace(settings, token=given or secrets.token_urlsafe(32))
    check_settings(settings)
    if given or is_loopback(settings.host):
        # the same after each start; another one for other projects, users and computers
        of_token = f"{settings.projects_root.resolve()}\n{given or ''}".encode()
        return replace(settings, cookie=hmac.new(_key(), of_token, "sha256").hexdigest())
    return settings


def _of_file(path: Path) -> str:
    make = f"make one with (umask 077; openssl rand -hex 32 > {path})"
    try:
        # a pipe is welcome: --token-file <(pass show annotator)
        with path.open("rb") as file:
            if os.name != "nt" and stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o077:
                raise ConfigError(f"--token-file {path}: other users may read it; run chmod 600 {path}")
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"--token-file {path}: cannot be read ({error.strerror}); {make}") from error
    text = content.decode("utf-8", "replace").strip()
    if len(content) > MOST_BYTES or not text or len(text.split()) > 1:
        raise ConfigError(f"--token-file {path}: is not one line with a token; {make}")
    return text


def _key() -> bytes:
    """The secret of this user on this computer. It is not in the projects folder, which people copy and send."""
    path = state_folder() / "secret"
    try:
        private_folder(path.parent)
        make_private(path)
        key = read_file(path, MOST_BYTES)
        if len(key) != KEY_BYTES:
            key = secrets.token_bytes(KEY_BYTES)
            path.write_bytes(key)
        return key
    except OSError as error:
        LOG.warning("%s: cannot be kept (%s); browsers must open the link again after a restart", path, error)
        return secrets.token_bytes(KEY_BYTES)


def state_folder() -> Path:
    """The folder for what annotator remembers about this user on this computer."""
    place = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(place) if place else Path.home() / ".local" / "state") / "annotator"
