"""Shared by the dataset writers: items to write, unique file names, encoded images, and disk errors.

3D formats take `DatasetItem`s, 2D formats `LabelledPicture`s.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from jaxtyping import UInt8

from annotator.formats.attributes import Values
from annotator.types import Box2D, BoxKind, Frame, Label
from annotator.types.errors import FormatError

# Bytes of UTF-8. File systems take 255, which must do for a number, a suffix and the name of a temporary file, too.
LONGEST_STEM = 180


@dataclass(frozen=True, eq=False)
class DatasetItem:
    """One frame to export.

    Attributes:
        recording: name of the frame's recording.
        frame: image, cloud and camera.
        labels: the labels to export; boxes in the camera frame.
        split: the frame's part of the dataset, such as "train"; None for a dataset without parts.
        attributes: values of the frame's attributes.
    """

    recording: str
    frame: Frame
    labels: Sequence[Label]
    split: str | None = None
    attributes: Values = field(default_factory=dict)


@dataclass
class FileNames:
    """File names that are valid on every system, and unique even where case is ignored."""

    _taken: set[str] = field(default_factory=set)

    def add(self, *parts: str) -> str:
        """Adds a name: the parts joined by "-", shortened if it is too long, with a number if that name is taken."""
        stem = "-".join(re.sub(r"[^\w.]+", "_", part) for part in parts).lstrip(".") or "_"
        if len(stem.encode()) > LONGEST_STEM:
            # its end, which tells the frames of a recording apart
            stem = stem.encode()[-LONGEST_STEM:].decode(errors="ignore").lstrip(".") or "_"
        candidate, number = stem, 1
        while candidate.casefold() in self._taken:
            number += 1
            candidate = f"{stem}-{number}"
        self._taken.add(candidate.casefold())
        return candidate


@dataclass
class FrameIds:
    """Unique frame ids that are valid file names: `recording-key`, in the order of the frames."""

    ids: dict[tuple[str, str], str] = field(default_factory=dict)
    _names: FileNames = field(default_factory=FileNames)

    def add(self, out: Path, item: DatasetItem) -> str:
        """Adds a frame and returns its id.

        Args:
            out: the dataset, for the error message.

        Raises:
            FormatError: the frame was added before.
        """
        origin = (item.recording, item.frame.key)
        if origin in self.ids:
            raise FormatError(out, f"{item.recording}, frame {item.frame.key}: the frame is exported twice")
        self.ids[origin] = self._names.add(*origin)
        return self.ids[origin]


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """One image with the boxes of all objects in it.

    Attributes:
        file_name: unique in the dataset, without a folder.
        content: the bytes of the image file.
        width_px, height_px: image size.
        boxes: within the image; () if it has no objects.
        part: part of the dataset, such as "train"; None for a dataset without parts.
        box_kind: what the boxes enclose.
        values: attributes of each box; () if none has any.
        attributes: of the frame.
    """

    file_name: str
    content: bytes
    width_px: int
    height_px: int
    boxes: tuple[Box2D, ...]
    part: str | None = None
    box_kind: BoxKind = BoxKind.SILHOUETTE
    values: tuple[Values, ...] = ()
    attributes: Values = field(default_factory=dict)


class PictureWriter(Protocol):
    """Fills a folder with a dataset, image by image."""

    def add(self, picture: LabelledPicture) -> None:
        """Writes one image.

        Raises:
            OSError: it cannot be written.
        """

    def finish(self) -> Mapping[str, Path]:
        """Writes the files that describe the dataset; returns the image folder of each part."""


JPEG_QUALITY = 95


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turns an OSError into a FormatError that names the dataset.

    Raises:
        FormatError: a file could not be written.
    """
    try:
        yield
    except OSError as error:
        raise FormatError(out, f"cannot be written ({error.strerror}); the incomplete dataset was removed") from error


def encoded_image(
    rgb: UInt8[np.ndarray, "h w 3"], image_format: Literal["png", "jpg"], jpeg_quality: int = JPEG_QUALITY
) -> bytes:
    """Returns an RGB image as the bytes of an image file.

    Raises:
        OSError: the image is too large for the format.
    """
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if image_format == "jpg" else []
    done, data = cv2.imencode(f".{image_format}", np.ascontiguousarray(rgb[..., ::-1]), settings)
    if not done:
        height_px, width_px = rgb.shape[:2]
        raise OSError(0, f"an image of {width_px} x {height_px} pixels is too large for {image_format}")
    return bytes(data.tobytes())
