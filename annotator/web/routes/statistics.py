"""How far a project is, and what a box costs."""

from __future__ import annotations

from fastapi import APIRouter

from annotator.project import Statistics
from annotator.web.context import Ctx

router = APIRouter(tags=["statistics"])


@router.get("/api/projects/{name}/statistics")
def statistics(ctx: Ctx, name: str) -> Statistics:
    """The same numbers as `annotator stats --json`."""
    return ctx.project(name).statistics()
