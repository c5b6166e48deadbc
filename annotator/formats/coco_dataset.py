"""A COCO detection dataset as a folder: each part's pictures in a folder of its name, its boxes in one file.

    annotations/instances_PART.json
    PART/FILE

as COCO itself is laid out (`annotations/instances_train2017.json`, `train2017/000000000009.jpg`); a dataset that is not
divided has the one part `all`. Pixels as in `coco.py`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from annotator.formats.coco import CocoImage, read_coco, write_coco
from annotator.formats.faults import Tell, give_up
from annotator.formats.labelled_picture import LabelledPicture
from annotator.types.errors import FormatError

ANNOTATIONS = "annotations"
WHOLE = "all"
_FILE = re.compile(r"instances_(.+)\.json")


class CocoWriter:
    """Fills a folder with a dataset.

    Raises:
        FormatError: a part has the name of the folder of annotations.
    """

    def __init__(self, folder: Path, classes: Sequence[str], parts: Sequence[str] = ()) -> None:
        """
        Args:
            folder: exists and is empty.
            classes: the categories; ids count from 1 in this order.
            parts: names of all parts, also of those that stay empty; none = the dataset is not divided.
        """
        if ANNOTATIONS in parts:
            raise FormatError(folder, f"a part cannot be called {ANNOTATIONS}, as COCO's folder of boxes is")
        self._folder, self._classes = folder, classes
        self._images: dict[str, list[CocoImage]] = {part: [] for part in parts or (WHOLE,)}
        for part in self._images:
            (folder / part).mkdir()

    def add(self, picture: LabelledPicture) -> None:
        part = picture.part or WHOLE
        (self._folder / part / picture.file_name).write_bytes(picture.content)
        size = (picture.width_px, picture.height_px)
        self._images[part].append(CocoImage(picture.file_name, *size, picture.boxes))

    def finish(self) -> Mapping[str, Path]:
        (self._folder / ANNOTATIONS).mkdir()
        for part, images in self._images.items():
            write_coco(self._folder / ANNOTATIONS / f"instances_{part}.json", images, self._classes)
        return {part: self._folder / part for part in self._images}


def coco_files(path: Path) -> list[tuple[Path, Path]]:
    """Each annotation file with the folder of its pictures.

    Args:
        path: the folder of a dataset, or one annotation file: its pictures are in the folder of the part's name if it
            lies in `annotations`, else beside it.

    Raises:
        FormatError: there is no such file, or the folder has no `annotations/instances_*.json`.
    """
    if path.is_dir():
        files = sorted(file for file in (path / ANNOTATIONS).glob("*.json") if _FILE.fullmatch(file.name))
        if not files:
            raise FormatError(path, f"has no {ANNOTATIONS}/instances_*.json; name the COCO file itself")
    else:
        files = [path]
    return [(file, _pictures(file)) for file in files]


def _pictures(file: Path) -> Path:
    named = _FILE.fullmatch(file.name)
    if named is None or file.parent.name != ANNOTATIONS:
        return file.parent
    folder = file.parent.parent / named[1]
    return folder if folder.is_dir() else file.parent.parent


def dataset_folder(path: Path) -> Path:
    """The folder of the dataset that a path of `coco_files` belongs to."""
    if path.is_dir():
        return path
    return path.parent.parent if path.parent.name == ANNOTATIONS else path.parent


def is_coco_dataset(folder: Path) -> bool:
    """True for a folder with COCO annotations, as `CocoWriter` lays them out."""
    return any(_FILE.fullmatch(file.name) for file in (folder / ANNOTATIONS).glob("*.json"))


def read_coco_dataset(path: Path, tell: Tell = give_up) -> list[tuple[Path, list[CocoImage]]]:
    """The images of each annotation file with the folder of their pictures.

    Args:
        tell: what becomes of an annotation's fault.

    Raises:
        FormatError: as `coco_files` and `read_coco`.
    """
    return [(pictures, read_coco(file, tell)) for file, pictures in coco_files(path)]
