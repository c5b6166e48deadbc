"""Datasets to take home."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import FileResponse
from pydantic import BaseModel

from annotator.types import ReviewState
from annotator.web.context import Ctx, Operator
from annotator.web.routes.jobs import JobId
from annotator.workflows.exporting import WRITERS, ExportFormat

router = APIRouter(tags=["exports"])


class FormatInfo(BaseModel):
    """A format that labels can leave in.

    Attributes:
        summary: for people, a few words.
        states: the labels that leave where nobody says so.
        flat: it holds 2D boxes on pictures.
    """

    name: ExportFormat
    summary: str
    states: list[ReviewState]
    flat: bool


class FormatList(BaseModel):
    """All formats, the tool's own first."""

    formats: list[FormatInfo]


@router.get("/api/export-formats")
def formats(who: Operator) -> FormatList:
    """The formats that labels can leave in."""
    found = WRITERS.items()
    return FormatList(
        formats=[FormatInfo(name=name, summary=w.summary, states=list(w.states), flat=w.flat) for name, w in found]
    )


@router.get("/api/jobs/{id}/download", response_class=FileResponse)
def download(id: JobId, ctx: Ctx, who: Operator) -> FileResponse:
    """The dataset of an export, packed; the last few of each project are kept."""
    path = ctx.jobs.file(id)
    return FileResponse(path, media_type="application/zip", filename=path.name)
