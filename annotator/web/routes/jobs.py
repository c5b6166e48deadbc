"""Long work: begin it, look at it, stop it."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Body, Path
from pydantic import BaseModel

from annotator.web.context import Ctx, Operator
from annotator.web.jobs.records import Job, JobRequest

router = APIRouter(tags=["jobs"])

JobId = Annotated[str, Path(pattern="^[0-9a-f]{32}$")]


class JobList(BaseModel):
    """All jobs, the newest first."""

    jobs: list[Job]


@router.post("/api/projects/{project}/jobs", status_code=201)
def begin(project: str, body: Annotated[JobRequest, Body()], ctx: Ctx, who: Operator) -> Job:
    """Train, propose, export, or take over labels; waits until other work has ended."""
    return ctx.jobs.add(project, ctx.project(project).path, body, who)


@router.get("/api/jobs")
def jobs(ctx: Ctx, who: Operator) -> JobList:
    """All jobs, also of a former server."""
    return JobList(jobs=ctx.jobs.all())


@router.get("/api/jobs/{id}")
def job(id: JobId, ctx: Ctx, who: Operator) -> Job:
    """One job."""
    return ctx.jobs.get(id)


@router.post("/api/jobs/{id}/cancel")
def cancel(id: JobId, ctx: Ctx, who: Operator) -> Job:
    """Stop a job; nothing that is done already is lost."""
    return ctx.jobs.cancel(id)
