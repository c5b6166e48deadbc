"""The parts of an OpenLABEL 1.0.0 document that boxes need. Source: the ASAM standard and its JSON schema.

Names and nesting are the standard's. Other parts of a document (other geometry, actions, relations, ontologies) are
ignored when reading. The models are what is read; documents are written as plain dictionaries.

The schema does not define the order of a cuboid's Euler angles; it is taken from Vicomtech's VCD library, the
standard's reference implementation: `rx ry rz` mean R = Rz(rz) Ry(ry) Rx(rx), and `sequence` names intrinsic rotations,
"ZYX" by default.

What sources of boxes said of an object is the text `said_by` of its cuboid: a JSON list.

    [{"source": "detector", "type": "car", "val": [...], "score": 0.9, "track_id": 3, "box_kind": "silhouette"}, ...]

`type` and `val` are as in OpenLABEL's objects and cuboids, in the cuboid's coordinate system; the last three are left
out if they are unknown or as usual.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Generic, Literal, TypeVar

import numpy as np
from pydantic import Field, StringConstraints, TypeAdapter, ValidationError
from pydantic_core import to_json
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.reading import Bounded, Bounded3, Bounded4, Exact, rotation_problem
from annotator.types import BoxKind, Camera, OrientedBox
from annotator.types.bases import FileRecord, SaidRecord
from annotator.types.label import AttributeValue, Said
from annotator.types.messages import first_problem

SCHEMA_VERSION = "1.0.0"

# Frames are numbered; elements have a number or a UUID.
FrameNumber = Annotated[str, StringConstraints(pattern=r"^[0-9]{1,18}$")]
Uid = Annotated[str, StringConstraints(pattern=r"^(-?[0-9]{1,18}|[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12})$")]
Name = Annotated[str, Field(min_length=1)]
Part = dict[str, object]
"""A part of a document that is written."""


def known(**content: object) -> Part:
    """Returns a part of a document, without what is None."""
    return {name: value for name, value in content.items() if value is not None}


Value = TypeVar("Value")


class Named(FileRecord, Generic[Value]):
    """A named value."""

    name: str | None = None
    val: Value


class Attributes(FileRecord):
    """Attributes of a cuboid, or data of a context."""

    boolean: tuple[Named[bool], ...] | None = None
    num: tuple[Named[Exact], ...] | None = None
    text: tuple[Named[str], ...] | None = None

    def values(self) -> dict[str, AttributeValue]:
        """Returns all values by name."""
        every: list[Named[bool] | Named[float] | Named[str]] = [*(self.boolean or ()), *(self.num or ())]
        return {each.name: each.val for each in (*every, *(self.text or ())) if each.name}


class Cuboid(FileRecord):
    """`val`: x y z, then qx qy qz qw or rx ry rz, then the full sizes sx sy sz; metres and radians; null: none."""

    val: Annotated[tuple[Bounded, ...], Field(min_length=9, max_length=10)] | None
    coordinate_system: str | None = None
    attributes: Attributes | None = None


class ObjectData(FileRecord):
    """The cuboids of an object."""

    cuboid: tuple[Cuboid, ...] | None = None


class FrameObject(FileRecord):
    """The data of an object in one frame."""

    object_data: ObjectData | None = None


class FrameInterval(FileRecord):
    """Frame numbers from `frame_start` to `frame_end`, inclusive."""

    frame_start: Annotated[int, Field(ge=0)]
    frame_end: Annotated[int, Field(ge=0)]


class Object(FrameObject):
    """An object in all frames; `type` is its class."""

    type: Name
    coordinate_system: str | None = None
    frame_intervals: tuple[FrameInterval, ...] | None = None


class TransformData(FileRecord):
    """A transform in one of three forms: 4x4 matrix row by row; quaternion x y z w; Euler angles in `sequence`."""

    matrix4x4: Annotated[tuple[Bounded, ...], Field(min_length=16, max_length=16)] | None = None
    quaternion: Bounded4 | None = None
    euler_angles: Bounded3 | None = None
    sequence: Annotated[str, StringConstraints(pattern=r"^[xyzXYZ]{3}$")] | None = None
    translation: Bounded3 | None = None


class CoordinateSystem(FileRecord):
    """`pose_wrt_parent` maps coordinates of this system to those of its parent; the root has the parent ""."""

    parent: str
    pose_wrt_parent: TransformData | None = None


class Transform(FileRecord):
    """A transform of one frame, from coordinates of `src` to those of `dst`."""

    src: str
    dst: str
    transform_src_to_dst: TransformData


class Stream(FileRecord):
    """A sensor, or its file `uri` in one frame."""

    type: str | None = None
    uri: str | None = None


class FrameProperties(FileRecord):
    """Files and transforms of one frame."""

    streams: dict[str, Stream] | None = None
    transforms: dict[str, Transform] | None = None


class FrameContext(FileRecord):
    """The data of a context in one frame."""

    context_data: Attributes | None = None


class Frame(FileRecord):
    """One moment."""

    frame_properties: FrameProperties | None = None
    objects: dict[Uid, FrameObject] | None = None
    contexts: dict[Uid, FrameContext] | None = None


class Metadata(FileRecord):
    """Data about the document."""

    schema_version: Literal["1.0.0"]


class Content(FileRecord):
    """The content of a document."""

    metadata: Metadata
    coordinate_systems: dict[str, CoordinateSystem] | None = None
    streams: dict[str, Stream] | None = None
    objects: dict[Uid, Object] | None = None
    frames: dict[FrameNumber, Frame] | None = None


class Document(FileRecord):
    """An OpenLABEL file."""

    openlabel: Content


# Largest deviation of a 4x4 matrix from a rigid motion; files hold rounded numbers.
RIGID = 1e-3


def cuboid_values(box: OrientedBox) -> tuple[float, ...]:
    """Returns x y z qx qy qz qw sx sy sz of a box, in the box's frame of reference; metres, qw not negative."""
    quaternion = box.T_camera_box.rotation.as_quat(canonical=True)
    return tuple(np.concatenate([box.center_m, quaternion, box.size_m]).tolist())


