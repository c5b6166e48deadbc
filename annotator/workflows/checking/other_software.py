"""Datasets of other software: their labels are read as `annotator import` reads them, and faults are reported.

Of their boxes only units and sizes are checked, because the frames that they label belong to a project, not to the
dataset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from annotator.files import open_file, read_file
from annotator.formats import sustechpoints
from annotator.formats.coco import is_coco_dataset, read_coco_dataset
from annotator.formats.json_file import read_json
from annotator.formats.labelcloud import CLASSES_FILE, CLOUDS, LABELS, read_labelcloud
from annotator.formats.nuscenes import read_nuscenes
from annotator.formats.openlabel import read_openlabel
from annotator.formats.rcv import MANIFEST
from annotator.formats.reading import OnFault
from annotator.formats.yolo import CLASSES, DATA_YAML, SUFFIXES, read_yolo
from annotator.text import normal
from annotator.types import OrientedBox
from annotator.types.errors import FormatError
from annotator.workflows.importing import BoxFormat, FlatFormat, format_of, read_labels

SNIFFED_BYTES = 256
# Formats of labels that open as a recording with their images and clouds.
OF_RECORDINGS = (BoxFormat.KITTI, BoxFormat.KITTI_TRACKING, BoxFormat.SUNRGBD, BoxFormat.BOXES)

Sizes = Sequence[tuple[str, Float64[np.ndarray, "3"]]]


class Part(NamedTuple):
    """A part of a dataset: its numbers of frames and labels, and class and size of each 3D box."""

    frames: int
    labels: int
    sizes: Sizes = ()


@dataclass(frozen=True)
class OtherSoftwareDataset:
    """A dataset whose boxes are not compared with clouds and images.

    Attributes:
        format: the format's name to display.
        is_recording: the folder has clouds or images beside the labels, so it may also be a recording.
        opened_as: format of the recordings whose own labels these are; their boxes are checked there.
        read: reads the parts one by one, so that a fault in one does not affect the others.
    """

    path: Path
    format: str
    is_recording: bool
    read: Callable[[Path, OnFault], Iterator[Part]]
    opened_as: str | None = None

    def parts(self, on_fault: OnFault) -> Iterator[Part]:
        """Yields the counts of each part.

        Args:
            on_fault: called with each fault.
        """
        return self.read(self.path, on_fault)


def other_software_dataset(path: Path) -> OtherSoftwareDataset | None:
    """Returns the dataset in a folder, without looking into subfolders; None for unknown formats."""
    if not path.is_dir() or (path / MANIFEST).is_file():
        return None
    if any((folder / "sample_annotation.json").is_file() for folder in path.glob("v1.0-*")):
        return OtherSoftwareDataset(path, "nuScenes tables", False, _nuscenes)
    if any(_is_openlabel(file) for file in path.glob("*.json")):
        return OtherSoftwareDataset(path, "OpenLABEL documents", False, _openlabel, "openlabel")
    if _is_labelcloud(path):
        return OtherSoftwareDataset(path, "labelCloud labels", True, _labelcloud, "cloud_folder")
    if (path / sustechpoints.CLOUDS).is_dir() and any((path / sustechpoints.LABELS).glob("*.json")):
        return OtherSoftwareDataset(path, "SUSTechPOINTS labels", True, partial(_imported, BoxFormat.SUSTECHPOINTS))
    if is_coco_dataset(path):
        return OtherSoftwareDataset(path, "COCO boxes", True, _coco)
    if _is_yolo(path):
        return OtherSoftwareDataset(path, "YOLO boxes", True, _yolo)
    return None


def labels_alone(path: Path) -> OtherSoftwareDataset | None:
    """Returns the labels at a path without images or clouds; None for those that are checked with their recording."""
    try:
        format = format_of(path)
    except FormatError:
        return None
    if format in OF_RECORDINGS:
        return None
    if isinstance(format, FlatFormat):
        return OtherSoftwareDataset(path, f"{format} boxes", False, _coco if format is FlatFormat.COCO else _yolo)
    return OtherSoftwareDataset(path, f"{format} labels", False, partial(_imported, format))


def _imported(format: BoxFormat, path: Path, on_fault: OnFault) -> Iterator[Part]:
    """Reads labels as `annotator import` does."""
    try:
        labels = read_labels(format, path)
    except FormatError as fault:
        on_fault(fault)
    else:
        classes = [label for name in labels.frames for label in labels.classes(name)]
        yield Part(len(labels.frames), len(classes), list(zip(classes, labels.sizes_m, strict=False)))


def _is_openlabel(file: Path) -> bool:
    with suppress(OSError), open_file(file) as stream:
        return b'"openlabel"' in stream.read(SNIFFED_BYTES)
    return False


def _is_labelcloud(path: Path) -> bool:
    """True for a project folder (or a part of one): JSON beside clouds, or with labelCloud's `_classes.json`."""
    labels = path / LABELS
    if not ((path / CLOUDS).is_dir() or (labels / CLASSES_FILE).is_file()):
        return False
    return any(file.name != CLASSES_FILE for file in labels.glob("*.json"))


