"""OpenLABEL (ASAM, 1.0.0): objects with fully oriented cuboids over the frames of a recording, as JSON.

    [PART/]RECORDING.json   one document per recording
    [PART/]images/ID.png    the camera images (or .jpg)
    [PART/]clouds/ID.ply    the clouds, camera frame
    frames.csv              the origin of each frame

There is one document per recording because frame numbers and object identities are valid within one document: readers
treat a file as one scene with one set of sensors. Each part of a divided dataset is a folder of its own.
`openlabel_document.py` defines the JSON.
"""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic_core import to_json
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import open_file
from annotator.formats import openlabel_document as doc
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, FileNames, ply
from annotator.formats.frame_names import DatasetNames, LabelledFrame, add_once, has_frames, in_world, of_recording
from annotator.formats.reading import Angles, AngleUnit, faults, known_kind, read_model
from annotator.geometry.transforms import Quaternions
from annotator.text import normal, stem_of
from annotator.types import BoxKind, Label, ReviewState, Truth
from annotator.types.errors import FormatError
from annotator.types.label import MOST_TRACK, AttributeValue

WORLD, BASE, CAMERA, CLOUD = "world", "base", "camera", "cloud"
# Axes of the base (ISO 8855, as for vehicles): x forward, y left, z up; it moves with the camera.
T_BASE_CAMERA = RigidTransform.from_rotation(
    Rotation.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
)
# Name of the transform of a frame, as the standard proposes: source, "to", destination.
PLACE = f"{BASE}_to_{WORLD}"
# Namespace of the UUIDs of objects and boxes: the same project gives the same file.
NAMESPACE = uuid.UUID("6f0d2c1e-2f0b-5d1c-9c53-0d2a5c7b1f4e")


