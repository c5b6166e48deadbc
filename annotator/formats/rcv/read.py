"""Reads an `rcv` dataset, one frame at a time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.formats.json_file import read_model
from annotator.formats.ply import read_ply
from annotator.formats.rcv.convert import camera_from, label_from, pose_from
from annotator.formats.rcv.export import MANIFEST
from annotator.formats.rcv.model import RcvLabels, RcvManifest, Values
from annotator.image_bytes import read_image
from annotator.text import OutsideError, inside, spelled
from annotator.types import Frame, Label, PointCloud
from annotator.types.errors import FormatError

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