def box_from(values: Sequence[float]) -> OrientedBox:
    """Returns the box of 10 values (quaternion x y z w) or 9 (Euler angles rx ry rz, radians).

    Raises:
        ValueError: neither 9 nor 10 values, a quaternion that is not of unit length, or a size that is not positive.
    """
    if len(values) == 10:
        rotation = _rotation(values[3:7])
    elif len(values) == 9:
        rotation = Rotation.from_euler("ZYX", values[5:2:-1])
    else:
        raise ValueError(f"a cuboid has 9 or 10 values, not {len(values)}")
    return OrientedBox.at(RigidTransform.from_components(np.array(values[:3]), rotation), np.array(values[-3:]))


def _rotation(xyzw: Sequence[float]) -> Rotation:
    if not 0.5 < np.linalg.norm(xyzw) < 2.0:
        raise ValueError(f"{list(xyzw)} is not a unit quaternion")
    return Rotation.from_quat(np.array(xyzw))


def transform_values(T_dst_src: RigidTransform) -> Part:
    """Returns the transform as quaternion and translation."""
    quaternion = T_dst_src.rotation.as_quat(canonical=True)
    return {"quaternion": quaternion.tolist(), "translation": T_dst_src.translation.tolist()}


def transform_from(data: TransformData) -> RigidTransform:
    """Returns the transform from any of the three forms.

    Raises:
        ValueError: none of the forms is complete, or the matrix is not a rigid motion.
    """
    if data.matrix4x4 is not None:
        matrix = np.array(data.matrix4x4).reshape(4, 4)
        R = matrix[:3, :3]
        if not np.abs(matrix[3] - (0, 0, 0, 1)).max() <= RIGID:
            raise ValueError("matrix4x4 is not a rigid motion (rotation and translation, row by row)")
        if (problem := rotation_problem(R, RIGID)) is not None:
            raise ValueError(f"matrix4x4 is not a rigid motion: its rotation {problem}")
        return RigidTransform.from_components(matrix[:3, 3], Rotation.from_matrix(R))
    if data.translation is None:
        raise ValueError("a transform needs matrix4x4, or translation with quaternion or euler_angles")
    if data.quaternion is not None:
        rotation = _rotation(data.quaternion)
    elif data.euler_angles is not None:
        sequence = (data.sequence or "ZYX").upper()
        if any(a == b for a, b in pairwise(sequence)):
            raise ValueError(f"the sequence {sequence} names one axis twice in a row")
        # intrinsic rotations about the named axes
        rotation = Rotation.from_euler(sequence, data.euler_angles)
    else:
        raise ValueError("a transform with a translation also needs quaternion or euler_angles")
    return RigidTransform.from_components(np.array(data.translation), rotation)


