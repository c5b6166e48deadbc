"""The parts of an OpenLABEL 1.0.0 document that boxes need. Source: the ASAM standard and its JSON schema.

Names and nesting are the standard's. Other parts of a document (other geometry, actions, relations, ontologies) are
ignored when reading. Optional parts are None and are left out when writing.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from annotator.formats.json_file import Bounded, Bounded3, Bounded4, Exact

SCHEMA_VERSION = "1.0.0"

# Frames are numbered; elements have a number or a UUID.
FrameNumber = Annotated[str, StringConstraints(pattern=r"^[0-9]{1,18}$")]
Uid = Annotated[str, StringConstraints(pattern=r"^(-?[0-9]{1,18}|[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12})$")]
Timestamp = Annotated[str | Bounded, Field(union_mode="left_to_right")]
AttributeKind = Literal["num", "text", "boolean", "vec"]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class Num(_Record):
    """A named number."""

    name: str | None = None
    val: Exact


class Text(_Record):
    """A named text."""

    name: str | None = None
    val: str


class Boolean(_Record):
    """A named yes or no."""

    name: str | None = None
    val: bool


class Attributes(_Record):
    """Attributes of a cuboid, or data of a context."""

    boolean: tuple[Boolean, ...] | None = None
    num: tuple[Num, ...] | None = None
    text: tuple[Text, ...] | None = None


class Cuboid(_Record):
    """`val`: x y z, then qx qy qz qw or rx ry rz, then the full sizes sx sy sz; metres and radians."""

    name: str
    val: Annotated[tuple[Bounded, ...], Field(min_length=9, max_length=10)] | None
    coordinate_system: str | None = None
    uid: str | None = None
    attributes: Attributes | None = None


class ObjectData(_Record):
    """The cuboids of an object."""

    cuboid: tuple[Cuboid, ...] | None = None


class FrameObject(_Record):
    """The data of an object in one frame."""

    object_data: ObjectData | None = None


class FrameInterval(_Record):
    """Frame numbers from `frame_start` to `frame_end`, inclusive."""

    frame_start: Annotated[int, Field(ge=0)]
    frame_end: Annotated[int, Field(ge=0)]


class DataPointer(_Record):
    """The frames in which an object has data of a given name, and the attributes of that data."""

    type: str | None = None
    frame_intervals: tuple[FrameInterval, ...]
    attribute_pointers: dict[str, AttributeKind] | None = None


class Object(_Record):
    """An object in all frames; `type` is its class."""

    name: str
    type: Annotated[str, Field(min_length=1)]
    coordinate_system: str | None = None
    frame_intervals: tuple[FrameInterval, ...] | None = None
    object_data: ObjectData | None = None
    object_data_pointers: dict[str, DataPointer] | None = None


class TransformData(_Record):
    """A transform in one of three forms: 4x4 matrix row by row; quaternion x y z w; Euler angles in `sequence`."""

    matrix4x4: Annotated[tuple[Bounded, ...], Field(min_length=16, max_length=16)] | None = None
    quaternion: Bounded4 | None = None
    euler_angles: Bounded3 | None = None
    sequence: Annotated[str, StringConstraints(pattern=r"^[xyzXYZ]{3}$")] | None = None
    translation: Bounded3 | None = None


class CoordinateSystem(_Record):
    """`pose_wrt_parent` maps coordinates of this system to those of its parent; the root has the parent ""."""

    type: str
    parent: str
    pose_wrt_parent: TransformData | None = None
    children: tuple[str, ...] | None = None


class Transform(_Record):
    """A transform of one frame, from coordinates of `src` to those of `dst`."""

    src: str
    dst: str
    transform_src_to_dst: TransformData


class Pinhole(_Record):
    """A camera: `camera_matrix` is 3x4, row by row; distortion as in OpenCV, 5 to 14 coefficients."""

    width_px: int
    height_px: int
    camera_matrix: Annotated[tuple[Bounded, ...], Field(min_length=12, max_length=12)]
    distortion_coeffs: Annotated[tuple[Bounded, ...], Field(min_length=5, max_length=14)]


class Sync(_Record):
    """The time of an image or cloud, or its place in the stream."""

    timestamp: Timestamp | None = None
    frame_stream: int | None = None


class StreamProperties(_Record):
    """Calibration of a stream, or the place of a frame in it; lens models other than the pinhole are ignored."""

    intrinsics_pinhole: Pinhole | None = None
    sync: Sync | None = None


class FrameStream(_Record):
    """A stream in one frame; `uri` is its file."""

    uri: str | None = None
    stream_properties: StreamProperties | None = None


class Stream(FrameStream):
    """A sensor."""

    type: str | None = None
    description: str | None = None


class FrameProperties(_Record):
    """Time, files and transforms of one frame."""

    timestamp: Timestamp | None = None
    streams: dict[str, FrameStream] | None = None
    transforms: dict[str, Transform] | None = None


class FrameContext(_Record):
    """The data of a context in one frame."""

    context_data: Attributes | None = None


class Context(_Record):
    """What holds for a scene as a whole; annotator writes one, of the type `frame`, for attributes of frames."""

    name: str
    type: str
    frame_intervals: tuple[FrameInterval, ...] | None = None


class Frame(_Record):
    """One moment."""

    frame_properties: FrameProperties | None = None
    objects: dict[Uid, FrameObject] | None = None
    contexts: dict[Uid, FrameContext] | None = None


class Metadata(_Record):
    """Data about the document; `name` is the recording's name."""

    schema_version: Literal["1.0.0"]
    name: str | None = None
    annotator: str | None = None
    comment: str | None = None


class Content(_Record):
    """The content of a document."""

    metadata: Metadata
    coordinate_systems: dict[str, CoordinateSystem] | None = None
    streams: dict[str, Stream] | None = None
    objects: dict[Uid, Object] | None = None
    contexts: dict[Uid, Context] | None = None
    frames: dict[FrameNumber, Frame] | None = None
    frame_intervals: tuple[FrameInterval, ...] | None = None


class Document(_Record):
    """An OpenLABEL file."""

    openlabel: Content
