"""Reports on a project: statistics, and warnings about labels."""

from __future__ import annotations

from fastapi import APIRouter

from annotator.web.context import Ctx
from annotator.web.schemas import RowId
from annotator.workflows.checking.project_labels import CheckReport, check_project
from annotator.workflows.detectors import ReportedStatistics, reported_statistics

router = APIRouter(tags=["review"])

# Time limit for counting points; the next request counts those of further frames.
READING_S = 3.0


@router.get("/api/projects/{name}/statistics")
def statistics(ctx: Ctx, name: str) -> ReportedStatistics:
    """The same numbers as `annotator stats --json`."""
    return reported_statistics(ctx.project(name))


@router.get("/api/projects/{name}/checks")
def checks(ctx: Ctx, name: str, frame: RowId | None = None) -> CheckReport:
    """Warnings about labels, of one frame or of all."""
    report = check_project(ctx.project(name), frame, READING_S)
    return report.model_copy(update={"unreadable": tuple(map(ctx.public_message, report.unreadable))})