def _is_yolo(path: Path) -> bool:
    """True for Ultralytics' `data.yaml`, or `classes.txt` with labels in `labels` or beside images of the same name."""
    if (path / DATA_YAML).is_file():
        with suppress(OSError):
            return b"names:" in read_file(path / DATA_YAML)
    if not (path / CLASSES).is_file():
        return False
    if any(file.name != CLASSES for file in (path / "labels").glob("*.txt")):
        return True
    pictures = {normal(file.stem) for file in path.iterdir() if file.suffix.lower() in SUFFIXES}
    return any(normal(file.stem) in pictures for file in path.glob("*.txt"))


def _nuscenes(path: Path, on_fault: OnFault) -> Iterator[Part]:
    yield from _solid(
        lambda: [[(box.label, box.box) for box in boxes] for boxes in read_nuscenes(path, on_fault).values()], on_fault
    )


def _openlabel(path: Path, on_fault: OnFault) -> Iterator[Part]:
    """Reads each document; other JSON files must be valid JSON, else they are reported as truncated documents."""
    for file in sorted(path.glob("*.json")):
        if _is_openlabel(file):
            yield from _solid(partial(_of_document, file), on_fault)
            continue
        try:
            read_json(file)
        except FormatError as fault:
            on_fault(fault)


def _of_document(file: Path) -> list[list[tuple[str, OrientedBox]]]:
    return [[(box.label, box.box) for box in frame.boxes] for frame in read_openlabel(file).values()]


def _labelcloud(path: Path, on_fault: OnFault) -> Iterator[Part]:
    yield from _solid(lambda: [frame.boxes for frame in read_labelcloud(path, on_fault).values()], on_fault)


def _coco(path: Path, on_fault: OnFault) -> Iterator[Part]:
    yield from _part(
        lambda: [len(image.boxes) for _, images in read_coco_dataset(path, on_fault) for image in images], on_fault
    )


def _yolo(path: Path, on_fault: OnFault) -> Iterator[Part]:
    yield from _part(lambda: [len(picture.boxes) for picture in read_yolo(path, on_fault)], on_fault)


def _part(boxes_of_frames: Callable[[], list[int]], on_fault: OnFault) -> Iterator[Part]:
    try:
        counts = boxes_of_frames()
    except FormatError as fault:
        on_fault(fault)
    else:
        yield Part(len(counts), sum(counts))


def _solid(read: Callable[[], Sequence[Sequence[tuple[str, OrientedBox]]]], on_fault: OnFault) -> Iterator[Part]:
    """Yields the part with the 3D boxes of all frames."""
    try:
        frames = read()
    except FormatError as fault:
        on_fault(fault)
    else:
        sizes = [(label, box.size_m) for boxes in frames for label, box in boxes]
        yield Part(len(frames), len(sizes), sizes)
