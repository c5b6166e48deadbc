"""The `rcv` dataset: a folder of images, coloured point clouds and oriented boxes, modelled on 3D_HUMAN and 3D_HAND.

readme.py writes the README.md that describes the folder; model.py defines its JSON.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.file_names import OutsideError, inside, spelled
from annotator.files import TABLE_BYTES, new_folder, read_text_file
from annotator.formats.dataset_writing import DatasetItem, FrameIds, encoded_image, writing
from annotator.formats.json_file import read_model
from annotator.formats.ply import read_ply, write_ply
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
from annotator.image_bytes import read_image
from annotator.types import Camera, Frame, Label, OrientedBox, PointCloud, ReviewState, Source
from annotator.types.errors import FormatError
from annotator.types.label import AttributeValue, Said

# TODO-MERGED docstring of convert.py:
# Converts annotator's types to and from the records of an `rcv` dataset.


# Tolerance between quaternion or corners and the centre, rotation and size; metres for corners.
AGREEMENT = 1e-6


def camera_record(camera: Camera) -> RcvCamera:
    return RcvCamera(
        width_px=camera.width_px,
        height_px=camera.height_px,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion=camera.distortion,
    )


def camera_from(record: RcvCamera) -> Camera:
    """Returns the camera; raises ValueError for a number of distortion coefficients that OpenCV does not support."""
    size = (record.width_px, record.height_px)
    return Camera(*size, record.fx, record.fy, record.cx, record.cy, record.distortion)


def labels_record(
    frame_id: str,
    recording: str,
    frame: Frame,
    labels: Sequence[Label],
    image: str,
    cloud: str,
    attributes: Mapping[str, AttributeValue],
) -> RcvLabels:
    """Returns the record of one frame; `image` and `cloud` are its files within the dataset."""
    return RcvLabels(
        id=frame_id,
        recording=recording,
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
        attributes=dict(attributes),
        objects=tuple(object_record(label) for label in labels),
    )


def object_record(label: Label) -> RcvObject:
    box = label.box
    return RcvObject(
        uid=label.uid,
        label=label.label,
        score=label.score,
        source=label.source,
        state=label.state,
        author=label.author,
        time_ns=label.time_ns,
        track_id=label.track_id,
        expected_iou_loss=label.expected_iou_loss,
        suggestion=label.suggestion,
        box_kind=label.box_kind,
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
    return Label(
        uid=record.uid,
        label=record.label,
        box=box,
        score=record.score,
        source=record.source,
        state=record.state,
        author=record.author,
        time_ns=record.time_ns,
        track_id=record.track_id,
        expected_iou_loss=record.expected_iou_loss,
        suggestion=record.suggestion,
        box_kind=record.box_kind,
        attributes=record.attributes,
        said=tuple(map(_said, record.said)),
    )


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


# TODO-MERGED docstring of export.py:
# Writes an `rcv` dataset, one frame in memory at a time.


MANIFEST = "dataset.json"
FOLDERS = ("images", "clouds", "labels")
SPLITS = "splits"


@dataclass(frozen=True)
class RcvInfo:
    """Data about an export, written to its manifest.

    Attributes:
        classes: all class names of the project, in its order; every label must be one of them.
        detectors: the detectors that contributed to the boxes.
        generator: program and version, such as "annotator 0.1.0".
        options: how images are written.
    """

    classes: tuple[str, ...]
    detectors: tuple[RcvDetector, ...]
    generator: str
    options: RcvOptions = field(default_factory=RcvOptions)


def export_rcv(out: Path, items: Iterable[DatasetItem], info: RcvInfo, *, overwrite: bool = False) -> RcvManifest:
    """Writes the dataset folder `out` atomically and returns the content of its `dataset.json`.

    Args:
        out: a folder that is missing or empty; with `overwrite`, an older rcv dataset is replaced.
        items: the frames, read one by one; if reading one raises, `out` is unchanged.
        info: classes, detectors, generator, options.

    Raises:
        FormatError: `out` exists, there is no frame, a frame occurs twice, a label has an unknown class, or writing
            fails.
    """
    with new_folder(out, lambda folder: overwrite and _is_rcv(folder)) as part:
        tally = _Tally()
        with writing(out):
            for name in FOLDERS:
                (part / name).mkdir()
        for item in items:
            _require_classes(out, item, info.classes)
            frame_id = tally.add(out, item)
            with writing(out):
                _write_frame(part, frame_id, item, info.options)
        if not tally.ids.ids:
            raise FormatError(out, "there is no frame to export; the export was not written")
        manifest = tally.manifest(info)
        with writing(out):
            (part / "README.md").write_text(readme_text(manifest), encoding="utf-8")
            (part / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
            _write_splits(part, tally.splits)
    return manifest


def _is_rcv(folder: Path) -> bool:
    """True for an export of annotator; no other folder is overwritten."""
    manifest = folder / MANIFEST
    return manifest.is_file() and f'"{FORMAT_NAME}"' in read_text_file(manifest, TABLE_BYTES, errors="replace")


def _require_classes(out: Path, item: DatasetItem, classes: tuple[str, ...]) -> None:
    for label in item.labels:
        if label.label not in classes:
            where = f"{item.recording}, frame {item.frame.key}"
            raise FormatError(out, f"{where}: label {label.label!r} is not one of the classes {', '.join(classes)}")


def _write_frame(part: Path, frame_id: str, item: DatasetItem, options: RcvOptions) -> None:
    """Writes the frame's three files."""
    image, cloud = f"images/{frame_id}.{options.image_format}", f"clouds/{frame_id}.ply"
    (part / image).write_bytes(encoded_image(item.frame.rgb, options.image_format, options.jpeg_quality))
    write_ply(part / cloud, item.frame.cloud)
    record = labels_record(frame_id, item.recording, item.frame, item.labels, image, cloud, item.attributes)
    (part / f"labels/{frame_id}.json").write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")


