"""What goes wrong in a request, as JSON: {"error": {"kind": class name, "message": text}} and a status code."""

from __future__ import annotations

import logging

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from annotator.types.errors import AnnotatorError, FinalisedFrameError, HistoryError, NotFoundError, StaleRevisionError

LOG = logging.getLogger("annotator.web")

INTERNAL = "internal error, see the server's log"


class NotSignedInError(AnnotatorError):
    """The request needs an operator's name, or the server's token."""


class ForbiddenError(AnnotatorError):
    """The request comes from another page, or asks another host."""


class TooLargeError(AnnotatorError):
    """The request's body is larger than any that the server takes."""


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


def status_of(error: AnnotatorError) -> int:
    """The status code of an error."""
    return next(status for kind, status in STATUS if isinstance(error, kind))


def error_response(kind: str, message: str, status: int, **more: object) -> JSONResponse:
    """The answer to a request that failed; `more` stands beside "error"."""
    return JSONResponse({"error": {"kind": kind, "message": message}, **more}, status)


def add_error_handlers(app: FastAPI) -> None:
    """Every failure of a route becomes such an answer."""
    app.add_exception_handler(AnnotatorError, _told)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(Exception, _internal)


def _told(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, AnnotatorError)
    return error_response(type(error).__name__, str(error), status_of(error))


def _invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    problems = "; ".join(f"{_field(problem['loc'])}: {problem['msg']}" for problem in error.errors()[:5])
    return error_response("ValidationError", problems, 422)


def _field(location: tuple[int | str, ...]) -> str:
    """`body.changes.0.kind` without its first word, which only says where the value stood."""
    return ".".join(map(str, location[1:])) or str(location[0])


def _http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    kind = "NotFoundError" if error.status_code == 404 else "HTTPError"
    message = f"there is nothing at {request.url.path}" if error.status_code == 404 else str(error.detail)
    answer = error_response(kind, message, error.status_code)
    answer.headers.update(error.headers or {})
    return answer


def _internal(request: Request, error: Exception) -> JSONResponse:
    LOG.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return error_response("InternalError", INTERNAL, 500)
