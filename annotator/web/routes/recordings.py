"""Recordings: the folders that they may be added from; listing, adding, moving and removing them."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from annotator.project import REVIEWED
from annotator.recordings import ReaderOptions
from annotator.recordings.recording import parse_options
from annotator.types import ReviewState
from annotator.types.errors import InputError
from annotator.web.context import AtProject, Ctx, InProject, Operator
from annotator.web.folders import FolderListing
from annotator.web.jobs.records import ImportRequest, Job
from annotator.web.routes.projects import RecordingInfo, recording_info
from annotator.web.schemas import RowId, Schema
from annotator.workflows.add_recordings import add_recordings, bring_back, move_recording
from annotator.workflows.recorded.own_labels import has_own_labels
from annotator.workflows.workbench.frame_state import BagPreview, preview_bag

router = APIRouter(tags=["recordings"])

BagPath = Annotated[str, Query(min_length=1, max_length=4096)]
TopicName = Annotated[str | None, Query(max_length=1024)]


@router.get("/api/bags")
def bag(
    ctx: Ctx,
    operator: Operator,
    path: BagPath,
    image: TopicName = None,
    points: TopicName = None,
    depth: TopicName = None,
    camera_info: TopicName = None,
    depth_info: TopicName = None,
) -> BagPreview:
    """The topics of a bag below one of the server's folders, and its first frame with these topics."""
    chosen = {
        "image": image, "points": points, "depth": depth, "camera_info": camera_info, "depth_info": depth_info,
    }  # fmt: skip
    options = parse_options(**{name: topic or None for name, topic in chosen.items()})
    found = preview_bag(ctx.folders.find(path), options)
    return replace(found, problem=_public(ctx, found.problem, [topic.name for topic in found.topics]))


def _public(ctx: Ctx, text: str, topics: list[str]) -> str:
    """Returns a message for browsers, in which the names of topics, which look like paths, stay."""
    names = sorted(topics, key=len, reverse=True)
    for number, name in enumerate(names):
        text = text.replace(name, f"<{number}>")
    # with the names of the options: the page has a field for each
    text = ctx.without_paths(text)
    for number, name in enumerate(names):
        text = text.replace(f"<{number}>", name)
    return text


FolderPath = Annotated[str, Query(max_length=4096)]

MOVED: dict[int | str, dict[str, Any]] = {
    400: {"description": "If it is a recording of the project that has only moved, `moved` has its id and name."}
}


class RecordingPath(Schema):
    """The path of a recording below one of the server's folders, such as `ROOT/sub/take`."""

    path: str = Field(min_length=1, max_length=4096)


class NewRecording(RecordingPath):
    """A recording to add.

    Attributes:
        labels: also import the 3D boxes that it contains.
        as_new: add it even if it seems to be one of the project that has only moved.
        leave_out_broken: leave out the frames that cannot be read.
        options: how it is read.
    """

    labels: bool = True
    as_new: bool = False
    leave_out_broken: bool = False
    options: ReaderOptions = ReaderOptions()


class ListedRecording(RecordingInfo):
    """A recording with its first frame and the numbers of its labels.

    `removed_by` is null unless it was removed from the project.
    """

    first: int | None
    labels: int
    reviewed: int
    proposed: int
    removed_by: str | None


class AddedRecording(Schema):
    """Result for one added recording.

    Attributes:
        is_new: False for a recording that the project had already; it was scanned for new frames.
        notes: what the reader says about it; one sentence each.
        broken: how many frames cannot be read, and why; one sentence each.
        left_out: number of those that are no frames of the project.
        can_leave_out: some of them are.
    """

    recording: RecordingInfo
    is_new: bool
    new_frames: int
    notes: tuple[str, ...]
    broken: list[str]
    left_out: int
    can_leave_out: bool


class AddedRecordings(BaseModel):
    """Results for the added recordings.

    Attributes:
        job: imports their 3D boxes, if there are any.
        note: the reason why there is no such job although there are boxes, and what to do.
    """

    added: list[AddedRecording]
    job: Job | None = None
    note: str | None = None


@router.get("/api/folders")
def folders(ctx: Ctx, operator: Operator, path: FolderPath = "") -> FolderListing:
    """The sub-folders and recordings in a folder, and what is not listed; "" lists the server's folders."""
    return ctx.folders.list(path)


@router.get("/api/projects/{name}/recordings")
def recordings(at: AtProject) -> list[ListedRecording]:
    """The recordings of a project, also those that were removed from it."""
    stored = at.project.recordings
    labels = stored.label_counts()
    reviewed, proposed = stored.label_counts(REVIEWED), stored.label_counts([ReviewState.PROPOSED])
    return [
        ListedRecording(
            **dict(recording_info(each)),
            first=at.project.frames.first(each.id),
            labels=labels.get(each.id, 0),
            reviewed=reviewed.get(each.id, 0),
            proposed=proposed.get(each.id, 0),
            removed_by=each.removed_by,
        )
        for each in (*stored.all(), *stored.removed())
    ]


@router.post("/api/projects/{name}/recordings", responses=MOVED)
def add(at: AtProject, body: NewRecording) -> AddedRecordings:
    """Add a recording below one of the server's folders to a project; its files are not copied."""
    ctx, opened = at.ctx, at.project
    path = ctx.folders.find(body.path)
    results = add_recordings(
        opened, [path], options=body.options, as_new=body.as_new, leave_out_broken=body.leave_out_broken
    )
    ctx.caches.frames.forget(opened)
    added = [
        AddedRecording.of(
            result,
            recording=recording_info(result.recording),
            notes=tuple(ctx.public_message(text) for text in result.notes),
            broken=[ctx.public_message(text) for text in result.broken.sentences],
            can_leave_out=len(result.broken.errors) > result.left_out,
        )
        for result in results
    ]
    if not body.labels:
        return AddedRecordings(added=added)
    try:
        with_labels = [result.recording.id for result in results if has_own_labels(opened, result.recording.id)]
        request = ImportRequest(kind="import", recordings=tuple(with_labels)) if with_labels else None
        job = None if request is None else ctx.jobs.add(at.name, opened.path, request, at.operator)
    except InputError as error:
        # the recordings have been added
        reason = ctx.public_message(str(error))
        note = f"Its 3D boxes were not imported: {reason}. To import them, add the recording again."
        return AddedRecordings(added=added, note=note)
    return AddedRecordings(added=added, job=job)


@router.patch("/api/projects/{name}/recordings/{recording}")
def move(at: AtProject, recording: RowId, body: RecordingPath) -> RecordingInfo:
    """Set the new path of a moved recording; all its frames must be there."""
    moved = move_recording(at.project, recording, at.ctx.folders.find(body.path))
    at.ctx.caches.frames.forget(at.project)
    return recording_info(moved)


@router.delete("/api/projects/{name}/recordings/{recording}")
def remove(at: AtProject, recording: RowId) -> list[ListedRecording]:
    """Remove a recording from a project; its labels stay in the history and come back with it."""
    at.project.recordings.remove(recording, at.operator)
    return _changed(at)


@router.post("/api/projects/{name}/recordings/{recording}/restore")
def restore(at: AtProject, recording: RowId) -> list[ListedRecording]:
    """Bring a removed recording back, with its labels."""
    bring_back(at.project, recording)
    return _changed(at)


def _changed(at: InProject) -> list[ListedRecording]:
    at.ctx.caches.frames.forget(at.project)
    at.announce()
    return recordings(at)