class Scene:
    """The document of a recording so far, without images and clouds.

    Args:
        recording: the recording's name.
        generator: program and version.
        comment: about the boxes, if any.
    """

    def __init__(self, recording: str, generator: str, comment: str | None) -> None:
        self._recording = recording
        self._metadata = doc.known(
            schema_version=doc.SCHEMA_VERSION, name=recording, annotator=generator, comment=comment
        )
        self._camera: doc.Part | None = None
        self._frames: dict[int, doc.Part] = {}
        self._is_placed = False
        self._with_values: list[int] = []
        # of each object: its class, its frames, and the kinds of its attributes by name
        self._tracks: dict[str, tuple[str, list[int], dict[str, str]]] = {}

    def add(self, item: DatasetItem, image: str, cloud: str) -> None:
        """Adds a frame; `image` and `cloud` are its files, relative to the document."""
        frame, number = item.frame, item.frame.index
        camera = doc.pinhole_of(frame.camera)
        self._camera = self._camera or camera
        time = None if frame.timestamp_ns is None else _seconds(frame.timestamp_ns)
        sync: doc.Part = {"frame_stream": number} if time is None else {"timestamp": time}
        # a frame has intrinsics only if they differ from those of the stream
        intrinsics = {} if camera == self._camera else {"intrinsics_pinhole": camera}
        streams = {
            CAMERA: {"uri": image, "stream_properties": {**intrinsics, "sync": sync}},
            CLOUD: {"uri": cloud, "stream_properties": {"sync": sync}},
        }
        transforms = None
        if frame.T_world_camera is not None:
            # the pose of the base in the world
            pose = doc.transform_values(frame.T_world_camera * T_BASE_CAMERA.inv())
            transforms = {PLACE: {"src": BASE, "dst": WORLD, "transform_src_to_dst": pose}}
            self._is_placed = True
        contexts = None
        if item.attributes:
            self._with_values.append(number)
            contexts = {self._context: {"context_data": doc.attributes_of(item.attributes)}}
        self._frames[number] = doc.known(
            frame_properties=doc.known(timestamp=time, streams=streams, transforms=transforms),
            objects=self._objects(number, item.labels) or None,
            contexts=contexts,
        )

    def document(self) -> doc.Part:
        """Returns the document, frames in the order of their numbers."""
        numbers = sorted(self._frames)
        world = {WORLD: {"type": "scene", "parent": "", "children": [BASE]}} if self._is_placed else {}
        base = {"type": "local", "parent": WORLD if world else "", "children": [CAMERA, CLOUD]}
        # some readers require children, even if there are none
        pose = doc.transform_values(T_BASE_CAMERA)
        sensor = {"type": "sensor", "parent": BASE, "pose_wrt_parent": pose, "children": []}
        intrinsics = {"intrinsics_pinhole": self._camera}
        context = {
            **dict.fromkeys(("name", "type"), doc.FRAME_CONTEXT),
            "frame_intervals": _intervals(sorted(self._with_values)),
        }
        content = doc.known(
            metadata=self._metadata,
            coordinate_systems={**world, BASE: base, CAMERA: sensor, CLOUD: sensor},
            streams={
                CAMERA: {"uri": "images", "stream_properties": intrinsics, "type": "camera"},
                CLOUD: {"uri": "clouds", "type": "lidar"},
            },
            objects={uid: self._object(uid, place) for place, uid in enumerate(self._tracks, 1)} or None,
            contexts={self._context: context} if self._with_values else None,
            frames={str(number): self._frames[number] for number in numbers},
            frame_intervals=_intervals(numbers),
        )
        return {"openlabel": content}

    @property
    def _context(self) -> str:
        return _uuid(self._recording, doc.FRAME_CONTEXT)

    def _objects(self, number: int, labels: Sequence[Label]) -> dict[str, doc.Part]:
        objects: dict[str, doc.Part] = {}
        seen: Counter[str] = Counter()
        for label in labels:
            identity = f"label {label.uid}" if label.track_id is None else f"track {label.track_id}"
            # an object occurs once per frame, even if two labels have the same track
            seen[f"{label.label} {identity}"] += 1
            uid = _uuid(self._recording, label.label, identity, str(seen[f"{label.label} {identity}"]))
            attributes = doc.attributes_of(_values(label))
            cuboid = {
                "name": f"{CAMERA}__cuboid__{label.label}",
                "val": doc.cuboid_values(label.box),
                "coordinate_system": CAMERA,
                "uid": _uuid(self._recording, str(number), label.uid),
                "attributes": attributes,
            }
            objects[uid] = {"object_data": {"cuboid": [cuboid]}}
            _, frames, kinds = self._tracks.setdefault(uid, (label.label, [], {}))
            frames.append(number)
            for kind in ("num", "text", "boolean"):
                kinds.update({str(each["name"]): kind for each in attributes.get(kind, ())})
        return objects

    def _object(self, uid: str, place: int) -> doc.Part:
        label, numbers, kinds = self._tracks[uid]
        intervals = _intervals(sorted(numbers))
        pointer = {"type": "cuboid", "frame_intervals": intervals, "attribute_pointers": kinds}
        return {
            "name": f"{label} {place}",
            "type": label,
            "frame_intervals": intervals,
            "object_data_pointers": {f"{CAMERA}__cuboid__{label}": pointer},
        }


def _uuid(*parts: str) -> str:
    return str(uuid.uuid5(NAMESPACE, "\n".join(parts)))


def _seconds(time_ns: int) -> str:
    """Returns seconds with nine decimals as a text: a JSON number would lose nanoseconds."""
    whole, rest = divmod(time_ns, 10**9)
    return f"{whole}.{rest:09d}"


def _values(label: Label) -> dict[str, AttributeValue]:
    """Returns all that a cuboid's attributes hold of a label: annotator's own data, and the label's attributes."""
    suggestion = label.suggestion
    own: dict[str, AttributeValue | None] = {
        "score": label.score,
        "track_id": label.track_id,
        "expected_iou_loss": label.expected_iou_loss,
        "state": label.state.value,
        "source": label.source.value,
        "author": label.author,
        "suggested_by": None if suggestion is None else suggestion.detector,
        "suggestion": None if suggestion is None else "corrected" if suggestion.corrected else "accepted",
        "box_kind": None if label.box_kind is BoxKind.BOX else label.box_kind.value,
        doc.SAID_BY: doc.said_text(label.said) if label.said else None,
    }
    known = {name: value for name, value in own.items() if value is not None}
    given = label.attributes.items()
    return known | {f"{doc.PREFIX}{name}" if name in doc.RESERVED else name: value for name, value in given}