def _write_splits(part: Path, splits: Mapping[str, Sequence[str]]) -> None:
    """Writes the ids of each part of a divided dataset, one per line."""
    for name, ids in splits.items():
        (part / SPLITS).mkdir(exist_ok=True)
        (part / SPLITS / f"{name}.txt").write_text("".join(f"{each}\n" for each in ids), encoding="utf-8")


@dataclass
class _Tally:
    """Ids and counts of the frames so far."""

    ids: FrameIds = field(default_factory=FrameIds)
    splits: dict[str, list[str]] = field(default_factory=dict)
    cameras: dict[RcvCamera, list[str]] = field(default_factory=dict)
    points: int = 0
    by_recording: Counter[str] = field(default_factory=Counter)
    objects_by_recording: Counter[str] = field(default_factory=Counter)
    objects_by_class: Counter[str] = field(default_factory=Counter)
    objects_by_state: Counter[ReviewState] = field(default_factory=Counter)
    objects_by_source: Counter[Source] = field(default_factory=Counter)

    def add(self, out: Path, item: DatasetItem) -> str:
        """Counts the frame and returns its id."""
        frame_id = self.ids.add(out, item)
        if item.split is not None:
            self.splits.setdefault(item.split, []).append(frame_id)
        recordings = self.cameras.setdefault(camera_record(item.frame.camera), [])
        if item.recording not in recordings:
            recordings.append(item.recording)
        self.points += len(item.frame.cloud)
        self.by_recording[item.recording] += 1
        self.objects_by_recording[item.recording] += len(item.labels)
        self.objects_by_class.update(label.label for label in item.labels)
        self.objects_by_state.update(label.state for label in item.labels)
        self.objects_by_source.update(label.source for label in item.labels)
        return frame_id

    def manifest(self, info: RcvInfo) -> RcvManifest:
        return RcvManifest(
            format=FORMAT_NAME,
            version=FORMAT_VERSION,
            generator=info.generator,
            classes=info.classes,
            conventions=RcvConventions(),
            detectors=info.detectors,
            options=info.options,
            cameras=tuple(RcvCameraUse(camera=c, recordings=tuple(names)) for c, names in self.cameras.items()),
            counts=RcvCounts(
                frames=len(self.ids.ids),
                objects=sum(self.objects_by_class.values()),
                points=self.points,
                frames_by_recording=dict(self.by_recording),
                objects_by_recording=dict(self.objects_by_recording),
                objects_by_class={name: self.objects_by_class[name] for name in info.classes},
                objects_by_state={state: self.objects_by_state[state] for state in ReviewState},
                objects_by_source={source: self.objects_by_source[source] for source in Source},
            ),
            frames=tuple(self.ids.ids.values()),
        )


# TODO-MERGED docstring of read.py:
# Reads an `rcv` dataset, one frame at a time.


# Maximum number of characters that a message quotes from an invalid name.
SHOWN = 60
MOST_LENGTH = 1e6


@dataclass(frozen=True, eq=False)
class RcvFrame:
    """One frame of a dataset with its id, its original recording and its labels."""

    id: str
    recording: str
    frame: Frame
    labels: tuple[Label, ...]


