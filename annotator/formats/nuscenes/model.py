"""The tables of nuScenes, one JSON list of records each, linked by tokens.

Source: nuScenes schema (`docs/schema_nuscenes.md` of the nuscenes-devkit): metres, quaternions w x y z, sizes width
length height, times in microseconds. Other fields are ignored when reading.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from annotator.formats.json_file import Bounded3, Bounded4, BoundedPositive, BoundedTrack

Token = Annotated[str, Field(min_length=1)]
Vector3 = Bounded3
Quaternion = Bounded4


class Record(BaseModel):
    """A row of a table."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    token: Token


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


class Sensor(Record):
    """A sensor of the vehicle."""

    channel: str
    modality: str


class CalibratedSensor(Record):
    """The pose of a sensor on the vehicle: `rotation` and `translation` map its coordinates to the ego frame."""

    sensor_token: Token
    translation: Vector3
    rotation: Quaternion
    camera_intrinsic: tuple[Vector3, Vector3, Vector3] | tuple[()] = ()


class EgoPose(Record):
    """The pose of the vehicle: `rotation` and `translation` map the ego frame to the global frame."""

    timestamp: int = 0
    rotation: Quaternion
    translation: Vector3


class Log(Record):
    """A drive."""

    logfile: str
    vehicle: str
    date_captured: str
    location: str


class Scene(Record):
    """A sequence of samples."""

    log_token: Token
    nbr_samples: int
    first_sample_token: str
    last_sample_token: str
    name: str
    description: str


class Linked(Record):
    """A row with the tokens of its neighbours in time; empty at the ends."""

    prev: str = ""
    next: str = ""


class Sample(Linked):
    """An annotated moment."""

    timestamp: int
    scene_token: Token


class SampleData(Linked):
    """The data of one sensor; `filename` is relative to the dataset's root."""

    sample_token: Token
    ego_pose_token: Token
    calibrated_sensor_token: Token
    timestamp: int = 0
    fileformat: str = ""
    is_key_frame: bool
    height: int = 0
    width: int = 0
    filename: str


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