def _intervals(numbers: Iterable[int]) -> list[dict[str, int]]:
    """Returns the runs of consecutive numbers in a sorted sequence of frame numbers."""
    runs: list[dict[str, int]] = []
    for number in numbers:
        if runs and number == runs[-1]["frame_end"] + 1:
            runs[-1]["frame_end"] = number
        else:
            runs.append({"frame_start": number, "frame_end": number})
    return runs


# Documents have the key "openlabel" within these first bytes.
_HEAD_BYTES = 256


class OpenLabelWriter(DatasetWriter):
    def begin(self) -> None:
        self._scenes: dict[tuple[str | None, str], Scene] = {}
        used = [f"{detector.role}: {detector.name}" for detector in self.info.detectors]
        self._comment = f"Detectors that proposed boxes: {'; '.join(used)}" if used else None

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        place = f"{item.split}/" if item.split else ""
        image, cloud = f"images/{frame_id}", f"clouds/{frame_id}.ply"
        image = self.put_image(place + image, item.frame.rgb).removeprefix(place)
        self.put(place + cloud, ply(item.frame.cloud))
        scene = Scene(item.recording, self.info.generator, self._comment)
        self._scenes.setdefault((item.split, item.recording), scene).add(item, image, cloud)
        self.counts.update(label.label for label in item.labels)

    def finish(self) -> None:
        # a recording has the same file name in all parts
        names = FileNames()
        stems = {recording: names.add(recording) for recording in dict.fromkeys(each for _, each in self._scenes)}
        for (split, recording), scene in self._scenes.items():
            self.put(f"{split or '.'}/{stems[recording]}.json", to_json(scene.document(), indent=1) + b"\n")


def is_openlabel_export(folder: Path) -> bool:
    """True for an export of annotator; no other folder is overwritten."""
    documents = [*folder.glob("*.json"), *folder.glob("*/*.json")]
    return has_frames(folder) and bool(documents) and all(map(is_document, documents))


def is_document(file: Path) -> bool:
    """True for a file that begins as a document; False for one that cannot be read."""
    with suppress(OSError), open_file(file) as stream:
        return b'"openlabel"' in stream.read(_HEAD_BYTES)
    return False


def read_openlabel(path: Path, angles: AngleUnit | None = None) -> dict[str, LabelledFrame]:
    """Returns the frames of a document, or of all documents in a folder and its subfolders.

    Names are "RECORDING/KEY" from frames.csv; else the stem of the sensor's file, else the frame's number. Boxes are in
    the coordinates of the camera, or of the LiDAR in a document without one. The track of an object is the attribute
    `track_id`, else its number; None for UUIDs.

    Args:
        angles: unit of the angles of cuboids; None: radians, as the standard says.
    """
    read, quaternions = Angles(angles), Quaternions(w_first=False)
    frames: dict[str, LabelledFrame] = {}
    for file in _documents(path):
        # the parts of a divided dataset share the frames.csv above them
        names = DatasetNames.of(file.parent)
        content = read_model(file, doc.Document, unique=True).openlabel
        for name, frame in _Reader(file, content, read, quaternions).frames(names):
            add_once(frames, file, name, frame)
    read.require()
    quaternions.require(path)
    return frames


class _Box(NamedTuple):
    """A cuboid's place in the document, its coordinate system, the object in it, and its review state."""

    place: str
    system: str
    truth: Truth
    state: ReviewState | None


