"""Builds the OpenLABEL document of a recording, frame by frame."""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.openlabel.model import (
    SCHEMA_VERSION,
    AttributeKind,
    Attributes,
    Content,
    Context,
    CoordinateSystem,
    Cuboid,
    DataPointer,
    Document,
    Frame,
    FrameContext,
    FrameInterval,
    FrameObject,
    FrameProperties,
    FrameStream,
    Metadata,
    Object,
    ObjectData,
    Pinhole,
    Stream,
    StreamProperties,
    Sync,
    Transform,
)
from annotator.formats.openlabel.named_values import FRAME_CONTEXT, attributes_of, key_of
from annotator.formats.openlabel.said_text import SAID_BY, said_text
from annotator.formats.openlabel.shapes import cuboid_values, pinhole_of, transform_values
from annotator.types import BoxKind, Label
from annotator.types import Frame as RecordedFrame
from annotator.types.label import AttributeValue

WORLD, BASE, CAMERA, CLOUD = "world", "base", "camera", "cloud"
# Axes of the base (ISO 8855, as for vehicles): x forward, y left, z up; it moves with the camera.
T_BASE_CAMERA = RigidTransform.from_rotation(
    Rotation.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
)
# Name of the transform of a frame, as the standard proposes: source, "to", destination.
PLACE = f"{BASE}_to_{WORLD}"
# Namespace of the UUIDs of objects and boxes: the same project gives the same file.
NAMESPACE = uuid.UUID("6f0d2c1e-2f0b-5d1c-9c53-0d2a5c7b1f4e")


@dataclass
class _Track:
    """One object in the frames so far."""

    name: str
    type: str
    frames: list[int] = field(default_factory=list)
    attributes: dict[str, AttributeKind] = field(default_factory=dict)


@dataclass
class Scene:
    """The document of a recording so far, without images and clouds.

    Attributes:
        recording: the recording's name.
        generator: program and version.
        comment: about the boxes, if any.
    """

    recording: str
    generator: str
    comment: str | None = None
    _camera: Pinhole | None = None
    _frames: dict[int, Frame] = field(default_factory=dict)
    _tracks: dict[str, _Track] = field(default_factory=dict)

    def add(self, item: DatasetItem, image: str, cloud: str) -> None:
        """Adds a frame; `image` and `cloud` are its files, relative to the document."""
        frame, number = item.frame, item.frame.index
        camera = pinhole_of(frame.camera)
        self._camera = self._camera or camera
        time = None if frame.timestamp_ns is None else _seconds(frame.timestamp_ns)
        sync = Sync(frame_stream=number) if time is None else Sync(timestamp=time)
        # a frame has intrinsics only if they differ from those of the stream
        intrinsics = None if camera == self._camera else camera
        streams = {
            CAMERA: FrameStream(
                uri=image, stream_properties=StreamProperties(intrinsics_pinhole=intrinsics, sync=sync)
            ),
            CLOUD: FrameStream(uri=cloud, stream_properties=StreamProperties(sync=sync)),
        }
        self._frames[number] = Frame(
            frame_properties=FrameProperties(timestamp=time, streams=streams, transforms=_transforms(frame)),
            objects=self._objects(number, item.labels) or None,
            contexts={self._context: FrameContext(context_data=attributes_of(item.attributes))}
            if item.attributes
            else None,
        )

    def document(self) -> Document:
        """Returns the document, frames in the order of their numbers."""
        numbers = sorted(self._frames)
        pose = transform_values(T_BASE_CAMERA)
        is_placed = any(frame.frame_properties and frame.frame_properties.transforms for frame in self._frames.values())
        world = {WORLD: CoordinateSystem(type="scene", parent="", children=(BASE,))} if is_placed else {}
        # some readers require children, even if there are none
        sensor = CoordinateSystem(type="sensor", parent=BASE, pose_wrt_parent=pose, children=())
        return Document(
            openlabel=Content(
                metadata=Metadata(
                    schema_version=SCHEMA_VERSION,
                    name=self.recording,
                    annotator=self.generator,
                    comment=self.comment,
                ),
                coordinate_systems={
                    **world,
                    BASE: CoordinateSystem(type="local", parent=WORLD if world else "", children=(CAMERA, CLOUD)),
                    CAMERA: sensor,
                    CLOUD: sensor,
                },
                streams={
                    CAMERA: Stream(
                        type="camera", uri="images", stream_properties=StreamProperties(intrinsics_pinhole=self._camera)
                    ),
                    CLOUD: Stream(type="lidar", uri="clouds"),
                },
                contexts=self._contexts(),
                objects={uid: _object(track) for uid, track in self._tracks.items()} or None,
                frames={str(number): self._frames[number] for number in numbers},
                frame_intervals=_intervals(numbers),
            )
        )

    @property
    def _context(self) -> str:
        return _uuid(self.recording, FRAME_CONTEXT)

    def _contexts(self) -> dict[str, Context] | None:
        numbers = sorted(number for number, frame in self._frames.items() if frame.contexts)
        context = Context(name=FRAME_CONTEXT, type=FRAME_CONTEXT, frame_intervals=_intervals(numbers))
        return {self._context: context} if numbers else None

    def _objects(self, number: int, labels: Sequence[Label]) -> dict[str, FrameObject]:
        objects: dict[str, FrameObject] = {}
        seen: Counter[str] = Counter()
        for label in labels:
            identity = f"label {label.uid}" if label.track_id is None else f"track {label.track_id}"
            # an object occurs once per frame, even if two labels have the same track
            seen[f"{label.label} {identity}"] += 1
            occurrence = seen[f"{label.label} {identity}"]
            uid = _uuid(self.recording, label.label, identity, str(occurrence))
            cuboid = _cuboid(label, _uuid(self.recording, str(number), label.uid))
            objects[uid] = FrameObject(object_data=ObjectData(cuboid=(cuboid,)))
            if uid not in self._tracks:
                self._tracks[uid] = _Track(f"{label.label} {len(self._tracks) + 1}", label.label)
            self._tracks[uid].frames.append(number)
            self._tracks[uid].attributes |= _kinds(cuboid)
        return objects


