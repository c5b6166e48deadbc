"""The list of a project's classes and attributes, for the command line and the page."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel, ConfigDict

from annotator.project.classes.attributes import Attribute, ClassStyle
from annotator.project.classes.counting import ClassCounts
from annotator.project.project import Project


class ClassRow(BaseModel):
    """A class as JSON; the counts as in `ClassCounts`."""

    model_config = ConfigDict(frozen=True)

    name: str
    labels: int
    boxes_2d: int
    said: int
    colour: str | None
    key: str | None


class ClassList(BaseModel):
    """The classes and attributes as JSON.

    Attributes:
        unknown: names of boxes that are no classes of the project.
        values: how many boxes and frames have a value, by attribute.
    """

    model_config = ConfigDict(frozen=True)

    classes: tuple[ClassRow, ...]
    attributes: tuple[Attribute, ...]
    unknown: tuple[ClassRow, ...]
    values: dict[str, int]


def list_classes(project: Project) -> ClassList:
    """The classes and attributes of a project, with the numbers of their boxes and values."""
    config, counts, values = project.config, project.class_counts(), project.value_counts()
    return ClassList(
        classes=tuple(_row(name, counts, config.class_styles) for name in config.classes),
        attributes=config.attributes,
        unknown=tuple(_row(name, counts, {}) for name in counts if name not in config.classes),
        values={name: sum(by_value.values()) for name, by_value in values.items()},
    )


def _row(name: str, counts: Mapping[str, ClassCounts], styles: Mapping[str, ClassStyle]) -> ClassRow:
    count, style = counts.get(name, ClassCounts()), styles.get(name, ClassStyle())
    counted = {"labels": count.labels, "boxes_2d": count.boxes_2d, "said": count.said}
    return ClassRow(name=name, **counted, colour=style.colour, key=style.key)
