"""What writers of 2D detection datasets are given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from annotator.types import Box2D


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """One picture with the boxes of everything that it shows.

    Attributes:
        file_name: unique in the dataset, without a folder.
        content: the bytes of the image file.
        width_px, height_px: of the picture.
        boxes: within the picture; none = it shows nothing.
        part: of the dataset, such as "train"; None where it is not divided.
    """

    file_name: str
    content: bytes
    width_px: int
    height_px: int
    boxes: tuple[Box2D, ...]
    part: str | None = None


class PictureWriter(Protocol):
    """Fills a folder with a dataset, picture by picture."""

    def add(self, picture: LabelledPicture) -> None:
        """Writes one picture; what the disk says is raised as OSError."""

    def finish(self) -> Mapping[str, Path]:
        """Writes what holds the dataset together; the folder of each part's pictures, by part."""
