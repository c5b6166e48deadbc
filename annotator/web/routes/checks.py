"""Labels that look wrong."""

from __future__ import annotations

from fastapi import APIRouter

from annotator.web.context import Ctx
from annotator.web.wire import RowId
from annotator.workflows.checks import CheckReport, check_project

router = APIRouter(tags=["checks"])

# Points are counted in so many frames as can be read meanwhile; the next look goes on.
READING_S = 3.0


@router.get("/api/projects/{name}/checks")
def checks(ctx: Ctx, name: str, frame: RowId | None = None) -> CheckReport:
    """Warnings about labels, of one frame or of all."""
    report = check_project(ctx.project(name), frame, READING_S)
    return report.model_copy(update={"unreadable": tuple(map(ctx.told, report.unreadable))})
