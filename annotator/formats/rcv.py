"""The `rcv` dataset: a folder of images, coloured point clouds and oriented boxes, modelled on 3D_HUMAN and 3D_HAND.

    dataset.json          classes, cameras, counts, and the ids of all frames in order
    images/ID.png|jpg     clouds/ID.ply     labels/ID.json     splits/PART.txt     README.md

README.md describes the folder (`rcv_readme.md` is its template). All JSON is in metres, radians and pixels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import TABLE_BYTES, read_text_file
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, Detector, ply
from annotator.formats.frame_names import LabelledFrame, add_once, in_world
from annotator.formats.reading import faults, read_model
from annotator.geometry.transforms import corners_4x8
from annotator.image_bytes import JPEG_QUALITY
from annotator.text import NAME_SHOWN, OutsideError, inside, spelled
from annotator.types import BoxKind, Camera, Label, OrientedBox, ReviewState, Source, Suggestion, Truth
from annotator.types.bases import SaidRecord, Strict, TrackId
from annotator.types.errors import FormatError
from annotator.types.messages import amount

FORMAT_NAME = "annotator-rcv"
FRAME_OF_REFERENCE = "camera: the colour camera, right-handed, x right, y down, z forward, metres"
CORNER_ORDER = ("---", "+--", "++-", "-+-", "--+", "+-+", "+++", "-++")

# Limit for metres, pixels and radians; squares of such numbers stay finite.
LARGEST = 1e9
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=LARGEST, allow_inf_nan=False)]
Values = dict[str, bool | int | Number | str]
Vector3 = tuple[Number, Number, Number]
Vector4 = tuple[Number, Number, Number, Number]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Row8 = tuple[Number, Number, Number, Number, Number, Number, Number, Number]


class RcvBox(Strict):
    """A box: `center` and `size` (length, width, height), and `quaternion` (w, x, y, z)."""

    center: Vector3
    size: tuple[Positive, Positive, Positive]
    quaternion: Vector4


class RcvSaid(SaidRecord, RcvBox):
    """What one source, such as a detector, said of an object before its review."""


class RcvObject(RcvBox):
    """One object of a frame.

    `center`, `rotation` (columns = box axes in the camera frame) and `size` are the box; `quaternion` and `corners`
    (Eq. (1): rows x, y, z, 1; columns in `CORNER_ORDER`) repeat it.
    """

    uid: str = Field(min_length=1)
    label: str = Field(min_length=1)
    score: float | None = Field(ge=0, le=1)
    source: Source
    state: ReviewState
    author: str
    time_ns: int
    track_id: TrackId | None
    expected_iou_loss: float | None = Field(None, ge=0, le=1)
    suggestion: Suggestion | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: Values = Field(default_factory=dict)
    said: tuple[RcvSaid, ...] = ()
    rotation: Matrix3
    corners: tuple[Row8, Row8, Row8, Row8]


class RcvPose(Strict):
    """A pose: it maps coordinates p of the camera to `rotation(quaternion) p + translation`."""

    translation: Vector3
    quaternion: Vector4


class RcvLabels(Strict):
    """`labels/ID.json`: one frame.

    `key`, `index` and `recording` are the frame's origin; `up` is the unit vector against gravity in the camera frame,
    None if unknown. `attributes` are values of the frame itself. `world` is the camera's pose in the map coordinates of
    the recording, None without such. The camera's `distortion` is as in `RcvConventions`.
    """

    id: str
    recording: str
    key: str
    index: int = Field(ge=0)
    timestamp_ns: int | None
    image: str
    cloud: str
    points: int = Field(ge=0)
    frame_of_reference: str
    up: Vector3 | None
    camera: Camera
    world: RcvPose | None = None
    attributes: Values = Field(default_factory=dict)
    objects: tuple[RcvObject, ...]


class RcvOptions(Strict):
    """How an export is written: lossless PNG, or JPEG at the given quality."""

    image_format: Literal["png", "jpg"] = "png"
    jpeg_quality: int = Field(95, ge=1, le=100)


class RcvConventions(Strict):
    """The conventions of the numbers, in words."""

    frame_of_reference: str = FRAME_OF_REFERENCE
    box_axes: str = "x along the length, y along the width, z along the height, origin at the centre"
    rotation: str = "columns = box axes in the camera frame"
    quaternion: str = "w x y z"
    corners: str = "4 x 8, rows x y z 1, columns in corner_order (signs along the box's x y z)"
    corner_order: tuple[str, ...] = CORNER_ORDER
    pixels: str = "continuous; the centre of the first pixel is (0, 0)"
    distortion: str = "OpenCV: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]; empty for an ideal pinhole"


class RcvCameraUse(Strict):
    """A camera and the recordings in which it occurs."""

    camera: Camera
    recordings: tuple[str, ...]


class RcvCounts(Strict):
    """The numbers of frames, points, and objects by class, review state and source."""

    frames: int
    objects: int
    points: int
    frames_by_recording: dict[str, int]
    objects_by_recording: dict[str, int]
    objects_by_class: dict[str, int]
    objects_by_state: dict[ReviewState, int]
    objects_by_source: dict[Source, int]


class RcvManifest(Strict):
    """`dataset.json`: the whole dataset; `frames` lists the ids in order."""

    format: Literal["annotator-rcv"]
    version: Literal[1]
    generator: str
    classes: tuple[str, ...]
    conventions: RcvConventions
    detectors: tuple[Detector, ...]
    options: RcvOptions
    cameras: tuple[RcvCameraUse, ...]
    counts: RcvCounts
    frames: tuple[str, ...]


# The template of the README.md.
README = Path(__file__).with_name("rcv_readme.md")
CLOUD_NOTE = ", then, if the sensor measures them, uchar `red green blue` and float `reflectance` (0..1)"


def readme_text(manifest: RcvManifest) -> str:
    """Returns the README.md for a dataset with this manifest."""
    counts, options = manifest.counts, manifest.options
    jpeg = options.image_format == "jpg"
    tables = [
        _table("class", "objects", counts.objects_by_class),
        _table("review state", "objects", {str(state): n for state, n in counts.objects_by_state.items()}),
        _table("recording", "frames", counts.frames_by_recording),
        _table("recording", "objects", counts.objects_by_recording),
        _table("detector", "name and fingerprint", {d.role: f"{d.name} {d.fingerprint}" for d in manifest.detectors}),
    ]
    return read_text_file(README).format(
        objects=amount(counts.objects, "object"),
        frames=amount(counts.frames, "frame"),
        generator=manifest.generator,
        format=manifest.format,
        version=manifest.version,
        image=options.image_format,
        image_note=f", JPEG quality {options.jpeg_quality}" if jpeg else ", lossless",
        cloud_note=CLOUD_NOTE,
        classes=", ".join(f"`{name}`" for name in manifest.classes),
        corner_order="  ".join(manifest.conventions.corner_order),
        example=manifest.frames[0],
        tables="\n".join(table for table in tables if table),
    )


def _table(first: str, second: str, rows: dict[str, int] | dict[str, str]) -> str:
    """Returns a Markdown table of two columns; "" without rows."""
    if not rows:
        return ""
    cells = [tuple(str(cell).replace("|", "\\|") for cell in row) for row in rows.items()]
    lines = [f"| {first} | {second} |", "|---|---|", *(f"| {key} | {value} |" for key, value in cells)]
    return "\n".join(lines) + "\n"


# Tolerance between quaternion or corners and the centre, rotation and size; metres for corners.
AGREEMENT = 1e-6


def labels_record(frame_id: str, item: DatasetItem, image: str, cloud: str) -> RcvLabels:
    """Returns the record of one frame; `image` and `cloud` are its files within the dataset."""
    frame, world = item.frame, item.frame.T_world_camera
    return RcvLabels(
        id=frame_id,
        recording=item.recording,
        key=frame.key,
        index=frame.index,
        timestamp_ns=frame.timestamp_ns,
        image=image,
        cloud=cloud,
        points=len(frame.cloud),
        frame_of_reference=FRAME_OF_REFERENCE,
        up=None if frame.up is None else frame.up.tolist(),
        camera=frame.camera,
        world=None if world is None else {"translation": world.translation.tolist(), "quaternion": _quaternion(world)},
        attributes=dict(item.attributes),
        objects=tuple(map(object_record, item.labels)),
    )


# What labels and their records have in common.
COMMON = (
    *("uid", "label", "score", "source", "state", "author", "time_ns", "track_id"),
    *("expected_iou_loss", "suggestion", "box_kind"),
)


def _named(of: object, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(of, name) for name in names}


def _box_fields(box: OrientedBox) -> dict[str, Any]:
    return {
        "center": box.center_m.tolist(),
        "size": box.size_m.tolist(),
        "quaternion": _quaternion(box.T_camera_box),
    }


def _box(record: RcvBox) -> OrientedBox:
    """Returns the box of a record; raises ValueError for a quaternion of length zero."""
    return OrientedBox.at(_transform(record.center, record.quaternion), np.array(record.size))


def object_record(label: Label) -> RcvObject:
    box = label.box
    return RcvObject(
        **_named(label, COMMON),
        **_box_fields(box),
        attributes=dict(label.attributes),
        said=tuple(RcvSaid(**_named(each, SaidRecord.model_fields), **_box_fields(each.box)) for each in label.said),
        rotation=box.rotation.tolist(),
        corners=corners_4x8(box).tolist(),
    )


def truth_from(record: RcvObject) -> Truth:
    """Returns the object of a record.

    Raises:
        ValueError: the rotation is invalid, or quaternion or corners disagree with centre, size and rotation.
    """
    by_matrix = OrientedBox.from_parts(np.array(record.center), np.array(record.rotation), np.array(record.size))
    # the quaternion gives an exactly orthonormal rotation, the matrix only a rounded one
    box = _box(record)
    if np.abs(box.rotation - by_matrix.rotation).max() > AGREEMENT:
        raise ValueError("quaternion and rotation disagree; correct the quaternion from the rotation")
    reach = 1.0 + np.abs(box.center_m).max() + box.size_m.max()
    if np.abs(corners_4x8(box) - np.array(record.corners)).max() > AGREEMENT * reach:
        raise ValueError("corners disagree with center, size and rotation; correct the corners")
    said = tuple(each.said(_box(each)) for each in record.said)
    return Truth(record.label, box, record.track_id, record.score, None, record.box_kind, record.attributes, said)


def _transform(translation: Vector3, quaternion: Vector4) -> RigidTransform:
    """Returns a pose; raises ValueError for a quaternion of length zero."""
    return RigidTransform.from_components(translation, Rotation.from_quat(quaternion, scalar_first=True))


def _quaternion(T: RigidTransform) -> list[float]:
    quaternion: list[float] = T.rotation.as_quat(canonical=True, scalar_first=True).tolist()
    return quaternion


MANIFEST = "dataset.json"
FOLDERS = ("images", "clouds", "labels")
SPLITS = "splits"


class RcvWriter(DatasetWriter):
    """Writes all that labels hold. Every label must have one of `info.classes`."""

    def begin(self) -> None:
        self.cameras: dict[tuple[Any, ...], tuple[Camera, list[str]]] = {}
        self.points = 0
        self.by_recording, self.objects_by_recording = Counter[str](), Counter[str]()
        self.by_state, self.by_source = Counter[ReviewState](), Counter[Source]()

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        classes, frame = self.info.classes, item.frame
        for label in item.labels:
            if label.label not in classes:
                where = f"{item.recording}, frame {frame.key}"
                problem = f"{where}: label {label.label!r} is not one of the classes {', '.join(classes)}"
                raise FormatError(self.out, problem)
        _, recordings = self.cameras.setdefault(astuple(frame.camera), (frame.camera, []))
        if item.recording not in recordings:
            recordings.append(item.recording)
        self.points += len(frame.cloud)
        self.by_recording[item.recording] += 1
        self.objects_by_recording[item.recording] += len(item.labels)
        self.counts.update(label.label for label in item.labels)
        self.by_state.update(label.state for label in item.labels)
        self.by_source.update(label.source for label in item.labels)
        image, cloud = self.put_image(f"images/{frame_id}", frame.rgb), f"clouds/{frame_id}.ply"
        self.put(cloud, ply(frame.cloud))
        record = labels_record(frame_id, item, image, cloud)
        self.put(f"labels/{frame_id}.json", record.model_dump_json(indent=1) + "\n")

    def finish(self) -> None:
        manifest = self.manifest()
        self.put("README.md", readme_text(manifest))
        self.put(MANIFEST, manifest.model_dump_json(indent=1) + "\n")
        for name, ids in self.parts().items():
            self.put(f"{SPLITS}/{name}.txt", "".join(f"{each}\n" for each in ids))

    def manifest(self) -> RcvManifest:
        return RcvManifest(
            format=FORMAT_NAME,
            version=1,
            generator=self.info.generator,
            classes=self.info.classes,
            conventions=RcvConventions(),
            detectors=tuple(self.info.detectors),
            options=RcvOptions(image_format=self.info.image_format, jpeg_quality=JPEG_QUALITY),
            cameras=tuple(RcvCameraUse(camera=c, recordings=tuple(names)) for c, names in self.cameras.values()),
            counts=RcvCounts(
                frames=len(self.origins),
                objects=self.counts.total(),
                points=self.points,
                frames_by_recording=dict(self.by_recording),
                objects_by_recording=dict(self.objects_by_recording),
                objects_by_class={name: self.counts[name] for name in self.info.classes},
                objects_by_state={state: self.by_state[state] for state in ReviewState},
                objects_by_source={source: self.by_source[source] for source in Source},
            ),
            frames=tuple(origin.id for origin in self.origins),
        )


def is_rcv_export(folder: Path) -> bool:
    """True for an export of annotator; no other folder is overwritten."""
    manifest = folder / MANIFEST
    return manifest.is_file() and f'"{FORMAT_NAME}"' in read_text_file(manifest, TABLE_BYTES, errors="replace")


@dataclass(frozen=True, eq=False)
class RcvDataset:
    """The labels of a dataset, read frame by frame on access. As a recording, it is read by `annotator.recordings`.

    Attributes:
        path: the folder.
        manifest: the content of `dataset.json`.
    """

    path: Path
    manifest: RcvManifest

    def __len__(self) -> int:
        return len(self.manifest.frames)

    def labelled(self, i: int) -> tuple[str, LabelledFrame]:
        """Returns the name `RECORDING/KEY` of frame `i`, and its objects."""
        path, record = self._record(i)
        with faults(path, "world: "):
            pose = None if record.world is None else _transform(record.world.translation, record.world.quaternion)
        truths = []
        for number, entry in enumerate(record.objects):
            with faults(path, f"objects.{number}: "):
                truths.append(truth_from(entry))
        states = tuple(each.state for each in record.objects)
        frame = LabelledFrame(truths, in_world(pose), states, record.attributes)
        return f"{record.recording}/{record.key}", frame

    def place(self, i: int) -> tuple[str, int]:
        """Returns the original recording of frame `i`, and its number there."""
        _, record = self._record(i)
        return record.recording, record.index

    def label_path(self, i: int) -> Path:
        """Returns the file with the labels and the camera of frame `i`."""
        return spelled(self.path / "labels", f"{self.manifest.frames[i]}.json")

    def _record(self, i: int) -> tuple[Path, RcvLabels]:
        """Returns the path and the content of frame `i`'s label file."""
        frame_id, path = self.manifest.frames[i], self.label_path(i)
        _inside(self.path, f"labels/{frame_id}.json", self.path / MANIFEST)
        record = read_model(path, RcvLabels)
        if record.id != frame_id:
            raise FormatError(path, f"has the id {record.id!r}, but the file's name requires {frame_id!r}")
        for name in (record.image, record.cloud):
            _inside(self.path, name, path)
        return path, record


