"""Datasets to take home."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import FileResponse

from annotator.web.context import Ctx, Operator
from annotator.web.routes.jobs import JobId

router = APIRouter(tags=["exports"])


@router.get("/api/jobs/{id}/download", response_class=FileResponse)
def download(id: JobId, ctx: Ctx, who: Operator) -> FileResponse:
    """The dataset of an export, packed; the last few of each project are kept."""
    path = ctx.jobs.file(id)
    return FileResponse(path, media_type="application/zip", filename=path.name)
