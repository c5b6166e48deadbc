"""Projects: list, create, read, change, rename, remove. A job copies them."""

from __future__ import annotations

import shlex
from typing import Annotated

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from annotator.project import BoxRotation, ProjectSettings, create_project, list_projects
from annotator.project.tidying.folders import rename_project, set_aside
from annotator.web.context import Ctx, Operator
from annotator.web.projects import ProjectInfo, ProjectSummary, project_info, summary, summary_of

router = APIRouter(tags=["projects"])

ClassName = Annotated[str, Field(min_length=1, max_length=64)]
Classes = Annotated[list[ClassName], Field(min_length=1, max_length=200)]


class NewProject(BaseModel):
    """A project to create."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(max_length=64)
    classes: Classes
    rotation: BoxRotation = BoxRotation.AUTO


class ProjectChange(BaseModel):
    """Changes of a project; null = unchanged."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    classes: Classes | None = None
    rotation: BoxRotation | None = None


class NewName(BaseModel):
    """The new name of a project."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(max_length=64)


class RemovedProject(BaseModel):
    """Where a removed project is now, and the command that brings it back."""

    folder: str
    command: str


class ProjectList(BaseModel):
    """All projects."""

    projects: list[ProjectSummary]


@router.get("/api/projects")
def projects(ctx: Ctx, operator: Operator) -> ProjectList:
    """All projects in the server's projects folder."""
    return ProjectList(projects=[summary(ctx, listed) for listed in list_projects(ctx.settings.projects_root)])


@router.post("/api/projects", status_code=201)
def create(body: NewProject, ctx: Ctx, operator: Operator) -> ProjectSummary:
    """Create a project."""
    settings = ProjectSettings(rotation=body.rotation)
    create_project(ctx.settings.projects_root, body.name, body.classes, settings=settings).close()
    return summary_of(body.name, ctx.project(body.name))


@router.get("/api/projects/{project}")
def project(project: str, ctx: Ctx, operator: Operator) -> ProjectInfo:
    """One project with its recordings and detectors."""
    return project_info(project, ctx.project(project))


@router.patch("/api/projects/{project}")
def change(project: str, body: ProjectChange, ctx: Ctx, operator: Operator) -> ProjectInfo:
    """Change the classes or the rotation of boxes."""
    opened = ctx.project(project)
    old = opened.config.settings
    settings = None if body.rotation is None else old.model_copy(update={"rotation": body.rotation})
    opened.configure(classes=body.classes, settings=settings, author=operator)
    return project_info(project, opened)


@router.post("/api/projects/{project}/rename")
def rename(project: str, body: NewName, ctx: Ctx, operator: Operator) -> ProjectSummary:
    """Rename a project; pages that show it are told its new name."""
    with ctx.closed(project) as folder:
        name = rename_project(folder, body.name)
    ctx.jobs.renamed(project, name)
    ctx.hub.send({"type": "renamed", "project": project, "name": name, "operator": operator})
    return summary_of(name, ctx.project(name))


@router.delete("/api/projects/{project}")
def remove(project: str, ctx: Ctx, operator: Operator) -> RemovedProject:
    """Move a project into the folder of removed ones, from which it can be brought back."""
    with ctx.closed(project) as folder:
        aside = set_aside(folder)
    ctx.hub.send({"type": "removed", "project": project, "operator": operator})
    place = ctx.public_message(str(aside.absolute()))
    return RemovedProject(folder=place, command=shlex.join(["annotator", "project", "copy", place, project]))
