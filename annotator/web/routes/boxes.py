"""Boxes from files: what a file would give, before a job imports it."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Body, Path, Query
from pydantic import BaseModel

from annotator.project import Project
from annotator.web.context import Ctx, Operator
from annotator.web.schemas import RowId
from annotator.web.uploads import Upload, add_upload, find_upload, remove_upload
from annotator.workflows.importing import BoxFormat, FlatFormat, preview, preview_3d

router = APIRouter(tags=["jobs"])

UploadId = Annotated[str, Path(pattern="^[0-9a-f]{32}$")]
FileName = Annotated[str, Query(min_length=1, max_length=255)]
Content = Annotated[bytes, Body(media_type="application/octet-stream")]
# Number of image names that are shown.
SHOWN = 5


class BoxesFile(BaseModel):
    """A file with 2D boxes on camera images, or with 3D boxes.

    Attributes:
        images: number of its images; of 3D boxes, of its frames.
        unmatched: number of those without a frame in the project; `unmatched_names` are some of them.
        ambiguous: number of those that fit frames of several recordings: one of these must be chosen.
        boxes: number of boxes on the others, by class name.
        replaced: number of images with boxes drawn in the project, which the import replaces.
        labelled: of 3D boxes: number of frames that an import as labels leaves unchanged: those with labels or
            proposals, and finalised ones; null for 2D boxes.
        finalised: of 3D boxes: number of finalised frames, which an import as proposals leaves unchanged, too.
        scores: of 3D boxes: the lowest and the highest score, if there are any.
        source: name that 3D boxes have as a source of proposals, unless another is given.
        renamed: the file's recording, if the project has none of this name; `taken_for` are those it was matched with.
    """

    id: str
    name: str
    format: FlatFormat | BoxFormat
    images: int
    unmatched: int
    unmatched_names: list[str]
    ambiguous: int
    boxes: dict[str, int]
    replaced: int
    labelled: int | None
    finalised: int | None
    scores: tuple[float, float] | None
    source: str
    renamed: str | None
    taken_for: list[str]


@router.post("/api/projects/{project}/boxes-files", status_code=201)
def upload(project: str, name: FileName, content: Content, ctx: Ctx, operator: Operator) -> BoxesFile:
    """Send a JSON file of 2D or 3D boxes, a CSV file of 3D boxes, or a packed folder of boxes. Nothing is imported."""
    opened = ctx.project(project)
    stored = add_upload(opened, name, content, ctx.jobs.uploads_in_use(opened.path))
    try:
        return _described(opened, stored, None)
    except BaseException:
        remove_upload(opened, stored.id)
        raise


@router.get("/api/projects/{project}/boxes-files/{id}")
def look(project: str, id: UploadId, ctx: Ctx, operator: Operator, recording: RowId | None = None) -> BoxesFile:
    """A file that was sent, matched with one recording, or with all."""
    opened = ctx.project(project)
    return _described(opened, find_upload(opened, id), recording)


def _described(project: Project, upload: Upload, recording: int | None) -> BoxesFile:
    name = None if recording is None else project.recordings.get(recording).name
    if isinstance(upload.format, FlatFormat):
        found, labelled, scores = preview(project, upload.path, upload.format, name), None, None
        finalised = None
    else:
        found = preview_3d(project, upload.path, upload.format, name)
        labelled, finalised = found.labelled, found.finalised
        scores = None if found.scores is None else (found.scores.low, found.scores.high)
    return BoxesFile(
        id=upload.id,
        name=upload.path.name,
        format=upload.format,
        images=found.images,
        unmatched=len(found.unmatched),
        unmatched_names=list(found.unmatched[:SHOWN]),
        ambiguous=found.ambiguous,
        boxes=found.boxes,
        replaced=found.replaced,
        labelled=labelled,
        finalised=finalised,
        scores=scores,
        source=upload.path.stem,
        renamed=None if found.renamed is None else found.renamed.named,
        taken_for=[] if found.renamed is None else list(found.renamed.taken_for),
    )