def pinhole_of(camera: Camera) -> Part:
    """Returns the camera's record: K as 3x4, row by row, OpenCV's coefficients padded with zeros to the 5 that the
    schema needs.
    """
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "camera_matrix": np.hstack([camera.matrix, np.zeros((3, 1))]).ravel().tolist(),
        "distortion_coeffs": camera.distortion + (0.0,) * (5 - len(camera.distortion)),
    }


class Coordinates:
    """The tree of a document's coordinate systems, with the transforms of one frame.

    Source: ASAM OpenLABEL 1.0.0: `pose_wrt_parent` and `transform_src_to_dst` are matrices that multiply column
    vectors of the child (the source) from the left. A frame's transform replaces the pose between the two systems.
    """

    def __init__(
        self, systems: Mapping[str, CoordinateSystem], of_frame: Mapping[str, Transform] | None = None
    ) -> None:
        """Raises ValueError for an invalid transform; names the coordinate system."""
        self._edges: dict[str, dict[str, RigidTransform]] = {name: {} for name in systems}
        for name, system in systems.items():
            if system.pose_wrt_parent is not None and system.parent:
                self._connect(f"pose_wrt_parent of {name}", system.parent, name, system.pose_wrt_parent)
        for name, each in (of_frame or {}).items():
            self._connect(f"transform {name}", each.dst, each.src, each.transform_src_to_dst)

    def transform(self, dst: str, src: str) -> RigidTransform:
        """Returns T_dst_src.

        Raises:
            ValueError: the two systems are not connected.
        """
        from_src = {src: RigidTransform.identity()}
        waiting = deque([src])
        while waiting and dst not in from_src:
            here = waiting.popleft()
            for there, T_there_here in self._edges.get(here, {}).items():
                if there not in from_src:
                    from_src[there] = T_there_here * from_src[here]
                    waiting.append(there)
        if dst not in from_src:
            raise ValueError(
                f"the coordinate systems {src!r} and {dst!r} are not connected; give each a parent and "
                "pose_wrt_parent, or add a transform to the frame"
            )
        return from_src[dst]

    def _connect(self, where: str, dst: str, src: str, data: TransformData) -> None:
        try:
            T_dst_src = transform_from(data)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        self._edges.setdefault(src, {})[dst] = T_dst_src
        self._edges.setdefault(dst, {})[src] = T_dst_src.inv()


SAID_BY = "said_by"


class _Entry(SaidRecord):
    label: Annotated[str, Field(min_length=1, alias="type")]
    val: Annotated[tuple[Bounded, ...], Field(min_length=10, max_length=10)]


_ENTRIES: TypeAdapter[tuple[_Entry, ...]] = TypeAdapter(tuple[_Entry, ...])


def said_text(said: Sequence[Said]) -> str:
    """Returns the text."""
    entries = [
        known(
            source=each.source,
            type=each.label,
            val=cuboid_values(each.box),
            score=each.score,
            track_id=each.track_id,
            box_kind=None if each.box_kind is BoxKind.BOX else each.box_kind,
        )
        for each in said
    ]
    return to_json(entries).decode()


def said_from(text: str) -> tuple[Said, ...]:
    """Returns what a text says.

    Raises:
        ValueError: it is not such a list; the message says what is wrong.
    """
    try:
        entries = _ENTRIES.validate_json(text)
    except ValidationError as error:
        raise ValueError(f"{first_problem(error, SAID_BY)}; correct it or leave it out") from error
    return tuple(each.said(box_from(each.val)) for each in entries)


# Names that annotator itself gives to data of a cuboid; attributes of these names get a prefix.
OWN = ("score", "track_id", "expected_iou_loss", "state", "source", "author", "suggested_by", "suggestion", "box_kind")
RESERVED = {*OWN, SAID_BY}
PREFIX = "attribute:"
# Name and type of the context that has the attributes of frames.
FRAME_CONTEXT = "frame"


def attributes_of(values: Mapping[str, AttributeValue]) -> dict[str, list[Part]]:
    """Returns values by their kind."""
    kinds: dict[str, list[Part]] = {"boolean": [], "num": [], "text": []}
    for name, value in values.items():
        kind = "text" if isinstance(value, str) else "boolean" if isinstance(value, bool) else "num"
        kinds[kind].append({"name": name, "val": float(value) if kind == "num" else value})
    return {kind: named for kind, named in kinds.items() if named}


def values_of(attributes: Attributes | None) -> dict[str, AttributeValue]:
    """Returns the values of attributes, without annotator's own data."""
    values = {} if attributes is None else attributes.values()
    return {name.removeprefix(PREFIX): value for name, value in values.items() if name not in RESERVED}