def _transforms(frame: RecordedFrame) -> dict[str, Transform] | None:
    """Returns the pose of the base in map coordinates; None if a frame has none."""
    if frame.T_world_camera is None:
        return None
    T_world_base = frame.T_world_camera * T_BASE_CAMERA.inv()
    return {PLACE: Transform(src=BASE, dst=WORLD, transform_src_to_dst=transform_values(T_world_base))}


def _uuid(*parts: str) -> str:
    return str(uuid.uuid5(NAMESPACE, "\n".join(parts)))


def _seconds(time_ns: int) -> str:
    """Returns seconds with nine decimals as a text: a JSON number would lose nanoseconds."""
    whole, rest = divmod(time_ns, 10**9)
    return f"{whole}.{rest:09d}"


def _cuboid(label: Label, uid: str) -> Cuboid:
    numbers: dict[str, AttributeValue | None] = {
        "score": label.score,
        "track_id": label.track_id,
        "expected_iou_loss": label.expected_iou_loss,
    }
    texts: dict[str, AttributeValue | None] = {
        "state": label.state.value,
        "source": label.source.value,
        "author": label.author,
    }
    if label.suggestion is not None:
        texts |= {
            "suggested_by": label.suggestion.detector,
            "suggestion": "corrected" if label.suggestion.corrected else "accepted",
        }
    if label.box_kind is not BoxKind.BOX:
        texts["box_kind"] = label.box_kind.value
    if label.said:
        texts[SAID_BY] = said_text(label.said)
    own = {name: value for name, value in (numbers | texts).items() if value is not None}
    return Cuboid(
        name=f"{CAMERA}__cuboid__{label.label}",
        val=cuboid_values(label.box),
        coordinate_system=CAMERA,
        uid=uid,
        attributes=attributes_of(own | {key_of(name): value for name, value in label.attributes.items()}),
    )


def _kinds(cuboid: Cuboid) -> dict[str, AttributeKind]:
    attributes = cuboid.attributes or Attributes()
    kinds: dict[str, AttributeKind] = {each.name: "num" for each in attributes.num or () if each.name}
    kinds |= {each.name: "text" for each in attributes.text or () if each.name}
    return kinds | {each.name: "boolean" for each in attributes.boolean or () if each.name}


def _object(track: _Track) -> Object:
    intervals = _intervals(sorted(track.frames))
    pointer = DataPointer(type="cuboid", frame_intervals=intervals, attribute_pointers=track.attributes)
    return Object(
        name=track.name,
        type=track.type,
        frame_intervals=intervals,
        object_data_pointers={f"{CAMERA}__cuboid__{track.type}": pointer},
    )


def _intervals(numbers: Iterable[int]) -> tuple[FrameInterval, ...]:
    """Returns the runs of consecutive numbers in a sorted sequence of frame numbers."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return tuple(FrameInterval(frame_start=first, frame_end=last) for first, last in runs)
