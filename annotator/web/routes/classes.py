"""Classes and attributes of a project, and values of labels and frames."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter
from pydantic import Field, ValidationError

from annotator.project import ProjectConfig
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, ClassStyle, Value
from annotator.project.classes.edit import ClassEdit
from annotator.project.overview import ClassList, list_classes
from annotator.project.project import change_classes
from annotator.types.errors import ConfigError
from annotator.types.messages import first_problem
from annotator.web.context import AtProject
from annotator.web.frame_json import STALE, AtFrame
from annotator.web.routes.projects import ProjectInfo, project_info
from annotator.web.schemas import ClassName, FrameChange, FrameStateJson, Schema, Uid

router = APIRouter(tags=["classes"])

ClassNames = Annotated[list[ClassName], Field(min_length=1, max_length=1000)]
Text = Annotated[str, Field(max_length=1000)]


class Add(Schema):
    """Adds a class, with a colour and a key."""

    do: Literal["add"]
    name: ClassName
    style: dict[Literal["colour", "key"], Text | None] = Field(default_factory=dict)

    def edit(self, config: ProjectConfig) -> ClassEdit:
        return edit.add_class(config, self.name, ClassStyle.model_validate(self.style))


class Style(Schema):
    """Sets colour and key of a class; null = none, what is not given stays."""

    do: Literal["style"]
    name: ClassName
    style: dict[Literal["colour", "key"], Text | None]

    def edit(self, config: ProjectConfig) -> ClassEdit:
        before = config.class_styles.get(self.name, ClassStyle())
        return edit.style_class(config, self.name, ClassStyle.model_validate(before.model_dump() | self.style))


class Rename(Schema):
    """Renames a class; its boxes follow."""

    do: Literal["rename"]
    name: ClassName
    new: ClassName

    def edit(self, config: ProjectConfig) -> ClassEdit:
        return edit.rename_class(config, self.name, self.new)


class Merge(Schema):
    """Gives the boxes of classes to another class, and removes these classes."""

    do: Literal["merge"]
    names: ClassNames
    into: ClassName

    def edit(self, config: ProjectConfig) -> ClassEdit:
        return edit.merge_classes(config, self.names, self.into)


class Remove(Schema):
    """Removes a class, one with boxes only if they are to be removed, too; or an attribute with its values."""

    do: Literal["remove", "remove_attribute"]
    name: ClassName
    with_boxes: bool = False

    def edit(self, config: ProjectConfig) -> ClassEdit:
        if self.do == "remove_attribute":
            return edit.remove_attribute(config, self.name)
        made = edit.remove_class(config, self.name)
        return made if self.with_boxes else ClassEdit(made.config)


class Order(Schema):
    """Orders the classes or the attributes."""

    do: Literal["order", "order_attributes"]
    names: ClassNames

    def edit(self, config: ProjectConfig) -> ClassEdit:
        reorder = edit.order_classes if self.do == "order" else edit.order_attributes
        return reorder(config, self.names)


class PutAttribute(Schema):
    """Adds or replaces an attribute, as in `project.json`; `drop` removes values that do not fit."""

    do: Literal["attribute"]
    attribute: dict[Annotated[str, Field(max_length=64)], Any]
    drop: bool = False

    def edit(self, config: ProjectConfig) -> ClassEdit:
        return edit.put_attribute(config, Attribute.model_validate(self.attribute), drop=self.drop)


class RenameAttribute(Schema):
    """Renames an attribute, or one of its choices; values follow."""

    do: Literal["rename_attribute"]
    name: ClassName
    choice: ClassName | None = None
    new: ClassName

    def edit(self, config: ProjectConfig) -> ClassEdit:
        if self.choice is not None:
            return edit.rename_choice(config, self.name, self.choice, self.new)
        return edit.rename_attribute(config, self.name, self.new)


class ClassChange(Schema):
    """One change of the classes or attributes."""

    change: Annotated[
        Add | Style | Rename | Merge | Remove | Order | PutAttribute | RenameAttribute, Field(discriminator="do")
    ]


class ValuesIn(FrameChange):
    """Values to set, null = none; of a label `uid`, or of the frame."""

    uid: Uid | None = None
    values: Annotated[dict[ClassName, Value | None], Field(min_length=1, max_length=100)]


@router.get("/api/projects/{name}/classes")
def classes(at: AtProject) -> ClassList:
    """The classes and attributes, with the numbers of their boxes and values."""
    return list_classes(at.project)


@router.post("/api/projects/{name}/classes")
def change(at: AtProject, body: ClassChange) -> ProjectInfo:
    """Change the classes or attributes; labels follow. What no other change brings back is backed up before."""
    try:
        change_classes(at.project, body.change.edit, at.operator)
    except ValidationError as error:
        raise ConfigError(first_problem(error)) from error
    return project_info(at)


@router.post("/api/projects/{name}/frames/{frame_id}/attributes", responses=STALE)
def set_values(at: AtFrame, body: ValuesIn) -> FrameStateJson:
    """Set values of a label, or of the frame; those of a track in all its labels, as one action."""
    context, project = body.context(at.operator, body.uid), at.project
    with at.change(body) as changed:
        if body.uid is None:
            changed.append((at.frame_id, project.frames.set_attributes(at.frame_id, body.values, context)))
        else:
            changed += project.labels.set_attributes(at.frame_id, body.uid, body.values, context)
    return at.state()