@dataclass(frozen=True, eq=False)
class RcvDataset:
    """A dataset whose frames are read on access.

    Attributes:
        path: the folder.
        manifest: the content of `dataset.json`.
    """

    path: Path
    manifest: RcvManifest

    def __len__(self) -> int:
        return len(self.manifest.frames)

    def labels(self, i: int) -> tuple[Label, ...]:
        """Returns the labels of frame `i` without reading its image and cloud.

        Raises:
            FormatError: the label file is missing or does not follow the format.
        """
        return _labels(*self._record(i))

    def named_labels(self, i: int) -> tuple[str, tuple[Label, ...], Values, RigidTransform | None]:
        """Returns the name `RECORDING/KEY` of frame `i`, its labels, its attributes and `T_world_camera`.

        Raises:
            FormatError: as `labels`.
        """
        path, record = self._record(i)
        return f"{record.recording}/{record.key}", _labels(path, record), record.attributes, _pose(path, record)

    def frame(self, i: int) -> RcvFrame:
        """Reads frame `i` with its labels.

        Raises:
            FormatError: one of its files is missing or does not follow the format.
        """
        path, record = self._record(i)
        return RcvFrame(record.id, record.recording, self._frame(path, record), _labels(path, record))

    def bare_frame(self, i: int) -> Frame:
        """Reads frame `i` without checking its labels."""
        return self._frame(*self._record(i))

    def place(self, i: int) -> tuple[str, int]:
        """Returns the original recording of frame `i`, and its number there.

        Raises:
            FormatError: as `labels`.
        """
        _, record = self._record(i)
        return record.recording, record.index

    def label_path(self, i: int) -> Path:
        """Returns the file with the labels and the camera of frame `i`."""
        return spelled(self.path / "labels", f"{self.manifest.frames[i]}.json")

    def _frame(self, path: Path, record: RcvLabels) -> Frame:
        rgb, file = _image(_inside(self.path, record.image, path)), _inside(self.path, record.cloud, path)
        cloud = read_ply(file)
        if len(cloud) != record.points:
            raise FormatError(file, f"holds {len(cloud)} points, but {path.name} says {record.points}")
        return _frame(path, record, rgb, cloud)

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
    """Opens a dataset; its frames are read on access.

    Raises:
        FormatError: `path` is not an rcv dataset, or its manifest contradicts itself.
    """
    if path.exists() and not (path / MANIFEST).exists():
        raise FormatError(path, f"is no dataset in the format rcv, which has a {MANIFEST}")
    manifest = read_model(path / MANIFEST, RcvManifest)
    if len(manifest.frames) != manifest.counts.frames or len(set(manifest.frames)) != len(manifest.frames):
        raise FormatError(
            path / MANIFEST, f"frames must list {manifest.counts.frames} different ids, as counts.frames says"
        )
    for frame_id in manifest.frames:
        if frame_id != Path(frame_id).name:
            raise FormatError(path / MANIFEST, f"the id {frame_id[:SHOWN]!r} is not a valid file name")
    return RcvDataset(path, manifest)


def _inside(folder: Path, name: str, listed_in: Path) -> Path:
    try:
        return inside(folder, name)
    except OutsideError as error:
        raise FormatError(listed_in, str(error)) from error


def _image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Reads the image, RGB order."""
    import cv2

    try:
        bgr = read_image(path, cv2.IMREAD_COLOR)
    except OSError as error:
        raise FormatError(path, f"the image cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise FormatError(path, f"{error}; export the dataset again") from error
    return np.ascontiguousarray(bgr[..., ::-1])


def _frame(path: Path, record: RcvLabels, rgb: np.ndarray, cloud: PointCloud) -> Frame:
    try:
        return Frame(
            key=record.key,
            index=record.index,
            camera=camera_from(record.camera),
            rgb=rgb,
            cloud=cloud,
            up=_direction(record.up),
            timestamp_ns=record.timestamp_ns,
            T_world_camera=_pose(path, record),
        )
    except ValueError as error:
        raise FormatError(path, str(error)) from error


def _pose(path: Path, record: RcvLabels) -> RigidTransform | None:
    try:
        return None if record.world is None else pose_from(record.world)
    except ValueError as error:
        raise FormatError(path, f"world: {error}") from error


def _direction(up: tuple[float, float, float] | None) -> Float64[np.ndarray, "3"] | None:
    """Returns `up` as a vector; raises ValueError if it is not a direction."""
    if up is None:
        return None
    vector = np.array(up)
    if not 0 < np.abs(vector).max() < MOST_LENGTH:
        raise ValueError(f"up must be a direction, not {list(up)}")
    return vector


def _labels(path: Path, record: RcvLabels) -> tuple[Label, ...]:
    labels = []
    for number, entry in enumerate(record.objects):
        try:
            labels.append(label_from(entry))
        except ValueError as error:
            raise FormatError(path, f"objects.{number}: {error}") from error
    return tuple(labels)


__all__ = [
    "RcvDataset",
    "RcvDetector",
    "RcvFrame",
    "RcvInfo",
    "RcvOptions",
    "export_rcv",
    "read_rcv",
]
