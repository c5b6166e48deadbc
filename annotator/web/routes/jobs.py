"""Jobs: start, list and stop; export formats, and downloads of exports."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Body, Path
from fastapi.responses import FileResponse
from pydantic import BaseModel

from annotator.project.config import free_path
from annotator.types import ReviewState
from annotator.web.context import Ctx, Operator
from annotator.web.jobs.records import CopyRequest, Job, JobRequest
from annotator.workflows.exporting import WRITERS, ExportFormat

router = APIRouter(tags=["jobs"])

JobId = Annotated[str, Path(pattern="^[0-9a-f]{32}$")]


class JobList(BaseModel):
    """All jobs, the newest first."""

    jobs: list[Job]


class FormatInfo(BaseModel):
    """An export format.

    Attributes:
        summary: a short description, for people.
        states: the review states exported by default.
        flat: True for a format of 2D boxes on images.
    """

    name: ExportFormat
    summary: str
    states: list[ReviewState]
    flat: bool


class FormatList(BaseModel):
    """All export formats, annotator's own first."""

    formats: list[FormatInfo]


@router.post("/api/projects/{project}/jobs", status_code=201)
def begin(project: str, body: Annotated[JobRequest, Body()], ctx: Ctx, operator: Operator) -> Job:
    """Start a job (train, propose, lift, export, import or copy); it waits until earlier jobs have ended."""
    path = ctx.project(project).path
    if isinstance(body, CopyRequest):
        free_path(path.parent, body.name)
    return ctx.jobs.add(project, path, body, operator)


@router.get("/api/jobs")
def jobs(ctx: Ctx, operator: Operator) -> JobList:
    """All jobs, including those from before the server was started."""
    return JobList(jobs=ctx.jobs.all())


@router.post("/api/jobs/{id}/cancel")
def cancel(id: JobId, ctx: Ctx, operator: Operator) -> Job:
    """Stop a job; finished parts of its work are kept."""
    return ctx.jobs.cancel(id)


@router.get("/api/jobs/{id}/download", response_class=FileResponse)
def download(id: JobId, ctx: Ctx, operator: Operator) -> FileResponse:
    """The packed dataset of an export; the latest ones of each project are kept."""
    path = ctx.jobs.file(id)
    return FileResponse(path, media_type="application/zip", filename=path.name)


@router.get("/api/export-formats")
def formats(operator: Operator) -> FormatList:
    """The formats that labels can be exported to."""
    return FormatList(
        formats=[
            FormatInfo(name=name, summary=writer.summary, states=list(writer.states), flat=writer.flat)
            for name, writer in WRITERS.items()
        ]
    )
