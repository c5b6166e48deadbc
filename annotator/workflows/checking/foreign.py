"""Datasets of other software: their labels are read as `annotator import` reads them, so that broken ones are told.

Their boxes are not looked at further: the frames that they belong to are those of a project.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from annotator.formats.coco_dataset import is_coco_dataset, read_coco_dataset
from annotator.formats.faults import Tell
from annotator.formats.json_file import read_json
from annotator.formats.labelcloud import read_labelcloud
from annotator.formats.labelcloud.model import CLASSES_FILE
from annotator.formats.labelcloud.write import CLOUDS, LABELS
from annotator.formats.nuscenes import read_nuscenes
from annotator.formats.openlabel import read_openlabel
from annotator.formats.rcv.export import MANIFEST
from annotator.formats.yolo_dataset import DATA_YAML
from annotator.formats.yolo_read import CLASSES, SUFFIXES, read_yolo
from annotator.types.errors import FormatError

SNIFFED_BYTES = 256

Part = tuple[int, int]
"""How many frames and labels a part of a dataset has."""


@dataclass(frozen=True)
class ForeignDataset:
    """A dataset whose labels are read, and whose boxes are not looked at.

    Attributes:
        format: its name, for a person.
        is_recording: a reader of recordings may open the same folder: it has clouds or images beside the labels.
        read: its parts, each read on its own, so that a fault of one is not the end of the others.
    """

    path: Path
    format: str
    is_recording: bool
    read: Callable[[Path, Tell], Iterator[Part]]

    def parts(self, tell: Tell) -> Iterator[Part]:
        """What each part of the dataset holds.

        Args:
            tell: is called with each fault.
        """
        return self.read(self.path, tell)


def foreign_dataset(path: Path) -> ForeignDataset | None:
    """The dataset in a folder, without looking below it; None for none that is known."""
    if not path.is_dir() or (path / MANIFEST).is_file():
        return None
    if any((folder / "sample_annotation.json").is_file() for folder in path.glob("v1.0-*")):
        return ForeignDataset(path, "nuScenes tables", False, _nuscenes)
    if any(_is_openlabel(file) for file in path.glob("*.json")):
        return ForeignDataset(path, "OpenLABEL documents", False, _openlabel)
    if _is_labelcloud(path):
        return ForeignDataset(path, "labelCloud labels", True, _labelcloud)
    if is_coco_dataset(path):
        return ForeignDataset(path, "COCO boxes", True, _coco)
    if _is_yolo(path):
        return ForeignDataset(path, "YOLO boxes", True, _yolo)
    return None


def _is_openlabel(file: Path) -> bool:
    with suppress(OSError), file.open("rb") as stream:
        return b'"openlabel"' in stream.read(SNIFFED_BYTES)
    return False


def _is_labelcloud(path: Path) -> bool:
    """A project folder (or a part of one): JSON beside clouds, or with the classes that labelCloud keeps there."""
    labels = path / LABELS
    if not ((path / CLOUDS).is_dir() or (labels / CLASSES_FILE).is_file()):
        return False
    return any(file.name != CLASSES_FILE for file in labels.glob("*.json"))


def _is_yolo(path: Path) -> bool:
    """Ultralytics' `data.yaml`, or `classes.txt` with labels: in `labels`, or beside pictures of the same name."""
    if (path / DATA_YAML).is_file():
        with suppress(OSError):
            return b"names:" in (path / DATA_YAML).read_bytes()
    if not (path / CLASSES).is_file():
        return False
    if any(file.name != CLASSES for file in (path / "labels").glob("*.txt")):
        return True
    pictures = {file.stem for file in path.iterdir() if file.suffix.lower() in SUFFIXES}
    return any(file.stem in pictures for file in path.glob("*.txt"))


def _nuscenes(path: Path, tell: Tell) -> Iterator[Part]:
    yield from _part(lambda: [len(boxes) for boxes in read_nuscenes(path, tell).values()], tell)


def _openlabel(path: Path, tell: Tell) -> Iterator[Part]:
    """Each document; other JSON may lie beside them, and is one that was cut where it is none."""
    for file in sorted(path.glob("*.json")):
        if _is_openlabel(file):
            yield from _part(lambda file=file: [len(frame.boxes) for frame in read_openlabel(file).values()], tell)  # type: ignore[misc]
            continue
        try:
            read_json(file)
        except FormatError as fault:
            tell(fault)


def _labelcloud(path: Path, tell: Tell) -> Iterator[Part]:
    yield from _part(lambda: [len(frame.boxes) for frame in read_labelcloud(path, tell).values()], tell)


def _coco(path: Path, tell: Tell) -> Iterator[Part]:
    yield from _part(
        lambda: [len(image.boxes) for _, images in read_coco_dataset(path, tell) for image in images], tell
    )


def _yolo(path: Path, tell: Tell) -> Iterator[Part]:
    yield from _part(lambda: [len(picture.boxes) for picture in read_yolo(path, tell)], tell)


def _part(boxes_of_frames: Callable[[], list[int]], tell: Tell) -> Iterator[Part]:
    try:
        counts = boxes_of_frames()
    except FormatError as fault:
        tell(fault)
    else:
        yield len(counts), sum(counts)