def _documents(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    documents = sorted([*path.glob("*.json"), *path.glob("*/*.json")])
    if not documents:
        raise FormatError(path, "has no OpenLABEL document (*.json)" if path.is_dir() else "does not exist")
    return documents


class _Reader:
    """Reads one document.

    Args:
        angles, quaternions: those of the cuboids of all documents; quaternions only of those in level frames.
    """

    def __init__(self, path: Path, content: doc.Content, angles: Angles, quaternions: Quaternions) -> None:
        self._path, self._content = path, content
        self._angles, self._quaternions = angles, quaternions
        streams = content.streams or {}
        # the cameras (True), or without cameras the only LiDAR (False)
        self._sensors = {name: True for name, stream in streams.items() if stream.type == "camera"}
        if not self._sensors:
            self._sensors = {name: False for name, stream in streams.items() if stream.type == "lidar"}
            if len(self._sensors) != 1:
                raise FormatError(
                    path, "has no stream of type camera, and not exactly one of type lidar; add the sensor of the boxes"
                )

    def frames(self, names: DatasetNames) -> Iterator[tuple[str, LabelledFrame]]:
        """Yields the names and frames, once for each of the cameras."""
        for number, frame in (self._content.frames or {}).items():
            properties = frame.frame_properties or doc.FrameProperties()
            with faults(self._path, f"openlabel.frames.{number}: "):
                coordinates = doc.Coordinates(self._content.coordinate_systems or {}, properties.transforms)
            boxes = list(self._boxes(int(number), frame))
            contexts = (frame.contexts or {}).values()
            values = {key: value for each in contexts for key, value in doc.values_of(each.context_data).items()}
            for sensor, of_camera in self._sensors.items():
                stream = (properties.streams or {}).get(sensor)
                if stream is None and len(self._sensors) > 1:
                    # this camera has no image in the frame
                    continue
                # paths may come from Windows; only the file name is used, the file is not opened
                stem = normal(stem_of(stream.uri)) if stream is not None and stream.uri else number
                is_placed = stem in names.frames and PLACE in (properties.transforms or {})
                in_map = in_world(coordinates.transform(WORLD, sensor) if is_placed else None)
                truths = [self._in_sensor(box, coordinates, sensor) for box in boxes]
                states = [box.state for box in boxes]
                yield names.known(stem), LabelledFrame(truths, in_map if of_camera else of_recording, states, values)

    def _boxes(self, number: int, frame: doc.Frame) -> Iterator[_Box]:
        """Yields the cuboids of a frame, then those of static objects."""
        objects = self._content.objects or {}
        present = {f"frames.{number}.objects.{uid}": (uid, each) for uid, each in (frame.objects or {}).items()}
        for uid, each in objects.items():
            spans = each.frame_intervals
            if not spans or any(span.frame_start <= number <= span.frame_end for span in spans):
                present[f"objects.{uid}"] = (uid, each)
        for where, (uid, data) in present.items():
            if uid not in objects:
                problem = "the object is not listed in openlabel.objects; add it there"
                raise FormatError(self._path, f"openlabel.{where}: {problem}")
            for place, cuboid in enumerate((data.object_data and data.object_data.cuboid) or ()):
                # null means "no cuboid" in the standard
                if cuboid.val is not None:
                    yield self._box(f"openlabel.{where}.object_data.cuboid.{place}", uid, cuboid, list(cuboid.val))

    def _box(self, place: str, uid: str, cuboid: doc.Cuboid, val: list[float]) -> _Box:
        each = (self._content.objects or {})[uid]
        system = cuboid.coordinate_system or each.coordinate_system
        if system is None:
            problem = "has no coordinate_system, and its object has none either; add one"
            raise FormatError(self._path, f"{place}: {problem}")
        values = cuboid.attributes.values() if cuboid.attributes else {}
        if len(val) == 9:
            val[3:6] = [self._angles.radians(angle, self._path) for angle in val[3:6]]
        elif not self._sensors.get(system):
            self._quaternions.add(val[3:7])
        score, state, kind = (values.get(name) for name in ("score", "state", "box_kind"))
        with faults(self._path, f"{place}: "):
            box, track_id = doc.box_from(val), _track(values.get("track_id"), uid)
            said = doc.said_from(str(values[doc.SAID_BY])) if doc.SAID_BY in values else ()
        score, box_kind = score if isinstance(score, float) else None, known_kind(kind) or BoxKind.BOX
        truth = Truth(each.type, box, track_id, score, None, box_kind, doc.values_of(cuboid.attributes), said)
        return _Box(place, system, truth, ReviewState(state) if state in set(ReviewState) else None)

    def _in_sensor(self, box: _Box, coordinates: doc.Coordinates, sensor: str) -> Truth:
        if box.system == sensor:
            return box.truth
        with faults(self._path, f"{box.place}: "):
            return box.truth.transformed(coordinates.transform(sensor, box.system))


def _track(attribute: AttributeValue | None, uid: str) -> int | None:
    if isinstance(attribute, float):
        if not attribute.is_integer():
            raise ValueError(f"track_id must be a whole number, not {attribute}")
        return int(attribute)
    if "-" in uid[1:]:
        return None
    if abs(number := int(uid)) > MOST_TRACK:
        raise ValueError(f"the object's number is its track id and must be at most {MOST_TRACK}, not {number:.6g}")
    return number
