"""Recordings into a project."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from annotator.web.context import Ctx, Operator
from annotator.web.projects import RecordingInfo, recording_info
from annotator.workflows.own_labels import OwnLabels, import_own_labels
from annotator.workflows.recordings import add_recordings

router = APIRouter(prefix="/api/projects/{project}/recordings", tags=["recordings"])


class NewRecording(BaseModel):
    """Which recording, and whether the 3D boxes that it brings become labels."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: str = Field(min_length=1, max_length=4096)
    labels: bool = True


class AddedRecording(BaseModel):
    """What became of it.

    Attributes:
        is_new: False where the project had it already and only looked for new frames.
        labels: imported boxes by class.
        left_out: boxes of classes that the project does not have, by class.
        unreadable: frames whose labels could not be read.
    """

    recording: RecordingInfo
    is_new: bool
    new_frames: int
    missing_frames: int
    labels: dict[str, int]
    left_out: dict[str, int]
    unreadable: list[str]


class AddedRecordings(BaseModel):
    """What became of the recordings."""

    added: list[AddedRecording]


@router.post("")
def add(project: str, body: NewRecording, ctx: Ctx, who: Operator) -> AddedRecordings:
    """Put a recording of one of the server's folders into a project; its files stay where they are."""
    opened, path = ctx.project(project), ctx.folders.find(body.path)
    answers = []
    for added in add_recordings(opened, [path]):
        own = import_own_labels(opened, added.recording.id) if body.labels else OwnLabels()
        answers.append(
            AddedRecording(
                recording=recording_info(added.recording),
                is_new=added.is_new,
                new_frames=added.new_frames,
                missing_frames=added.missing_frames,
                labels=dict(own.labels),
                left_out=dict(own.other_classes),
                unreadable=own.unreadable[:20],
            )
        )
    ctx.annotation.frames.forget(opened)
    return AddedRecordings(added=answers)
