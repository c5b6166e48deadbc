"""Labelled pictures of a COCO or YOLO file or dataset, as one thing to import."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath

from annotator.files import is_within
from annotator.formats.coco_dataset import dataset_folder, read_coco_dataset
from annotator.formats.frames_csv import FrameOrigin, read_frames
from annotator.formats.yolo_read import YoloPicture, read_yolo
from annotator.types import Box2D
from annotator.types.errors import FormatError

# Of a name that is none.
SHOWN = 60


class FlatFormat(StrEnum):
    """Formats of 2D boxes."""

    COCO = "coco"
    YOLO = "yolo"


@dataclass(frozen=True, eq=False)
class PictureLabels:
    """The boxes of one picture.

    Attributes:
        file_name: of the picture, as its dataset has it.
        folder: that `file_name` is in.
        labels: class of each box.
        size_px: width and height as the dataset says them; None where boxes are shares of whatever size it has.
        boxes_on: its boxes on a picture of this width and height, pixels.
    """

    file_name: str
    folder: Path
    labels: tuple[str, ...]
    size_px: tuple[int, int] | None
    boxes_on: Callable[[int, int], tuple[Box2D, ...]]

    @property
    def stem(self) -> str:
        """The file's name without folder and suffix."""
        return PurePosixPath(self.file_name).stem

    def file(self, path: Path) -> Path | None:
        """The picture's file, if it is there.

        Args:
            path: where the name comes from, for the message.

        Raises:
            FormatError: the name leads out of its folder, or is none.
        """
        file = self.folder / self.file_name
        if not is_within(self.folder, self.file_name):
            raise FormatError(
                path,
                f"{self.file_name[:SHOWN]!r} leads out of the folder of pictures, or is no name; use names within it",
            )
        return file if file.is_file() else None


@dataclass(frozen=True, eq=False)
class PictureSet:
    """All labelled pictures of a file or dataset, read and checked.

    Attributes:
        path: what was read.
        pictures: in its order.
        origins: by stem, the frame that a camera image is of, where the dataset says so (`frames.csv`).
    """

    path: Path
    pictures: tuple[PictureLabels, ...]
    origins: dict[str, FrameOrigin]


def read_pictures(format: FlatFormat, path: Path, folder: Path | None = None) -> PictureSet:
    """The labelled pictures at `path`.

    Args:
        path: an annotation file, or the folder of a dataset.
        folder: of the pictures, where it is not the one that the dataset has.

    Raises:
        FormatError: it does not follow the format.
    """
    if format is FlatFormat.COCO:
        root = dataset_folder(path)
        pictures = [
            PictureLabels(
                image.file_name,
                folder or beside,
                tuple(box.label for box in image.boxes),
                (image.width_px, image.height_px),
                lambda _w, _h, boxes=image.boxes: boxes,  # type: ignore[misc]
            )
            for beside, images in read_coco_dataset(path)
            for image in images
        ]
    else:
        root = path if path.is_dir() else path.parent
        pictures = [_of_yolo(picture, folder) for picture in read_yolo(path)]
    return PictureSet(path, tuple(pictures), read_frames(root))


def _of_yolo(picture: YoloPicture, folder: Path | None) -> PictureLabels:
    name = picture.file_name
    if folder is not None and picture.picture is None:
        # only its labels are there: the picture that they belong to is a pseudo-view, which is kept as PNG
        name = f"{PurePosixPath(name).stem}.png"
    return PictureLabels(
        name,
        folder or picture.folder,
        tuple(box.label for box in picture.boxes),
        None,
        lambda width_px, height_px: tuple(box.on(width_px, height_px) for box in picture.boxes),
    )