def read_rcv(path: Path) -> RcvDataset:
    """Opens a dataset; its frames are read on access."""
    if path.exists() and not (path / MANIFEST).exists():
        raise FormatError(path, f"is no dataset in the format rcv, which has a {MANIFEST}")
    manifest = read_model(path / MANIFEST, RcvManifest)
    if len(manifest.frames) != manifest.counts.frames or len(set(manifest.frames)) != len(manifest.frames):
        raise FormatError(
            path / MANIFEST, f"frames must list {manifest.counts.frames} different ids, as counts.frames says"
        )
    for frame_id in manifest.frames:
        if frame_id != Path(frame_id).name:
            raise FormatError(path / MANIFEST, f"the id {frame_id[:NAME_SHOWN]!r} is not a valid file name")
    return RcvDataset(path, manifest)


def labelled_frames(path: Path) -> dict[str, LabelledFrame]:
    """Returns the labels of a dataset by `RECORDING/KEY`."""
    dataset, frames = read_rcv(path), dict[str, LabelledFrame]()
    for index in range(len(dataset)):
        add_once(frames, dataset.label_path(index), *dataset.labelled(index))
    return frames


def _inside(folder: Path, name: str, listed_in: Path) -> Path:
    try:
        return inside(folder, name)
    except OutsideError as error:
        raise FormatError(listed_in, str(error)) from error
