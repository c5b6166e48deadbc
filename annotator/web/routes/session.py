"""The session: the operator's name."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Request, Response
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from annotator import __version__
from annotator.web.context import LONGEST_NAME, OPERATOR_COOKIE, Ctx, check_operator, operator_or_none

router = APIRouter(tags=["session"])

A_YEAR_S = 365 * 24 * 3600


class SignIn(BaseModel):
    """The operator's name, stored as the author of changes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    operator: Annotated[str, Field(max_length=LONGEST_NAME), AfterValidator(check_operator)]


class Session(BaseModel):
    """The signed-in operator, and the server's version and protection."""

    operator: str | None
    version: str
    token_required: bool


@router.get("/api/session")
def session(request: Request, ctx: Ctx) -> Session:
    """The operator who is signed in on this browser."""
    return _session(ctx, operator_or_none(request))


@router.post("/api/session")
def sign_in(body: SignIn, response: Response, ctx: Ctx) -> Session:
    """Sign in with a name, which becomes the author of all changes."""
    response.set_cookie(OPERATOR_COOKIE, quote(body.operator), max_age=A_YEAR_S, httponly=True, samesite="strict")
    return _session(ctx, body.operator)


@router.delete("/api/session")
def sign_out(response: Response, ctx: Ctx) -> Session:
    """Sign out."""
    response.delete_cookie(OPERATOR_COOKIE, httponly=True, samesite="strict")
    return _session(ctx, None)


def _session(ctx: Ctx, name: str | None) -> Session:
    return Session(operator=name, version=__version__, token_required=ctx.settings.token is not None)
