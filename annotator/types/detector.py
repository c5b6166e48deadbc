"""The one thing that Recursive Cross-View needs of a 2D detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from annotator.types.boxes import Box2D


@runtime_checkable
class Image(Protocol):
    """Anything with a picture: a `Frame` or a `PseudoView`."""

    @property
    def rgb(self) -> np.ndarray:
        """(H, W, 3) uint8, RGB order."""


@dataclass(frozen=True, eq=False)
class Region:
    """A part of an image, for a detector to look at as if the rest were there: no larger and no smaller.

    Attributes:
        of: the whole image.
        x_px, y_px: its first column and row there.
        width_px, height_px: its size; all of it lies within the image.
    """

    of: Image
    x_px: int
    y_px: int
    width_px: int
    height_px: int

    @property
    def rgb(self) -> np.ndarray:
        """(height, width, 3) uint8, a view of the image's."""
        return self.of.rgb[self.y_px : self.y_px + self.height_px, self.x_px : self.x_px + self.width_px]

    @property
    def share(self) -> float:
        """Its longer side as a share of the image's."""
        return max(self.width_px, self.height_px) / max(self.of.rgb.shape[:2])


@runtime_checkable
class Detector(Protocol):
    """A 2D detector: images in, boxes out, many images a call."""

    @property
    def labels(self) -> tuple[str, ...]:
        """The class names it can find."""

    @property
    def fingerprint(self) -> str:
        """Changes whenever the answers may: a hash of the weights and settings."""

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One list of boxes an image, in the order given, best score first, in that image's pixels."""
