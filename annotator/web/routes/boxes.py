"""Boxes from files: what a file would give, before a job imports it."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Body, Path, Query
from pydantic import BaseModel

from annotator.project import Project
from annotator.web.context import Ctx, Operator
from annotator.web.schemas import RowId
from annotator.web.uploads import Upload, add_upload, find_upload, remove_upload
from annotator.workflows.importing import BoxFormat, FlatFormat, preview_boxes

router = APIRouter(prefix="/api/projects/{project}/boxes-files", tags=["boxes"])

UploadId = Annotated[str, Path(pattern="^[0-9a-f]{32}$")]
FileName = Annotated[str, Query(min_length=1, max_length=255)]
Content = Annotated[bytes, Body(media_type="application/octet-stream")]


class BoxesFile(BaseModel):
    """A file with 2D boxes on camera images, or with 3D boxes.

    Attributes:
        ambiguous: number of its images or frames that fit frames of several recordings: one of these must be chosen.
        boxes: number of boxes that the project has a frame for, by class.
        scores: of 3D boxes: the lowest and the highest score, if there are any.
        source: name that 3D boxes have as a source of proposals, unless another is given.
        found: a sentence about what it has; `notes` say what an import leaves out, replaces or does not change.
    """

    id: str
    name: str
    format: FlatFormat | BoxFormat
    is_3d: bool
    ambiguous: int
    boxes: dict[str, int]
    scores: tuple[float, float] | None
    source: str
    found: str
    notes: tuple[str, ...]


@router.post("", status_code=201)
def upload(project: str, name: FileName, content: Content, ctx: Ctx, operator: Operator) -> BoxesFile:
    """Send a JSON file of 2D or 3D boxes, a CSV file of 3D boxes, or a packed folder of boxes. Nothing is imported."""
    opened = ctx.project(project)
    stored = add_upload(opened, name, content, ctx.jobs.uploads_in_use(opened.path))
    try:
        return _described(opened, stored, None)
    except BaseException:
        remove_upload(opened, stored.id)
        raise


@router.get("/{id}")
def look(project: str, id: UploadId, ctx: Ctx, operator: Operator, recording: RowId | None = None) -> BoxesFile:
    """A file that was sent, matched with one recording, or with all."""
    opened = ctx.project(project)
    return _described(opened, find_upload(opened, id), recording)


def _described(project: Project, upload: Upload, recording: int | None) -> BoxesFile:
    name = None if recording is None else project.recordings.get(recording).name
    found = preview_boxes(project, upload.path, upload.format, name)
    return BoxesFile(
        id=upload.id,
        name=upload.path.name,
        format=upload.format,
        is_3d=found.is_3d,
        ambiguous=found.ambiguous,
        boxes=found.boxes,
        scores=None if found.scores is None else (found.scores.low, found.scores.high),
        source=upload.path.stem,
        found=found.found,
        notes=found.notes,
    )
