"""A COCO detection dataset as a folder: one image folder and one annotation file for each part.

    annotations/instances_PART.json
    PART/FILE

This is COCO's own layout (`annotations/instances_train2017.json`, `train2017/000000000009.jpg`). A dataset without
parts has the single part `all`. Pixels as in `coco.py`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from annotator.formats.coco import CocoImage, read_coco, write_coco
from annotator.formats.dataset_writing import LabelledPicture
from annotator.formats.reading import OnFault, raise_fault
from annotator.types.errors import FormatError

ANNOTATIONS = "annotations"
WHOLE = "all"
_FILE = re.compile(r"instances_(.+)\.json")


class CocoWriter:
    """Fills a folder with a dataset.

    Raises:
        FormatError: a part is called `annotations`.
    """

    def __init__(self, folder: Path, classes: Sequence[str], parts: Sequence[str] = ()) -> None:
        """
        Args:
            folder: an existing, empty folder.
            classes: the categories; ids count from 1 in this order.
            parts: names of all parts, including empty ones; () for a dataset without parts.
        """
        if ANNOTATIONS in parts:
            raise FormatError(
                folder,
                f"a part cannot be called {ANNOTATIONS}: COCO stores the boxes in a folder of this name",
            )
        self._folder, self._classes = folder, classes
        self._images: dict[str, list[CocoImage]] = {part: [] for part in parts or (WHOLE,)}
        for part in self._images:
            (folder / part).mkdir()

    def add(self, picture: LabelledPicture) -> None:
        part = picture.part or WHOLE
        (self._folder / part / picture.file_name).write_bytes(picture.content)
        size = (picture.width_px, picture.height_px)
        self._images[part].append(
            CocoImage(picture.file_name, *size, picture.boxes, picture.box_kind, picture.values, picture.attributes)
        )

    def finish(self) -> Mapping[str, Path]:
        (self._folder / ANNOTATIONS).mkdir()
        for part, images in self._images.items():
            write_coco(self._folder / ANNOTATIONS / f"instances_{part}.json", images, self._classes)
        return {part: self._folder / part for part in self._images}


def coco_files(path: Path) -> list[tuple[Path, Path]]:
    """Returns each annotation file with the folder of its images.

    Args:
        path: the folder of a dataset, or one annotation file. Images of a file in `annotations` are in the folder
            named after its part; images of any other file are beside it.

    Raises:
        FormatError: the folder has no `annotations/instances_*.json`.
    """
    if path.is_dir():
        files = sorted(file for file in (path / ANNOTATIONS).glob("*.json") if _FILE.fullmatch(file.name))
        if not files:
            raise FormatError(path, f"has no {ANNOTATIONS}/instances_*.json; pass the path of the COCO file instead")
    else:
        files = [path]
    return [(file, _pictures(file)) for file in files]


def _pictures(file: Path) -> Path:
    match = _FILE.fullmatch(file.name)
    if match is None or file.parent.name != ANNOTATIONS:
        return file.parent
    folder = file.parent.parent / match[1]
    return folder if folder.is_dir() else file.parent.parent


def dataset_folder(path: Path) -> Path:
    """Returns the dataset folder of a path that `coco_files` accepts."""
    if path.is_dir():
        return path
    return path.parent.parent if path.parent.name == ANNOTATIONS else path.parent


def is_coco_dataset(folder: Path) -> bool:
    """True for a folder with COCO annotations in `CocoWriter`'s layout."""
    return any(_FILE.fullmatch(file.name) for file in (folder / ANNOTATIONS).glob("*.json"))


def read_coco_dataset(path: Path, on_fault: OnFault = raise_fault) -> list[tuple[Path, list[CocoImage]]]:
    """Returns the image folder and the images of each annotation file.

    Args:
        on_fault: called with the fault of an annotation; see `OnFault`.

    Raises:
        FormatError: as `coco_files` and `read_coco`.
    """
    return [(pictures, read_coco(file, on_fault)) for file, pictures in coco_files(path)]
