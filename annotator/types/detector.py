"""The interface of 2D detectors that Recursive Cross-View uses, and the pseudo-views that they see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from annotator.types.boxes import Box2D
from annotator.types.checks import as_array


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


@dataclass(frozen=True, eq=False)
class Picture:
    """An `Image` of nothing but its pixels."""

    rgb: np.ndarray


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


@dataclass(frozen=True, eq=False)
class PseudoView:
    """An orthographic RGB image of points, and the conversion from its pixels to metres.

    The view's axes are x right, y down, z into the image. Its origin is that of the camera frame, so the two differ by
    a rotation only, and a view pixel (u, v) stands for the view coordinates
    `x = origin_m[0] + u * metres_per_px`, `y = origin_m[1] + v * metres_per_px`.

    Attributes:
        rgb: (H, W, 3) uint8 image.
        axes: (3, 3) rows = the view's x, y, z axes as unit vectors in the camera frame (= R_view_camera).
        metres_per_px: one uniform scale.
        origin_m: (2,) view coordinates, metres, of the centre of pixel (0, 0).
        xyz_m: (N, 3) the points in the view, in the camera frame; a dense cloud is thinned for drawing.
        look_px: a detector scales the longer side of the image to at least this, pixels; used for views in which
            objects are small. 0 means the detector's own size.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    axes: Float64[np.ndarray, "3 3"]
    metres_per_px: float
    origin_m: Float64[np.ndarray, "2"]
    xyz_m: Float32[np.ndarray, "n 3"]
    look_px: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "rgb", as_array("rgb", self.rgb, np.uint8, (None, None, 3)))
        object.__setattr__(self, "axes", as_array("axes", self.axes, np.float64, (3, 3)))
        object.__setattr__(self, "origin_m", as_array("origin_m", self.origin_m, np.float64, (2,)))
        object.__setattr__(self, "xyz_m", as_array("xyz_m", self.xyz_m, np.float32, (None, 3)))
        if not self.metres_per_px > 0:
            raise ValueError(f"metres_per_px must be positive, not {self.metres_per_px}")

    @property
    def extent_m(self) -> Float64[np.ndarray, "2"]:
        """Width and height of the shown area, metres."""
        height_px, width_px = self.rgb.shape[:2]
        return np.array([width_px, height_px]) * self.metres_per_px

    def interval_m(self, box: Box2D) -> Float64[np.ndarray, "2 2"]:
        """The view coordinates, metres, that a box spans: rows x and y, columns low and high."""
        low = self.origin_m + np.array([box.x_min, box.y_min]) * self.metres_per_px
        high = self.origin_m + np.array([box.x_max, box.y_max]) * self.metres_per_px
        return np.stack([low, high], axis=1)

    def box_px(self, interval_m: np.ndarray, label: str) -> Box2D:
        """The 2D box that spans view coordinates (2, 2), as returned by `interval_m`; not clipped to the image."""
        spans = (np.asarray(interval_m, np.float64) - self.origin_m[:, None]) / self.metres_per_px
        return Box2D(label, spans[0, 0], spans[1, 0], spans[0, 1], spans[1, 1])
