"""The `rcv` dataset: a folder of images, coloured point clouds and oriented boxes, modelled on 3D_HUMAN and 3D_HAND.

    dataset.json          classes, cameras, counts, and the ids of all frames in order
    images/ID.png|jpg     clouds/ID.ply     labels/ID.json     splits/PART.txt     README.md

`rcv_files.py` defines the JSON and the README.md, which describes the folder.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import TABLE_BYTES, read_text_file
from annotator.formats.dataset_writing import JPEG_QUALITY, DatasetItem, DatasetWriter, encoded_image, write_ply
from annotator.formats.json_file import read_model
from annotator.formats.rcv_files import (
    FORMAT_NAME,
    FORMAT_VERSION,
    FRAME_OF_REFERENCE,
    Matrix3,
    RcvCamera,
    RcvCameraUse,
    RcvConventions,
    RcvCounts,
    RcvDetector,
    RcvLabels,
    RcvManifest,
    RcvObject,
    RcvOptions,
    RcvPose,
    RcvSaid,
    Values,
    Vector3,
    readme_text,
)
from annotator.geometry.transforms import corners_4x8
from annotator.text import NAME_SHOWN, OutsideError, inside, spelled
from annotator.types import Camera, Label, OrientedBox, ReviewState, Source
from annotator.types.errors import FormatError
from annotator.types.label import Said

# Tolerance between quaternion or corners and the centre, rotation and size; metres for corners.
AGREEMENT = 1e-6


def camera_record(camera: Camera) -> RcvCamera:
    return RcvCamera(**asdict(camera))


def labels_record(frame_id: str, item: DatasetItem, image: str, cloud: str) -> RcvLabels:
    """Returns the record of one frame; `image` and `cloud` are its files within the dataset."""
    frame = item.frame
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
        up=None if frame.up is None else _vector(frame.up),
        camera=camera_record(frame.camera),
        world=None if frame.T_world_camera is None else _pose_record(frame.T_world_camera),
        attributes=dict(item.attributes),
        objects=tuple(map(object_record, item.labels)),
    )


# What labels and their records have in common.
COMMON = (
    *("uid", "label", "score", "source", "state", "author", "time_ns", "track_id"),
    *("expected_iou_loss", "suggestion", "box_kind"),
)


def _common(of: Label | RcvObject) -> dict[str, Any]:
    return {name: getattr(of, name) for name in COMMON}


def object_record(label: Label) -> RcvObject:
    box = label.box
    return RcvObject(
        **_common(label),
        attributes=dict(label.attributes),
        said=tuple(map(_said_record, label.said)),
        center=_vector(box.center_m),
        size=_vector(box.size_m),
        rotation=_matrix(box.rotation),
        quaternion=_quaternion(box.T_camera_box),
        corners=tuple(tuple(row) for row in corners_4x8(box).tolist()),
    )


def label_from(record: RcvObject) -> Label:
    """Returns the label of a record.

    Raises:
        ValueError: the rotation is invalid, or quaternion or corners disagree with centre, size and rotation.
    """
    rotation = np.array(record.rotation)
    box = OrientedBox.from_parts(np.array(record.center), rotation, np.array(record.size))
    quaternion = Rotation.from_quat(record.quaternion, scalar_first=True)
    if np.abs(quaternion.as_matrix() - box.rotation).max() > AGREEMENT:
        raise ValueError("quaternion and rotation disagree; correct the quaternion from the rotation")
    # the quaternion gives an exactly orthonormal rotation, the matrix only a rounded one
    box = OrientedBox.at(RigidTransform.from_components(np.array(record.center), quaternion), np.array(record.size))
    reach = 1.0 + np.abs(box.center_m).max() + box.size_m.max()
    if np.abs(corners_4x8(box) - np.array(record.corners)).max() > AGREEMENT * reach:
        raise ValueError("corners disagree with center, size and rotation; correct the corners")
    return Label(**_common(record), box=box, attributes=record.attributes, said=tuple(map(_said, record.said)))


def _said_record(said: Said) -> RcvSaid:
    return RcvSaid(
        source=said.source,
        label=said.label,
        score=said.score,
        track_id=said.track_id,
        box_kind=said.box_kind,
        center=_vector(said.box.center_m),
        size=_vector(said.box.size_m),
        quaternion=_quaternion(said.box.T_camera_box),
    )


def _said(record: RcvSaid) -> Said:
    rotation = Rotation.from_quat(record.quaternion, scalar_first=True)
    box = OrientedBox.at(RigidTransform.from_components(np.array(record.center), rotation), np.array(record.size))
    return Said(record.source, record.label, box, record.score, record.track_id, record.box_kind)


def _pose_record(T: RigidTransform) -> RcvPose:
    return RcvPose(translation=_vector(T.translation), quaternion=_quaternion(T))


def pose_from(record: RcvPose) -> RigidTransform:
    """Returns the transform of a record; raises ValueError for a quaternion of length zero."""
    rotation = Rotation.from_quat(record.quaternion, scalar_first=True)
    return RigidTransform.from_components(np.array(record.translation), rotation)


def _quaternion(T: RigidTransform) -> tuple[float, float, float, float]:
    w, x, y, z = T.rotation.as_quat(canonical=True, scalar_first=True).tolist()
    return (w, x, y, z)


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = values.tolist()
    return (x, y, z)


def _matrix(values: np.ndarray) -> Matrix3:
    return (_vector(values[0]), _vector(values[1]), _vector(values[2]))


MANIFEST = "dataset.json"
FOLDERS = ("images", "clouds", "labels")
SPLITS = "splits"


class RcvWriter(DatasetWriter):
    """Writes all that labels hold. Every label must have one of `info.classes`."""

    def begin(self) -> None:
        self.splits: dict[str, list[str]] = {}
        self.cameras: dict[RcvCamera, list[str]] = {}
        self.points = 0
        self.by_recording, self.objects_by_recording = Counter[str](), Counter[str]()
        self.by_state, self.by_source = Counter[ReviewState](), Counter[Source]()
        for name in FOLDERS:
            (self.folder / name).mkdir()

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        classes = self.info.classes
        for label in item.labels:
            if label.label not in classes:
                where = f"{item.recording}, frame {item.frame.key}"
                problem = f"{where}: label {label.label!r} is not one of the classes {', '.join(classes)}"
                raise FormatError(self.out, problem)
        self._count(item, frame_id)
        image, cloud = f"images/{frame_id}.{self.info.image_format}", f"clouds/{frame_id}.ply"
        (self.folder / image).write_bytes(encoded_image(item.frame.rgb, self.info.image_format))
        write_ply(self.folder / cloud, item.frame.cloud)
        record = labels_record(frame_id, item, image, cloud)
        (self.folder / f"labels/{frame_id}.json").write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")

    def _count(self, item: DatasetItem, frame_id: str) -> None:
        if item.split is not None:
            self.splits.setdefault(item.split, []).append(frame_id)
        recordings = self.cameras.setdefault(camera_record(item.frame.camera), [])
        if item.recording not in recordings:
            recordings.append(item.recording)
        self.points += len(item.frame.cloud)
        self.by_recording[item.recording] += 1
        self.objects_by_recording[item.recording] += len(item.labels)
        self.counts.update(label.label for label in item.labels)
        self.by_state.update(label.state for label in item.labels)
        self.by_source.update(label.source for label in item.labels)

    def finish(self) -> None:
        manifest = self.manifest()
        (self.folder / "README.md").write_text(readme_text(manifest), encoding="utf-8")
        (self.folder / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
        for name, ids in self.splits.items():
            (self.folder / SPLITS).mkdir(exist_ok=True)
            (self.folder / SPLITS / f"{name}.txt").write_text("".join(f"{each}\n" for each in ids), encoding="utf-8")

    def manifest(self) -> RcvManifest:
        return RcvManifest(
            format=FORMAT_NAME,
            version=FORMAT_VERSION,
            generator=self.info.generator,
            classes=self.info.classes,
            conventions=RcvConventions(),
            detectors=tuple(RcvDetector(**asdict(each)) for each in self.info.detectors),
            options=RcvOptions(image_format=self.info.image_format, jpeg_quality=JPEG_QUALITY),
            cameras=tuple(RcvCameraUse(camera=c, recordings=tuple(names)) for c, names in self.cameras.items()),
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

    def labels(self, i: int) -> tuple[Label, ...]:
        """Returns the labels of frame `i`."""
        return _labels(*self._record(i))

    def named_labels(self, i: int) -> tuple[str, tuple[Label, ...], Values, RigidTransform | None]:
        """Returns the name `RECORDING/KEY` of frame `i`, its labels, its attributes and `T_world_camera`."""
        path, record = self._record(i)
        return f"{record.recording}/{record.key}", _labels(path, record), record.attributes, _pose(path, record)

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


def _inside(folder: Path, name: str, listed_in: Path) -> Path:
    try:
        return inside(folder, name)
    except OutsideError as error:
        raise FormatError(listed_in, str(error)) from error


def _pose(path: Path, record: RcvLabels) -> RigidTransform | None:
    try:
        return None if record.world is None else pose_from(record.world)
    except ValueError as error:
        raise FormatError(path, f"world: {error}") from error


def _labels(path: Path, record: RcvLabels) -> tuple[Label, ...]:
    labels = []
    for number, entry in enumerate(record.objects):
        try:
            labels.append(label_from(entry))
        except ValueError as error:
            raise FormatError(path, f"objects.{number}: {error}") from error
    return tuple(labels)
