"""The tables of nuScenes, one JSON list of records each, linked by tokens.

Source: nuScenes schema (`docs/schema_nuscenes.md` of the nuscenes-devkit): metres, quaternions w x y z, sizes width
length height. Other fields are ignored when reading. `annotator.nuscenes_tables` has the tables of the sensors.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from annotator.formats.json_file import Bounded3, Bounded4, BoundedPositive, BoundedTrack
from annotator.nuscenes_tables import Linked, Record, Token

Vector3 = Bounded3
Quaternion = Bounded4


class Category(Record):
    """A class."""

    name: Annotated[str, Field(min_length=1)]
    description: str = ""


class Attribute(Record):
    """A property that an annotation may have."""

    name: str
    description: str = ""


class Visibility(Record):
    """A level of visibility of an object."""

    level: str
    description: str = ""


class Instance(Record):
    """An object in all samples of its scene. `track_id` is annotator's extension: the id in the project."""

    category_token: Token
    nbr_annotations: int
    first_annotation_token: str
    last_annotation_token: str
    track_id: BoundedTrack | None = None


class Log(Record):
    """A drive."""

    logfile: str
    vehicle: str
    date_captured: str
    location: str


class SampleAnnotation(Linked):
    """A box of a sample, global frame; its x axis is the length, y the width."""

    sample_token: Token
    instance_token: Token
    visibility_token: str = ""
    attribute_tokens: tuple[str, ...] = ()
    translation: Vector3
    size: tuple[BoundedPositive, BoundedPositive, BoundedPositive]
    rotation: Quaternion
    num_lidar_pts: int = 0
    num_radar_pts: int = 0


class Map(Record):
    """A map image of the ground, for a set of drives."""

    log_tokens: tuple[str, ...]
    category: Literal["semantic_prior"] = "semantic_prior"
    filename: str
