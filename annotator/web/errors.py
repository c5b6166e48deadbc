"""What goes wrong in a request, as JSON: {"error": {"kind": class name, "message": text}} and a status code."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from pathlib import Path

from fastapi import FastAPI, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection

from annotator.types.errors import AnnotatorError, FinalisedFrameError, HistoryError, NotFoundError, StaleRevisionError

LOG = logging.getLogger("annotator.web")

INTERNAL = "internal error, see the server's log"


class NotSignedInError(AnnotatorError):
    """The request needs an operator's name, or the server's token."""


class ForbiddenError(AnnotatorError):
    """The request comes from another page, or asks another host."""


class TooLargeError(AnnotatorError):
    """The request's body is larger than any that the server takes."""


class ErrorBody(BaseModel):
    """The kind of an error, for programs, and what it says, for people."""

    kind: str
    message: str


class ErrorAnswer(BaseModel):
    """The answer to a request that failed; some say more beside `error`."""

    error: ErrorBody


# The first row that an error is an instance of decides; a row for a new kind goes above its bases.
STATUS: list[tuple[type[AnnotatorError], int]] = [
    (NotFoundError, 404),
    (StaleRevisionError, 409),
    (HistoryError, 409),
    (FinalisedFrameError, 409),
    (NotSignedInError, 401),
    (ForbiddenError, 403),
    (TooLargeError, 413),
    (AnnotatorError, 400),
]

# An absolute path, as far as its first blank, and its last name.
_ABSOLUTE = re.compile(r"""(?<![\w./:…\-])(?:/[^/\s:;,'"()\[\]]+)*/([^/\s:;,'"()\[\]]+)""")


def without_places(text: str, places: Iterable[tuple[Path, str]]) -> str:
    """A message without absolute paths: it still names the file, but not where on this computer it is.

    Args:
        places: folders, and what stands for each; the first that fits is taken. Of a path in none of them only the last
            name is left.
    """
    for folder, name in places:
        if not holds_absolute(text):
            return text
        if folder.is_absolute() and folder != Path(folder.anchor):
            text = name.join(re.split(rf"(?<![\w.\-]){re.escape(str(folder))}(?![\w\-])", text))
    return _ABSOLUTE.sub(r"…/\1", text)


def holds_absolute(text: str) -> bool:
    """True where a message names a place on this computer."""
    return _ABSOLUTE.search(text) is not None


def status_of(error: AnnotatorError) -> int:
    """The status code of an error."""
    return next(status for kind, status in STATUS if isinstance(error, kind))


def error_response(kind: str, message: str, status: int, **more: object) -> JSONResponse:
    """The answer to a request that failed; `more` stands beside "error"."""
    # half a surrogate pair, quoted from a request, cannot be sent
    readable = message.encode("utf-8", "replace").decode()
    return JSONResponse({"error": {"kind": kind, "message": readable}, **more}, status)


def internal_error(connection: HTTPConnection, error: Exception) -> JSONResponse:
    """The answer to a fault of the program, which only the log explains."""
    LOG.error("%s failed", connection.url.path, exc_info=error)
    return error_response("InternalError", INTERNAL, 500)


def add_error_handlers(app: FastAPI) -> None:
    """Every failure of a route becomes such an answer."""
    app.add_exception_handler(AnnotatorError, _told)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)


async def _told(connection: HTTPConnection, error: Exception) -> Response:
    assert isinstance(error, AnnotatorError)
    status, message = status_of(error), connection.app.state.context.told(str(error))
    if isinstance(connection, WebSocket):
        # a reason has at most 123 bytes
        await connection.close(4000 + status, message.encode()[:120].decode("utf-8", "ignore"))
        return Response()  # nobody reads it
    return error_response(type(error).__name__, message, status)


async def _invalid(connection: HTTPConnection, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    problems = "; ".join(f"{_field(problem['loc'])}: {problem['msg']}" for problem in error.errors()[:5])
    return error_response("ValidationError", problems, 422)


def _field(location: tuple[int | str, ...]) -> str:
    """`body.changes.0.kind` without its first word, which only says where the value stood."""
    return ".".join(map(str, location[1:])) or str(location[0])


async def _http(connection: HTTPConnection, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    kind = "NotFoundError" if error.status_code == 404 else "HTTPError"
    message = f"there is nothing at {connection.url.path}" if error.status_code == 404 else str(error.detail)
    answer = error_response(kind, message, error.status_code)
    answer.headers.update(error.headers or {})
    return answer
