"""Reads the cuboids of OpenLABEL documents, frame by frame, in the camera's coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from annotator.file_names import normal, stem_of
from annotator.formats.frames_csv import FrameOrigin, read_frames
from annotator.formats.json_file import read_model, unique_keys
from annotator.formats.openlabel.coordinates import Coordinates
from annotator.formats.openlabel.model import Attributes, Content, Cuboid, Document, Frame, FrameProperties, Object
from annotator.formats.openlabel.named_values import values_of
from annotator.formats.openlabel.said_text import SAID_BY, said_from
from annotator.formats.openlabel.scene import PLACE, WORLD
from annotator.formats.openlabel.shapes import box_from
from annotator.formats.units import Angles, AngleUnit
from annotator.geometry.transforms import Quaternions
from annotator.types import BoxKind, OrientedBox, ReviewState
from annotator.types.errors import FormatError
from annotator.types.label import MOST_TRACK, AttributeValue, Said


@dataclass(frozen=True, eq=False)
class OpenLabelBox:
    """One cuboid.

    Attributes:
        label: the object's type.
        box: in the coordinates of the frame's camera (or cloud, see `OpenLabelFrame`).
        track_id: the attribute `track_id`, else the object's number; None for UUIDs.
        score: the attribute `score`, if any.
        state: the review state from the attribute `state`, if any.
        box_kind: what the box encloses, from the attribute `box_kind`, else the whole object.
        attributes: values of all other attributes, by name.
        said: what sources of boxes said of the object, from the attribute `said_by`.
    """

    label: str
    box: OrientedBox
    track_id: int | None = None
    score: float | None = None
    state: ReviewState | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    said: tuple[Said, ...] = ()


@dataclass(frozen=True, eq=False)
class OpenLabelFrame:
    """One frame of a document, for one of its sensors.

    Attributes:
        name: "RECORDING/KEY" from frames.csv; else the stem of the sensor's file, else the frame's number.
        boxes: in the sensor's coordinates.
        of_camera: True if the sensor is a camera; False: the document has no camera, the sensor is its LiDAR.
        attributes: of the frame, from contexts.
        T_world_sensor: pose of the sensor in map coordinates, from annotator's own documents of recordings in such.
    """

    name: str
    boxes: tuple[OpenLabelBox, ...]
    of_camera: bool
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    T_world_sensor: RigidTransform | None = None


def read_openlabel(path: Path, angles: AngleUnit | None = None) -> dict[str, OpenLabelFrame]:
    """Returns the frames of a document, or of all documents in a folder and its subfolders, by name.

    Args:
        angles: unit of the angles of cuboids; None: radians, as the standard says.

    Raises:
        FormatError: no document, a document that does not follow the standard, a cuboid in a coordinate system that
            is not connected to the camera's, or two frames with the same name.
        UnitError: the angles cannot be radians, or the quaternions have w first.
    """
    all_angles, quaternions = Angles(angles), Quaternions(w_first=False)
    frames: dict[str, OpenLabelFrame] = {}
    source: dict[str, Path] = {}
    for file in _documents(path):
        # the parts of a divided dataset share the frames.csv above them
        origins = read_frames(file.parent) or read_frames(file.parent.parent)
        document = read_model(file, Document, unique_keys)
        _collect(file, document.openlabel, all_angles, quaternions)
        for frame in parse(file, document, origins, degrees=angles is AngleUnit.DEGREES):
            if frame.name in frames:
                where = f"here and in {source[frame.name].name}" if source[frame.name] != file else "for two sensors"
                raise FormatError(file, f"the frame {frame.name} has labels {where}; import one of them at a time")
            frames[frame.name], source[frame.name] = frame, file
    all_angles.require()
    quaternions.require(path)
    return frames


def _collect(file: Path, content: Content, angles: Angles, quaternions: Quaternions) -> None:
    """Adds the numbers of all cuboids of a document; quaternions only of those in level frames.

    Raises:
        FormatError: as `_cuboids`.
    """
    cameras = {name for name, stream in (content.streams or {}).items() if stream.type == "camera"}
    for number, frame in (content.frames or {}).items():
        for _, _, each, cuboid in _cuboids(file, content, int(number), frame):
            values = cuboid.val or ()
            if len(values) == 9:
                for value in values[3:6]:
                    angles.radians(value, file)
            elif len(values) == 10 and (cuboid.coordinate_system or each.coordinate_system) not in cameras:
                quaternions.add(values[3:7])


def parse(
    path: Path, document: Document, origins: Mapping[str, FrameOrigin], *, degrees: bool = False
) -> Iterator[OpenLabelFrame]:
    """Yields the frames of one document, once for each of its cameras.

    Args:
        path: the document, for error messages.
        origins: origins of frames, by the stem of their files.
        degrees: the unit of the cuboids' angles; False: radians.

    Raises:
        FormatError: as `read_openlabel`.
    """
    content = document.openlabel
    sensors = _sensors(path, content)
    for number, frame in (content.frames or {}).items():
        properties = frame.frame_properties or FrameProperties()
        where = f"openlabel.frames.{number}"
        try:
            coordinates = Coordinates(content.coordinate_systems or {}, properties.transforms)
        except ValueError as error:
            raise FormatError(path, f"{where}: {error}") from error
        for sensor, of_camera in sensors.items():
            stream = (properties.streams or {}).get(sensor)
            if stream is None and len(sensors) > 1:
                # this camera has no image in the frame
                continue
            # paths may come from Windows; only the file name is used, the file is not opened
            stem = normal(stem_of(stream.uri)) if stream is not None and stream.uri else number
            name = origins[stem].name if stem in origins else stem
            boxes = tuple(
                _box(path, place, each, cuboid, uid, coordinates, sensor, degrees)
                for place, uid, each, cuboid in _cuboids(path, content, int(number), frame)
                # null means "no cuboid" in the standard
                if cuboid.val is not None
            )
            contexts = (frame.contexts or {}).values()
            values = {key: value for each in contexts for key, value in values_of(each.context_data).items()}
            is_placed = stem in origins and PLACE in (properties.transforms or {})
            world = coordinates.transform(WORLD, sensor) if is_placed else None
            yield OpenLabelFrame(name, boxes, of_camera, values, world)


def _documents(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    documents = sorted([*path.glob("*.json"), *path.glob("*/*.json")])
    if not documents:
        raise FormatError(path, "has no OpenLABEL document (*.json)" if path.is_dir() else "does not exist")
    return documents


def _sensors(path: Path, content: Content) -> dict[str, bool]:
    """Returns the streams to read boxes for: the cameras (True), or without cameras the only LiDAR (False)."""
    streams = content.streams or {}
    if cameras := [name for name, stream in streams.items() if stream.type == "camera"]:
        return dict.fromkeys(cameras, True)
    clouds = [name for name, stream in streams.items() if stream.type == "lidar"]
    if len(clouds) != 1:
        raise FormatError(
            path, "has no stream of type camera, and not exactly one of type lidar; add the sensor of the boxes"
        )
    return {clouds[0]: False}


def _cuboids(path: Path, content: Content, number: int, frame: Frame) -> Iterator[tuple[str, str, Object, Cuboid]]:
    """Yields place, object uid, object and cuboid: first those of the frame, then those of static objects."""
    objects = content.objects or {}
    for uid, dynamic in (frame.objects or {}).items():
        where = f"openlabel.frames.{number}.objects.{uid}"
        if uid not in objects:
            raise FormatError(path, f"{where}: the object is not listed in openlabel.objects; add it there")
        if dynamic.object_data is not None:
            for place, cuboid in enumerate(dynamic.object_data.cuboid or ()):
                yield f"{where}.object_data.cuboid.{place}", uid, objects[uid], cuboid
    for uid, each in objects.items():
        if each.object_data is None or not _is_present(each, number):
            continue
        for place, cuboid in enumerate(each.object_data.cuboid or ()):
            yield f"openlabel.objects.{uid}.object_data.cuboid.{place}", uid, each, cuboid


def _is_present(each: Object, number: int) -> bool:
    intervals = each.frame_intervals
    return not intervals or any(i.frame_start <= number <= i.frame_end for i in intervals)


def _box(
    path: Path,
    where: str,
    each: Object,
    cuboid: Cuboid,
    uid: str,
    coordinates: Coordinates,
    sensor: str,
    degrees: bool,
) -> OpenLabelBox:
    system = cuboid.coordinate_system or each.coordinate_system
    if system is None:
        raise FormatError(path, f"{where}: has no coordinate_system, and its object has none either; add one")
    attributes = cuboid.attributes or Attributes()
    numbers = {num.name: num.val for num in attributes.num or ()}
    texts = {text.name: text.val for text in attributes.text or ()}
    try:
        box, track_id = box_from(cuboid.val or (), degrees=degrees), _track(numbers.get("track_id"), uid)
        said = said_from(texts[SAID_BY]) if SAID_BY in texts else ()
        if system != sensor:
            T = coordinates.transform(sensor, system)
            box, said = box.transformed(T), tuple(each.transformed(T) for each in said)
    except ValueError as error:
        raise FormatError(path, f"{where}: {error}") from error
    state, kind = texts.get("state"), texts.get("box_kind")
    review = ReviewState(state) if state in set(ReviewState) else None
    box_kind = BoxKind(kind) if kind in set(BoxKind) else BoxKind.BOX
    values = values_of(attributes)
    return OpenLabelBox(each.type, box, track_id, numbers.get("score"), review, box_kind, values, said)


def _track(attribute: float | None, uid: str) -> int | None:
    if attribute is not None:
        if not attribute.is_integer():
            raise ValueError(f"track_id must be a whole number, not {attribute}")
        return int(attribute)
    if "-" in uid[1:]:
        return None
    if abs(number := int(uid)) > MOST_TRACK:
        raise ValueError(f"the object's number is its track id and must be at most {MOST_TRACK}, not {number:.6g}")
    return number
