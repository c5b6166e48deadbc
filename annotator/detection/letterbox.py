"""Pictures of any size into one batch for a network, and boxes back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float64, Int64, UInt8

# The border's grey; networks are trained with it, and pseudo-views have it as background.
GREY = 114
# Below, the border around a narrow picture costs less than it does to have canvases of several sizes side by side.
SQUARE_UP_TO_PX = 128


@dataclass(frozen=True)
class Placement:
    """How a picture is scaled and framed before it goes into a network, all in pixels.

    Attributes:
        width_px, height_px: its own size.
        scaled_width_px, scaled_height_px: its size in the batch.
        canvas: (width, height) with the border around it.
    """

    width_px: int
    height_px: int
    scaled_width_px: int
    scaled_height_px: int
    canvas: tuple[int, int]

    @property
    def corner(self) -> tuple[int, int]:
        """Left and top border; an odd pixel goes to the right or bottom."""
        return (self.canvas[0] - self.scaled_width_px) // 2, (self.canvas[1] - self.scaled_height_px) // 2


def place(size: tuple[int, int], longer_side_px: int, stride: int) -> Placement:
    """A picture of (height, width) with its longer side scaled to the given length, on the smallest canvas around it
    whose sides are multiples of `stride`; small ones on a square, so that all of a call can be computed alike."""
    height_px, width_px = size
    scale = longer_side_px / max(height_px, width_px)
    scaled_width_px, scaled_height_px = max(round(width_px * scale), 1), max(round(height_px * scale), 1)
    canvas = (-(-scaled_width_px // stride) * stride, -(-scaled_height_px // stride) * stride)
    if longer_side_px <= SQUARE_UP_TO_PX:
        canvas = (max(canvas), max(canvas))
    return Placement(width_px, height_px, scaled_width_px, scaled_height_px, canvas)


def fill_batch(pictures: Sequence[np.ndarray], placements: Sequence[Placement]) -> UInt8[np.ndarray, "n h w 3"]:
    """Pictures that share a canvas, each in the middle of it.

    Args:
        pictures: each (height, width, 3) uint8, of its own size.
        placements: of each picture.
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
    """Boxes on canvases as boxes in their pictures, clipped to them.

    Resizing keeps a picture's edges in place, so pixels are counted from its corner in between; in the result they
    count from the centre of the first one, half a pixel further in.

    Args:
        boxes: x_min y_min x_max y_max, pixels from the canvas's corner.
        picture: for each box, the number of its picture.
        placements: of each picture.
    """
    border = np.array([p.corner * 2 for p in placements], np.float64)[picture]
    size = np.array([(p.width_px, p.height_px) * 2 for p in placements], np.float64)[picture]
    scaled = np.array([(p.scaled_width_px, p.scaled_height_px) * 2 for p in placements], np.float64)[picture]
    return np.clip((boxes - border) * (size / scaled), 0, size) - 0.5
