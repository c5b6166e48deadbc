"""The one thing that Recursive Cross-View needs of a 2D detector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from annotator.types.boxes import Box2D


@runtime_checkable
class Image(Protocol):
    """Anything with a picture: a `Frame` or a `PseudoView`."""

    @property
    def rgb(self) -> np.ndarray:
        """(H, W, 3) uint8, RGB order."""


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
