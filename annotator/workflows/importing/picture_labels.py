"""Reads the labelled images of a COCO or YOLO file or dataset into a common form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from annotator.formats.attributes import Values
from annotator.formats.coco import dataset_folder, read_coco_dataset
from annotator.formats.frame_names import FrameOrigin, read_frames
from annotator.formats.yolo import YoloPicture, read_yolo
from annotator.text import OutsideError, inside, is_absolute, normal, stem_of
from annotator.types import Box2D, BoxKind
from annotator.types.errors import FormatError


class FlatFormat(StrEnum):
    """Formats of 2D boxes."""

    COCO = "coco"
    YOLO = "yolo"


@dataclass(frozen=True, eq=False)
class PictureLabels:
    """The boxes of one image.

    Attributes:
        file_name: the image's name in the dataset.
        folder: the folder of `file_name`.
        labels: class of each box.
        size_px: width and height from the dataset; None if boxes are fractions of the image size.
        box_kind: what the boxes enclose, if the dataset says so.
        boxes_on: returns the boxes on an image of the given width and height, pixels.
        values: attributes of each box; () if none has any.
        attributes: of the image.
        around: number of boxes that are the rectangles around turned boxes or polygons.
    """

    file_name: str
    folder: Path
    labels: tuple[str, ...]
    size_px: tuple[int, int] | None
    boxes_on: Callable[[int, int], tuple[Box2D, ...]]
    box_kind: BoxKind | None = None
    values: tuple[Values, ...] = ()
    attributes: Values = field(default_factory=dict)
    around: int = 0

    @property
    def stem(self) -> str:
        """The file's `normal` name without folder and suffix."""
        return normal(stem_of(self.file_name))

    def file(self, path: Path) -> Path | None:
        """Returns the image file; None if it does not exist, such as one that was on another computer.

        Args:
            path: the dataset, for the message.

        Raises:
            FormatError: the name is invalid or leads out of its folder.
        """
        try:
            file = inside(self.folder, self.file_name)
        except OutsideError as error:
            if is_absolute(self.file_name):
                return None
            raise FormatError(path, str(error)) from error
        # labels without an image have the name of their label file, which may be in this folder
        return file if file.is_file() and file.suffix.lower() != ".txt" else None


@dataclass(frozen=True, eq=False)
class PictureSet:
    """All labelled images of a file or dataset, read and checked.

    Attributes:
        path: the file or folder that was read.
        pictures: the images in its order.
        origins: the frames of camera images from `frames.csv`, by stem.
    """

    path: Path
    pictures: tuple[PictureLabels, ...]
    origins: dict[str, FrameOrigin]


def read_pictures(format: FlatFormat, path: Path, folder: Path | None = None) -> PictureSet:
    """Reads the labelled images at `path`.

    Args:
        path: an annotation file, or the folder of a dataset.
        folder: the image folder; None = the dataset's own.

    Raises:
        FormatError: the dataset does not follow the format.
    """
    if format is FlatFormat.COCO:
        root = dataset_folder(path)
        pictures = [
            PictureLabels(
                image.file_name,
                folder or image_folder,
                tuple(box.label for box in image.boxes),
                (image.width_px, image.height_px),
                lambda _w, _h, boxes=image.boxes: boxes,  # type: ignore[misc]
                image.box_kind,
                image.values,
                image.attributes,
                image.around,
            )
            for image_folder, images in read_coco_dataset(path)
            for image in images
        ]
    else:
        root = path if path.is_dir() else path.parent
        pictures = [_of_yolo(picture, folder) for picture in read_yolo(path)]
    return PictureSet(path, tuple(pictures), read_frames(root))


def _of_yolo(picture: YoloPicture, folder: Path | None) -> PictureLabels:
    name = picture.file_name
    if folder is not None and picture.picture is None:
        # labels without an image belong to a pseudo-view, which is a PNG file
        name = f"{stem_of(name)}.png"
    return PictureLabels(
        name,
        folder or picture.folder,
        tuple(box.label for box in picture.boxes),
        None,
        lambda width_px, height_px: tuple(box.on(width_px, height_px) for box in picture.boxes),
        picture.box_kind,
        around=sum(box.is_around for box in picture.boxes),
    )
