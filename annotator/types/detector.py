"""The interface of 2D detectors that Recursive Cross-View uses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np

from annotator.types.boxes import Box2D


@runtime_checkable
class Image(Protocol):
    """Anything with an RGB image, such as a `Frame` or a `PseudoView`."""

    @property
    def rgb(self) -> np.ndarray:
        """(H, W, 3) uint8, RGB order."""


@dataclass(frozen=True, eq=False)
class Region:
    """A rectangular part of an image, which a detector processes at the same scale as the whole image.

    Attributes:
        of: the whole image.
        x_px, y_px: first column and row within the whole image.
        width_px, height_px: size; the region lies completely within the image.
    """

    of: Image
    x_px: int
    y_px: int
    width_px: int
    height_px: int

    @property
    def rgb(self) -> np.ndarray:
        """(height, width, 3) uint8; shares memory with the whole image."""
        return self.of.rgb[self.y_px : self.y_px + self.height_px, self.x_px : self.x_px + self.width_px]

    @property
    def share(self) -> float:
        """The region's longer side as a share of the image's longer side."""
        return max(self.width_px, self.height_px) / max(self.of.rgb.shape[:2])


class DetectorKind(StrEnum):
    """The two detectors of a project: one for camera images, one for pseudo-views."""

    IMAGE = "image"
    VIEW = "view"


@runtime_checkable
class Detector(Protocol):
    """A 2D detector that processes many images per call."""

    @property
    def labels(self) -> tuple[str, ...]:
        """The class names that it can detect."""

    @property
    def fingerprint(self) -> str:
        """A hash of everything that affects the results, such as weights and settings."""

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One list of boxes per image, in the order given; best score first, in pixels of that image."""
