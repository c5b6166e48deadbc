"""Reads an `rcv` dataset back, a frame at a time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from annotator.files import is_within
from annotator.formats.json_file import read_model
from annotator.formats.ply import read_ply
from annotator.formats.rcv.convert import camera_from, label_from
from annotator.formats.rcv.export import MANIFEST
from annotator.formats.rcv.model import RcvLabels, RcvManifest
from annotator.pictures import decode_picture
from annotator.types import Frame, Label, PointCloud
from annotator.types.errors import FormatError

# Of a name that is none.
SHOWN = 60
MOST_LENGTH = 1e6


@dataclass(frozen=True, eq=False)
class RcvFrame:
    """One frame of a dataset: its id, the name of the recording it came from, and what was exported."""

    id: str
    recording: str
    frame: Frame
    labels: tuple[Label, ...]


@dataclass(frozen=True, eq=False)
class RcvDataset:
    """A dataset whose frames are read when asked for.

    Attributes:
        path: the folder.
        manifest: the content of `dataset.json`.
    """

    path: Path
    manifest: RcvManifest

    def __len__(self) -> int:
        return len(self.manifest.frames)

    def labels(self, i: int) -> tuple[Label, ...]:
        """The labels of frame `i`, without its image and cloud.

        Raises:
            FormatError: the label file is missing or does not follow the format.
        """
        return _labels(*self._record(i))

    def named_labels(self, i: int) -> tuple[str, tuple[Label, ...]]:
        """The same with the frame's name, `RECORDING/KEY`: where it came from, whatever its id in this dataset is."""
        path, record = self._record(i)
        return f"{record.recording}/{record.key}", _labels(path, record)

    def frame(self, i: int) -> RcvFrame:
        """Frame `i`, read from disk.

        Raises:
            FormatError: one of its files is missing or does not follow the format.
        """
        path, record = self._record(i)
        return RcvFrame(record.id, record.recording, self._frame(path, record), _labels(path, record))

    def bare_frame(self, i: int) -> Frame:
        """The same without the labels, whatever is wrong with them."""
        return self._frame(*self._record(i))

    def place(self, i: int) -> tuple[str, int]:
        """The recording that frame `i` came from, and its number there.

        Raises:
            FormatError: as `labels`.
        """
        _, record = self._record(i)
        return record.recording, record.index

    def label_path(self, i: int) -> Path:
        """The file of frame `i`'s labels and camera."""
        return self.path / "labels" / f"{self.manifest.frames[i]}.json"

    def _frame(self, path: Path, record: RcvLabels) -> Frame:
        rgb, cloud = _image(self.path / record.image), read_ply(self.path / record.cloud)
        if len(cloud) != record.points:
            raise FormatError(self.path / record.cloud, f"holds {len(cloud)} points, {path.name} says {record.points}")
        return _frame(path, record, rgb, cloud)

    def _record(self, i: int) -> tuple[Path, RcvLabels]:
        """The content of frame `i`'s label file, and its path."""
        frame_id, path = self.manifest.frames[i], self.label_path(i)
        if not is_within(self.path, f"labels/{frame_id}.json"):
            raise FormatError(self.path / MANIFEST, f"the labels of {frame_id[:SHOWN]!r} are no file of this dataset")
        record = read_model(path, RcvLabels)
        if record.id != frame_id:
            raise FormatError(path, f"says that its id is {record.id!r}")
        for name in (record.image, record.cloud):
            if not is_within(self.path, name):
                raise FormatError(path, f"{name[:SHOWN]!r} is not a file of this dataset")
        return path, record


def read_rcv(path: Path) -> RcvDataset:
    """Opens a dataset; its frames are read one by one, when asked for.

    Raises:
        FormatError: `path` holds no rcv dataset, or one whose manifest contradicts itself.
    """
    manifest = read_model(path / MANIFEST, RcvManifest)
    if len(manifest.frames) != manifest.counts.frames or len(set(manifest.frames)) != len(manifest.frames):
        raise FormatError(path / MANIFEST, f"frames must list {manifest.counts.frames} different ids, as counts says")
    for frame_id in manifest.frames:
        if frame_id != Path(frame_id).name:
            raise FormatError(path / MANIFEST, f"the id {frame_id[:SHOWN]!r} is not the name of a file")
    return RcvDataset(path, manifest)


def _image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """The picture, RGB order."""
    import cv2

    try:
        bgr = decode_picture(path.read_bytes(), cv2.IMREAD_COLOR)
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
        )
    except ValueError as error:
        raise FormatError(path, str(error)) from error


def _direction(up: tuple[float, float, float] | None) -> Float64[np.ndarray, "3"] | None:
    """Raises ValueError for numbers that are no direction."""
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
