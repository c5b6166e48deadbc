"""Reads the cuboids of OpenLABEL documents, ours and others', frame by frame in the camera's coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

from annotator.formats.frames_csv import FrameOrigin, read_frames
from annotator.formats.json_file import no_twins, read_model
from annotator.formats.openlabel.coordinates import Coordinates
from annotator.formats.openlabel.model import Attributes, Content, Cuboid, Document, Frame, FrameProperties, Object
from annotator.formats.openlabel.shapes import box_from
from annotator.types import OrientedBox, ReviewState
from annotator.types.errors import FormatError
from annotator.types.tracks import MOST_TRACK


@dataclass(frozen=True, eq=False)
class OpenLabelBox:
    """One cuboid.

    Attributes:
        label: the object's type.
        box: in the coordinates of the frame's camera (or cloud, see `OpenLabelFrame`).
        track_id: what the document says (`track_id`), else the object's number; None for UUIDs.
        score: where it is said.
        state: in the review; None where the document does not say.
    """

    label: str
    box: OrientedBox
    track_id: int | None = None
    score: float | None = None
    state: ReviewState | None = None


@dataclass(frozen=True, eq=False)
class OpenLabelFrame:
    """One frame of a document as one of its sensors sees it.

    Attributes:
        name: "RECORDING/KEY" where the dataset says so; else the stem of the sensor's file, else the frame's number.
        boxes: in the sensor's coordinates.
        of_camera: they are those of a camera; False: the document has no camera, they are those of its cloud.
    """

    name: str
    boxes: tuple[OpenLabelBox, ...]
    of_camera: bool


def read_openlabel(path: Path) -> dict[str, OpenLabelFrame]:
    """The frames of a document, or of all documents in a folder and in the folders within it, by name.

    Raises:
        FormatError: no document, one that does not follow the standard, a cuboid in a coordinate system that nothing
            leads from to the camera, or two frames of one name.
    """
    found: dict[str, OpenLabelFrame] = {}
    source: dict[str, Path] = {}
    for file in _documents(path):
        # parts of a divided dataset share the table above them
        origins = read_frames(file.parent) or read_frames(file.parent.parent)
        for frame in parse(file, read_model(file, Document, no_twins), origins):
            if frame.name in found:
                where = f"and in {source[frame.name].name}" if source[frame.name] != file else "for two sensors"
                raise FormatError(file, f"the frame {frame.name} is here {where}; import one of them at a time")
            found[frame.name], source[frame.name] = frame, file
    return found


def parse(path: Path, document: Document, origins: Mapping[str, FrameOrigin]) -> Iterator[OpenLabelFrame]:
    """The frames of one document, once for each of its cameras.

    Args:
        path: of the document, for messages.
        origins: of frames, by the stem of their files.

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
                # this camera took no picture of the frame
                continue
            # files may come from Windows; only the last part counts, nothing is opened by it
            stem = PureWindowsPath(stream.uri).stem if stream is not None and stream.uri else number
            name = origins[stem].name if stem in origins else stem
            boxes = tuple(
                _box(path, place, each, cuboid, uid, coordinates, sensor)
                for place, uid, each, cuboid in _cuboids(path, content, int(number), frame)
                # null is the standard's way to say that there is none
                if cuboid.val is not None
            )
            yield OpenLabelFrame(name, boxes, of_camera)


def _documents(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    found = sorted([*path.glob("*.json"), *path.glob("*/*.json")])
    if not found:
        raise FormatError(path, "has no OpenLABEL document (*.json)" if path.is_dir() else "does not exist")
    return found


def _sensors(path: Path, content: Content) -> dict[str, bool]:
    """The streams whose coordinates are wanted: the cameras, or without any the only cloud; True for cameras."""
    streams = content.streams or {}
    if cameras := [name for name, stream in streams.items() if stream.type == "camera"]:
        return dict.fromkeys(cameras, True)
    clouds = [name for name, stream in streams.items() if stream.type == "lidar"]
    if len(clouds) != 1:
        raise FormatError(path, "has no stream of type camera (nor just one of type lidar) whose frames these could be")
    return {clouds[0]: False}


def _cuboids(path: Path, content: Content, number: int, frame: Frame) -> Iterator[tuple[str, str, Object, Cuboid]]:
    """Where each stands, its object's uid, the object, and itself: those of the frame, then those that hold always."""
    objects = content.objects or {}
    for uid, dynamic in (frame.objects or {}).items():
        where = f"openlabel.frames.{number}.objects.{uid}"
        if uid not in objects:
            raise FormatError(path, f"{where}: openlabel.objects has no {uid}; every object must be listed there")
        if dynamic.object_data is not None:
            for place, cuboid in enumerate(dynamic.object_data.cuboid or ()):
                yield f"{where}.object_data.cuboid.{place}", uid, objects[uid], cuboid
    for uid, each in objects.items():
        if each.object_data is None or not _lives(each, number):
            continue
        for place, cuboid in enumerate(each.object_data.cuboid or ()):
            yield f"openlabel.objects.{uid}.object_data.cuboid.{place}", uid, each, cuboid


def _lives(each: Object, number: int) -> bool:
    intervals = each.frame_intervals
    return not intervals or any(i.frame_start <= number <= i.frame_end for i in intervals)


def _box(
    path: Path, where: str, each: Object, cuboid: Cuboid, uid: str, coordinates: Coordinates, sensor: str
) -> OpenLabelBox:
    system = cuboid.coordinate_system or each.coordinate_system
    if system is None:
        raise FormatError(path, f"{where}: names no coordinate_system, and neither does its object")
    attributes = cuboid.attributes or Attributes()
    numbers = {num.name: num.val for num in attributes.num or ()}
    state = next((text.val for text in attributes.text or () if text.name == "state"), None)
    try:
        box, track_id = box_from(cuboid.val or ()), _track(numbers.get("track_id"), uid)
        if system != sensor:
            box = box.transformed(coordinates.transform(sensor, system))
    except ValueError as error:
        raise FormatError(path, f"{where}: {error}") from error
    known = ReviewState(state) if state in set(ReviewState) else None
    return OpenLabelBox(each.type, box, track_id, numbers.get("score"), known)


def _track(said: float | None, uid: str) -> int | None:
    if said is not None:
        if not said.is_integer():
            raise ValueError(f"track_id must be a whole number, not {said}")
        return int(said)
    if "-" in uid[1:]:
        return None
    if abs(number := int(uid)) > MOST_TRACK:
        raise ValueError(f"the object's number, which becomes its track, goes to {MOST_TRACK}, not {number:.6g}")
    return number
