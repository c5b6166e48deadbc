"""Errors of requests as JSON: {"error": {"kind": class name, "message": text}} with a status code."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fastapi import FastAPI, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import Response

from annotator.types.errors import (
    AnnotatorError,
    FinalisedFrameError,
    HistoryError,
    InUseError,
    MovedError,
    NotFoundError,
    ReplacedError,
    StaleRevisionError,
    TrackTakenError,
)

LOG = logging.getLogger("annotator.web")

INTERNAL = "internal error, see the server's log"


class NotSignedInError(AnnotatorError):
    """The request lacks an operator's name, or the server's token."""


class ForbiddenError(AnnotatorError):
    """The request comes from a foreign page, or names a foreign host."""


class TooLargeError(AnnotatorError):
    """The request's body exceeds the limit."""


class TooManyError(AnnotatorError):
    """Too many requests without the token, or too many wrong tokens."""


class AnsweredError(Exception):
    """Ends a request with a response."""

    def __init__(self, response: Response) -> None:
        super().__init__(response.status_code)
        self.response = response


class ErrorBody(BaseModel):
    """The kind of an error, for programs, and its message, for people."""

    kind: str
    message: str


class ErrorAnswer(BaseModel):
    """The response to a failed request; some have further fields beside `error`."""

    error: ErrorBody


# The first matching row applies, so subclasses precede their base classes.
STATUS: list[tuple[type[AnnotatorError], int]] = [
    (NotFoundError, 404),
    (StaleRevisionError, 409),
    (ReplacedError, 409),
    (InUseError, 409),
    (HistoryError, 409),
    (TrackTakenError, 409),
    (FinalisedFrameError, 409),
    (NotSignedInError, 401),
    (ForbiddenError, 403),
    (TooLargeError, 413),
    (TooManyError, 429),
    (AnnotatorError, 400),
]

# An absolute path up to its first space; the group is its last component.
_ABSOLUTE = re.compile(r"""(?<![\w./:…\-])(?:/[^/\s:;,'"()\[\]]+)*/([^/\s:;,'"()\[\]]+)""")


def hide_paths(text: str, path_names: Iterable[tuple[Path, str]]) -> str:
    """Replaces absolute paths in a message, so that it names files but not their folders on this computer.

    Args:
        path_names: folders with their replacements; the first match applies. Any other path is shortened to its last
            component.
    """
    for folder, name in path_names:
        if not has_absolute_path(text):
            return text
        if folder.is_absolute() and folder != Path(folder.anchor):
            text = name.join(re.split(rf"(?<![\w.\-]){re.escape(str(folder))}(?![\w\-])", text))
    return _ABSOLUTE.sub(r"…/\1", text)


# A command of the terminal, or an option of one. Aside: in parentheses.
_COMMAND, _ASIDE = re.compile(r"`annotator\b[^`]*`|(?<![\w-])--[a-z][a-z-]+"), re.compile(r" ?\([^()]*\)")


def without_commands(text: str) -> str:
    """Returns a message for somebody at a page, who has no terminal: what a message says to type there is left out.

    A message is "PROBLEM; WHAT, OR WHAT (HOW)"; those parts of it go that name a command or an option of one.
    """
    told = _ASIDE.sub(lambda aside: "" if _COMMAND.search(aside[0]) else aside[0], text)
    clauses = ([part for part in clause.split(", ") if not _COMMAND.search(part)] for clause in told.split("; "))
    return "; ".join(", ".join(parts).removeprefix("or ") for parts in clauses if parts) or text


def has_absolute_path(text: str) -> bool:
    return _ABSOLUTE.search(text) is not None


def status_of(error: AnnotatorError) -> int:
    return next(status for kind, status in STATUS if isinstance(error, kind))


def error_response(kind: str, message: str, status: int, **more: object) -> JSONResponse:
    """The response to a failed request; `more` are further fields beside "error"."""
    # a lone surrogate quoted from a request cannot be encoded
    readable = message.encode("utf-8", "replace").decode()
    return JSONResponse({"error": {"kind": kind, "message": readable}, **more}, status)


def internal_error(connection: HTTPConnection, error: Exception) -> JSONResponse:
    """The response to an unexpected exception; its details go to the log only."""
    LOG.error("%s failed", connection.url.path, exc_info=error)
    return error_response("InternalError", INTERNAL, 500)


def add_error_handlers(app: FastAPI) -> None:
    """Registers handlers that turn every error of a route into this form."""
    app.add_exception_handler(AnsweredError, _answered)
    app.add_exception_handler(AnnotatorError, _annotator_error)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)


async def _answered(connection: HTTPConnection, error: Exception) -> Response:
    assert isinstance(error, AnsweredError)
    return error.response


async def _annotator_error(connection: HTTPConnection, error: Exception) -> Any:  # None for a WebSocket
    assert isinstance(error, AnnotatorError)
    # in a thread, since it reads the projects; the event loop must not wait for any of them
    message = await run_in_threadpool(connection.app.state.context.public_message, str(error))
    status = status_of(error)
    if isinstance(connection, WebSocket):
        # a close reason has at most 123 bytes
        await connection.close(4000 + status, message.encode()[:120].decode("utf-8", "ignore"))
        # Starlette sends any response, which a closed socket refuses
        return None
    more: dict[str, object] = {}
    if isinstance(error, TrackTakenError):
        more = {"track": error.track_id}
    elif isinstance(error, MovedError):
        more = {"moved": {"id": error.recording_id, "name": error.name}}
    return error_response(type(error).__name__, message, status, **more)


async def _invalid(connection: HTTPConnection, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    problems = "; ".join(f"{_field(problem['loc'])}: {problem['msg']}" for problem in error.errors()[:5])
    return error_response("ValidationError", problems, 422)


def _field(location: tuple[int | str, ...]) -> str:
    """The path of a field, such as `changes.0.kind`, without its first part ("body" or "query")."""
    return ".".join(map(str, location[1:])) or str(location[0])


async def _http(connection: HTTPConnection, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    kind = "NotFoundError" if error.status_code == 404 else "HTTPError"
    message = f"{connection.url.path} does not exist" if error.status_code == 404 else str(error.detail)
    response = error_response(kind, message, error.status_code)
    response.headers.update(error.headers or {})
    return response
