"""Projects: list, create, read, change, rename, remove (a job copies them); their classes and attributes, and values of
labels and frames.
"""

from __future__ import annotations

import logging
from typing import Annotated, Any

from fastapi import APIRouter, Body
from pydantic import BaseModel, ConfigDict, Field

from annotator.files import why_missing
from annotator.project import (
    BoxRotation,
    ListedProject,
    Project,
    ProjectSettings,
    StoredModel,
    StoredRecording,
    create_project,
    list_projects,
)
from annotator.project.classes import edit
from annotator.project.classes.attributes import AttributeName, Value
from annotator.project.config import Removed, removed_projects, rename_project, set_aside, take_back
from annotator.project.database.store import waiting_at_most
from annotator.project.overview import ClassList, list_classes
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import AnnotatorError, NotFoundError
from annotator.web.context import AtProject, Context, Ctx, InProject, Operator
from annotator.web.errors import INTERNAL
from annotator.web.frame_json import STALE, AtFrame
from annotator.web.jobs.records import Job, SampleRequest
from annotator.web.schemas import ClassName, FrameChange, FrameStateJson, Schema, Uid
from annotator.workflows.detectors import stand_in
from annotator.workflows.sample import add_sample, create_sample, is_generated

LOG = logging.getLogger("annotator.web")

# For a locked project: those after it in the list wait meanwhile.
LIST_WAIT_S = 0.2


class MissingRecording(BaseModel):
    """A recording whose path does not exist."""

    id: int
    name: str


class ProjectSummary(BaseModel):
    """One project in a list.

    Attributes:
        frames_done: number of frames with boxes of which none is an open proposal.
        first_frame: id of the first frame, if there is one.
        problem: why it cannot be opened.
        missing: recordings whose path is gone.
    """

    name: str
    classes: list[str]
    frames: int
    frames_done: int = 0
    first_frame: int | None = None
    recordings: int
    labels_by_state: dict[str, int]
    problem: str | None = None
    missing: list[MissingRecording] = []


class RecordingInfo(Schema):
    """A recording of a project.

    `missing` is True if its path does not exist; `rig_id` is the same for the cameras of a rig.
    """

    id: int
    name: str
    format: str
    frames: int
    missing: bool
    rig_id: int


class ModelInfo(Schema):
    """A trained detector, in short."""

    model_config = ConfigDict(ser_json_inf_nan="null")

    id: int
    role: DetectorKind
    name: str
    created_ns: int
    active: bool
    metrics: dict[str, float]


class ActiveDetectors(BaseModel):
    """The active detectors; `stand_in` names the detector that is used while there is no view detector, if any."""

    image: ModelInfo | None
    view: ModelInfo | None
    stand_in: str | None


class ProjectInfo(Schema):
    """One project."""

    name: str
    classes: list[str]
    class_styles: dict[str, dict[str, Any]]
    attributes: list[dict[str, Any]]
    settings: ProjectSettings
    recordings: list[RecordingInfo]
    labels_by_state: dict[str, int]
    frames: int
    detectors: ActiveDetectors


def summary(ctx: Context, listed: ListedProject) -> ProjectSummary:
    """The summary of a project in a projects folder; for one that cannot be opened, with its problem."""
    # a name that is not text in UTF-8 cannot be sent
    name = listed.path.name.encode(errors="replace").decode()
    try:
        if listed.problem is not None:
            return _broken(name, ctx.public_message(listed.problem))
        with waiting_at_most(LIST_WAIT_S):
            return summary_of(name, ctx.project(name))
    except AnnotatorError as error:
        return _broken(name, ctx.public_message(str(error)))
    except Exception:  # one project must not take the list of all down
        LOG.exception("project %s cannot be listed", name)
        return _broken(name, f"the project cannot be read: {INTERNAL}")


def summary_of(name: str, project: Project) -> ProjectSummary:
    """The summary of an open project."""
    counts = project.statistics()
    return ProjectSummary(
        name=name,
        classes=list(project.config.classes),
        frames=counts.frames,
        frames_done=counts.frames_with_labels - counts.frames_with_proposals,
        first_frame=project.frames.first(),
        recordings=counts.recordings,
        labels_by_state={state.value: number for state, number in counts.labels.by_state.items()},
        missing=[
            MissingRecording(id=recording.id, name=recording.name)
            for recording in project.recordings.all()
            if why_missing(recording.path)
        ],
    )


def project_info(at: InProject) -> ProjectInfo:
    """One project."""
    project, config = at.project, at.project.config
    return ProjectInfo.of(
        summary_of(at.name, project),
        class_styles={each: style.model_dump(mode="json") for each, style in config.class_styles.items()},
        attributes=[attribute.model_dump(mode="json") for attribute in config.attributes],
        settings=config.settings,
        recordings=[recording_info(recording) for recording in project.recordings.all()],
        detectors=ActiveDetectors(
            image=_detector(project, DetectorKind.IMAGE),
            view=_detector(project, DetectorKind.VIEW),
            stand_in=stand_in(project),
        ),
    )


def recording_info(stored: StoredRecording) -> RecordingInfo:
    """A recording of a project."""
    return RecordingInfo.of(stored, missing=why_missing(stored.path) is not None)


def model_info(model: StoredModel) -> ModelInfo:
    """A trained detector, in short."""
    return ModelInfo.of(model, name=model.path.parent.name)


def _detector(project: Project, role: DetectorKind) -> ModelInfo | None:
    model = project.models.active(role)
    return None if model is None else model_info(model)


def _broken(name: str, problem: str) -> ProjectSummary:
    return ProjectSummary(name=name, classes=[], frames=0, recordings=0, labels_by_state={}, problem=problem)


router = APIRouter(tags=["projects"])

