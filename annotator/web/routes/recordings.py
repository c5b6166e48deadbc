"""Recordings into a project."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from annotator.types.errors import InputError
from annotator.web.context import Ctx, Operator
from annotator.web.jobs.records import ImportRequest, Job
from annotator.web.projects import RecordingInfo, recording_info
from annotator.web.wire import RowId
from annotator.workflows.own_labels import brings_labels
from annotator.workflows.recordings import add_recordings, move_recording

router = APIRouter(prefix="/api/projects/{project}/recordings", tags=["recordings"])


class Place(BaseModel):
    """Where a recording is, below one of the server's folders."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: str = Field(min_length=1, max_length=4096)


class NewRecording(Place):
    """Which recording, and whether the 3D boxes that it brings become labels."""

    labels: bool = True


class AddedRecording(BaseModel):
    """What became of it.

    Attributes:
        is_new: False where the project had it already and only looked for new frames.
    """

    recording: RecordingInfo
    is_new: bool
    new_frames: int
    missing_frames: int


class AddedRecordings(BaseModel):
    """What became of the recordings.

    Attributes:
        job: reads the boxes that they bring, where there are any.
        note: why there is no such job although there are boxes, and what to do.
    """

    added: list[AddedRecording]
    job: Job | None = None
    note: str | None = None


@router.post("")
def add(project: str, body: NewRecording, ctx: Ctx, who: Operator) -> AddedRecordings:
    """Put a recording of one of the server's folders into a project; its files stay where they are."""
    opened, path = ctx.project(project), ctx.folders.find(body.path)
    done = add_recordings(opened, [path])
    ctx.annotation.frames.forget(opened)
    added = [
        AddedRecording(
            recording=recording_info(one.recording),
            is_new=one.is_new,
            new_frames=one.new_frames,
            missing_frames=one.missing_frames,
        )
        for one in done
    ]
    if not body.labels:
        return AddedRecordings(added=added)
    try:
        bringing = [one.recording.id for one in done if brings_labels(opened, one.recording.id)]
        request = ImportRequest(kind="import", recordings=bringing) if bringing else None
        job = None if request is None else ctx.jobs.add(project, opened.path, request, who)
    except InputError as error:
        # the recordings are there all the same
        return AddedRecordings(
            added=added, note=f"Its 3D boxes are not read: {ctx.told(str(error))}. Then add it again."
        )
    return AddedRecordings(added=added, job=job)


@router.patch("/{recording}")
def move(project: str, recording: RowId, body: Place, ctx: Ctx, who: Operator) -> RecordingInfo:
    """Point a recording whose folder was moved to its new place; all its frames must be there."""
    opened, path = ctx.project(project), ctx.folders.find(body.path)
    moved = move_recording(opened, recording, path, who)
    ctx.annotation.frames.forget(opened)
    return recording_info(moved)
