"""Combines images of any size into batches for a network, and maps boxes back to the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float64, Int64, UInt8

# Grey of the border. Networks are trained with it, and pseudo-views have it as background.
GREY = 114
# Canvases up to this size are square: wider borders take less time than several canvas sizes.
SQUARE_UP_TO_PX = 128


@dataclass(frozen=True)
class Placement:
    """How an image is scaled and padded for a network, all in pixels.

    Attributes:
        width_px, height_px: size of the image.
        scaled_width_px, scaled_height_px: its size in the batch.
        canvas: (width, height) including the border.
    """

    width_px: int
    height_px: int
    scaled_width_px: int
    scaled_height_px: int
    canvas: tuple[int, int]

    @property
    def corner(self) -> tuple[int, int]:
        """Left and top border; an odd pixel is added on the right or at the bottom."""
        return (self.canvas[0] - self.scaled_width_px) // 2, (self.canvas[1] - self.scaled_height_px) // 2

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of the image per pixel of the batch, in x and y."""
        return self.width_px / self.scaled_width_px, self.height_px / self.scaled_height_px


def place(size: tuple[int, int], longer_side_px: int, stride: int) -> Placement:
    """Scales the longer side of a (height, width) image to `longer_side_px` and pads it to multiples of `stride`.

    Small images get square canvases, so that all images of a call share one size.
    """
    height_px, width_px = size
    scale = longer_side_px / max(height_px, width_px)
    scaled_width_px, scaled_height_px = max(round(width_px * scale), 1), max(round(height_px * scale), 1)
    canvas = (-(-scaled_width_px // stride) * stride, -(-scaled_height_px // stride) * stride)
    if longer_side_px <= SQUARE_UP_TO_PX:
        canvas = (max(canvas), max(canvas))
    return Placement(width_px, height_px, scaled_width_px, scaled_height_px, canvas)


def fill_batch(pictures: Sequence[np.ndarray], placements: Sequence[Placement]) -> UInt8[np.ndarray, "n h w 3"]:
    """A batch of images that share a canvas size, each centred on its canvas.

    Args:
        pictures: images of any sizes, each (height, width, 3) uint8.
        placements: one per image.
    """
    width_px, height_px = placements[0].canvas
    batch = np.full((len(pictures), height_px, width_px, 3), GREY, np.uint8)
    for target, picture, placement in zip(batch, pictures, placements, strict=True):
        size = (placement.scaled_width_px, placement.scaled_height_px)
        left, top = placement.corner
        if picture.shape[1::-1] != size:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR)
        target[top : top + size[1], left : left + size[0]] = picture
    return batch


def to_pictures(
    boxes: Float[np.ndarray, "k 4"],
    picture: Int64[np.ndarray, "k"],
    placements: Sequence[Placement],
) -> Float64[np.ndarray, "k 4"]:
    """Maps boxes from canvases to their images, and clips them to the images.

    Resizing preserves image corners, so the mapping measures from the corner of the first pixel. The result is
    measured from its centre, half a pixel further in.

    Args:
        boxes: x_min y_min x_max y_max, pixels from the corner of the canvas.
        picture: index of each box's image.
        placements: one per image.
    """
    border = np.array([p.corner * 2 for p in placements], np.float64)[picture]
    size = np.array([(p.width_px, p.height_px) * 2 for p in placements], np.float64)[picture]
    scale = np.array([p.scale * 2 for p in placements], np.float64)[picture]
    return np.clip((boxes - border) * scale, 0, size) - 0.5