Classes = Annotated[list[ClassName], Field(min_length=1, max_length=200)]


class NewProject(Schema):
    """A project to create."""

    name: str = Field(max_length=64)
    classes: Classes
    rotation: BoxRotation = BoxRotation.AUTO


class ProjectClasses(Schema):
    """The classes of a project, in order."""

    classes: Classes


class NewName(Schema):
    """The new name of a project."""

    name: str = Field(max_length=64)


class RemovedProject(BaseModel):
    """A removed project: the name of its folder now, its own name, and when it was removed, UTC seconds."""

    id: str
    name: str
    removed_s: float


@router.get("/api/projects")
def projects(ctx: Ctx, operator: Operator) -> list[ProjectSummary]:
    """All projects in the server's projects folder."""
    return [summary(ctx, listed) for listed in list_projects(ctx.settings.projects_root)]


@router.post("/api/projects", status_code=201)
def create(body: NewProject, ctx: Ctx, operator: Operator) -> ProjectSummary:
    """Create a project."""
    settings = ProjectSettings(rotation=body.rotation)
    create_project(ctx.settings.projects_root, body.name, body.classes, settings=settings).close()
    return summary_of(body.name, ctx.project(body.name))


class Sample(BaseModel):
    """A project to try the page with; the job generates its recording, if no earlier sample has left it."""

    name: str
    job: Job | None


@router.post("/api/sample-project", status_code=201)
def sample(ctx: Ctx, operator: Operator) -> Sample:
    """Create a project to try the page with."""
    path = create_sample(ctx.settings.projects_root)
    if is_generated(path.parent):
        add_sample(ctx.project(path.name))
        return Sample(name=path.name, job=None)
    return Sample(name=path.name, job=ctx.jobs.add(path.name, path, SampleRequest(kind="sample"), operator))


@router.get("/api/projects/{name}")
def project(at: AtProject) -> ProjectInfo:
    """One project with its recordings and detectors."""
    return project_info(at)


@router.patch("/api/projects/{name}")
def change(at: AtProject, body: ProjectClasses) -> ProjectInfo:
    """Change the classes."""
    at.project.configure(classes=body.classes, author=at.operator)
    return project_info(at)


@router.post("/api/projects/{name}/rename")
def rename(name: str, body: NewName, ctx: Ctx, operator: Operator) -> ProjectSummary:
    """Rename a project; pages that show it are told its new name."""
    with ctx.closed(name) as folder:
        new = rename_project(folder, body.name)
    ctx.jobs.renamed(name, new)
    ctx.hub.send({"type": "renamed", "project": name, "name": new, "operator": operator})
    return summary_of(new, ctx.project(new))


@router.delete("/api/projects/{name}")
def remove(name: str, ctx: Ctx, operator: Operator) -> RemovedProject:
    """Move a project into the folder of removed ones, from which it can be brought back."""
    with ctx.closed(name) as folder:
        aside = set_aside(folder)
    ctx.hub.send({"type": "removed", "project": name, "operator": operator})
    return _removed(next(each for each in removed_projects(aside.parent.parent) if each.path == aside))


@router.get("/api/removed-projects")
def removed(ctx: Ctx, operator: Operator) -> list[RemovedProject]:
    """The removed projects, the newest first."""
    return [_removed(each) for each in removed_projects(ctx.settings.projects_root)]


@router.post("/api/removed-projects/{id}/restore")
def restore(id: str, ctx: Ctx, operator: Operator) -> ProjectSummary:
    """Bring a removed project back under its name."""
    for each in removed_projects(ctx.settings.projects_root):
        if each.path.name == id:
            return summary(ctx, ListedProject(take_back(each), None))
    raise NotFoundError(f"there is no removed project {id!r}; it may have been brought back already")


def _removed(each: Removed) -> RemovedProject:
    return RemovedProject(id=each.path.name, name=each.name, removed_s=each.at.timestamp())


class BoxKindIn(Schema):
    """What the 2D boxes enclose that people draw."""

    box_kind: BoxKind


@router.put("/api/projects/{name}/box-kind", status_code=204)
def set_box_kind(at: AtProject, body: BoxKindIn) -> None:
    """Set what drawn 2D boxes enclose, for all operators; those of a frame that has some stay as they are."""
    settings = at.project.config.settings.model_copy(update={"box_kind": body.box_kind})
    at.project.configure(settings=settings)
    at.ctx.hub.send({"type": "classes", "project": at.name, "renamed": {}, "operator": at.operator})


class ValuesIn(FrameChange):
    """Values to set, null = none; of a label `uid`, or of the frame."""

    uid: Uid | None = None
    values: Annotated[dict[AttributeName, Value | None], Field(min_length=1, max_length=100)]


@router.get("/api/projects/{name}/classes")
def classes(at: AtProject) -> ClassList:
    """The classes and attributes, with the numbers of their boxes and values."""
    return list_classes(at.project)


@router.post("/api/projects/{name}/classes")
def change_classes_of(at: AtProject, body: Annotated[edit.ClassChange, Body()]) -> ProjectInfo:
    """Change the classes or attributes; labels follow. One undo step."""
    at.project.change_classes(body, at.operator)
    return project_info(at)


@router.post("/api/projects/{name}/frames/{frame_id}/attributes", responses=STALE)
def set_values(at: AtFrame, body: ValuesIn) -> FrameStateJson:
    """Set values of a label, or of the frame; those of a track in all its labels, as one action."""
    context, project = body.context(at.operator, body.uid), at.project
    with at.change(body):
        if body.uid is None:
            project.frames.set_attributes(at.frame_id, body.values, context)
        else:
            project.labels.set_attributes(at.frame_id, body.uid, body.values, context)
    return at.state()
