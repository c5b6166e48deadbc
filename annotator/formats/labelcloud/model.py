"""labelCloud's JSON files: `labels/ID.json` for each cloud and `labels/_classes.json` for a project (version 1.1)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from annotator.formats.json_file import Bounded, Bounded3, BoundedPositive

CLASSES_FILE = "_classes.json"
CENTROID_REL, CENTROID_ABS, VERTICES = "centroid_rel", "centroid_abs", "vertices"


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class Axes(_Record):
    """One value per axis: metres, or angles."""

    x: Bounded
    y: Bounded
    z: Bounded


class Dimensions(_Record):
    """Full sizes along the box's own x, y, z; metres."""

    length: BoundedPositive
    width: BoundedPositive
    height: BoundedPositive


class BoxObject(_Record):
    """A labelled box: centre, sizes and angles, or its corners."""

    name: Annotated[str, Field(min_length=1)]
    centroid: Axes | None = None
    dimensions: Dimensions | None = None
    rotations: Axes | None = None
    vertices: Annotated[tuple[Bounded3, ...], Field(min_length=8, max_length=8)] | None = None

    @model_validator(mode="after")
    def _is_a_box(self) -> BoxObject:
        if self.vertices is None and None in (self.centroid, self.dimensions, self.rotations):
            raise ValueError("a box needs centroid, dimensions and rotations, or vertices")
        return self


class LabelFile(_Record):
    """The labels of one cloud. The cloud's location is written but not read: a label file's own stem is its id."""

    folder: str = ""
    filename: str = ""
    path: str = ""
    objects: tuple[BoxObject, ...]


class ClassEntry(_Record):
    """A class with its number and colour (#rrggbb)."""

    name: str
    id: int
    color: str


class Creator(_Record):
    """The program that wrote a file."""

    name: str
    version: str


class ClassesFile(_Record):
    """The classes, and the box form of all label files."""

    classes: tuple[ClassEntry, ...]
    default: int = 0
    type: Literal["object_detection", "semantic_segmentation"] = "object_detection"
    format: str = CENTROID_REL
    created_with: Creator | None = None
