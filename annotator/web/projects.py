"""Projects as the page shows them."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict

from annotator.files import why_missing
from annotator.project import ListedProject, Project, Role, StoredModel, StoredRecording
from annotator.types.errors import AnnotatorError
from annotator.web.context import Context


class MissingRecording(BaseModel):
    """A recording that is not where it was."""

    id: int
    name: str


class ProjectSummary(BaseModel):
    """One project in a list; `problem` says why it cannot be opened, `missing` which recordings are to be located."""

    name: str
    classes: list[str]
    frames: int
    recordings: int
    labels_by_state: dict[str, int]
    problem: str | None = None
    missing: list[MissingRecording] = []


class RecordingInfo(BaseModel):
    """A recording of a project; it is missing where its folder has gone."""

    id: int
    name: str
    format: str
    frames: int
    is_sequence: bool
    missing: bool


class ModelInfo(BaseModel):
    """A trained detector, in short."""

    model_config = ConfigDict(ser_json_inf_nan="null")

    id: int
    role: Role
    name: str
    created_ns: int
    active: bool
    metrics: dict[str, float]


class ActiveDetectors(BaseModel):
    """The two detectors that propose."""

    image: ModelInfo | None
    view: ModelInfo | None


class ProjectInfo(BaseModel):
    """One project."""

    name: str
    classes: list[str]
    settings: dict[str, Any]
    recordings: list[RecordingInfo]
    labels_by_state: dict[str, int]
    frames: int
    detectors: ActiveDetectors


def summary(ctx: Context, listed: ListedProject) -> ProjectSummary:
    """A project in a list; one that cannot be opened says why."""
    name = listed.path.name
    classes = [] if listed.config is None else list(listed.config.classes)
    try:
        if listed.problem is not None:
            return _broken(name, classes, ctx.told(listed.problem))
        return summary_of(name, ctx.project(name))
    except AnnotatorError as error:
        return _broken(name, classes, ctx.told(str(error)))


def summary_of(name: str, project: Project) -> ProjectSummary:
    """An open project in a list."""
    counts = project.statistics()
    return ProjectSummary(
        name=name,
        classes=list(project.config.classes),
        frames=counts.frames,
        recordings=counts.recordings,
        labels_by_state={state.value: number for state, number in counts.labels.by_state.items()},
        missing=[
            MissingRecording(id=recording.id, name=recording.name)
            for recording in project.recordings.all()
            if why_missing(recording.path)
        ],
    )


def project_info(name: str, project: Project) -> ProjectInfo:
    """One project."""
    short, config = summary_of(name, project), project.config
    return ProjectInfo(
        name=name,
        classes=short.classes,
        settings=config.settings.model_dump(mode="json"),
        recordings=[recording_info(recording) for recording in project.recordings.all()],
        labels_by_state=short.labels_by_state,
        frames=short.frames,
        detectors=ActiveDetectors(
            image=_detector(project, Role.IMAGE),
            view=_detector(project, Role.VIEW),
        ),
    )


def recording_info(stored: StoredRecording) -> RecordingInfo:
    """A recording of a project."""
    return RecordingInfo(
        id=stored.id,
        name=stored.name,
        format=stored.format,
        frames=stored.frames,
        is_sequence=stored.is_sequence,
        missing=why_missing(stored.path) is not None,
    )


def model_info(model: StoredModel) -> ModelInfo:
    """A trained detector, in short."""
    return ModelInfo(
        id=model.id,
        role=model.role,
        name=model.path.parent.name,
        created_ns=model.created_ns,
        active=model.active,
        metrics=model.metrics,
    )


def _detector(project: Project, role: Role) -> ModelInfo | None:
    model = project.models.active(role)
    return None if model is None else model_info(model)


def _broken(name: str, classes: list[str], problem: str) -> ProjectSummary:
    return ProjectSummary(name=name, classes=classes, frames=0, recordings=0, labels_by_state={}, problem=problem)
