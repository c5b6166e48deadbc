"""2D boxes as shares of the image size, as in YOLO's label files, and boxes clipped to the image.

The shares are centre x and y, width and height, divided by the image's width and height (Ultralytics' documentation,
"object detection datasets"). They are measured from the image's corner, whereas pixels are measured from the centre of
the first pixel: the two differ by half a pixel.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from annotator.types import Box2D


def clip_to_image(box: Box2D, width_px: int, height_px: int, min_side_px: float = 0.0) -> Box2D | None:
    """The box clipped to the image; None if it is outside, or if a side is shorter than `min_side_px`."""
    x_min, x_max = (min(max(x, -0.5), width_px - 0.5) for x in (box.x_min, box.x_max))
    y_min, y_max = (min(max(y, -0.5), height_px - 0.5) for y in (box.y_min, box.y_max))
    if x_max <= x_min or y_max <= y_min or min(x_max - x_min, y_max - y_min) < min_side_px:
        return None
    return Box2D(box.label, x_min, y_min, x_max, y_max, box.score)


def shares_of(box: Box2D, width_px: int, height_px: int) -> Float64[np.ndarray, "4"]:
    """Centre x, centre y, width and height as shares of the image size."""
    low, high = np.array([box.x_min, box.y_min]) + 0.5, np.array([box.x_max, box.y_max]) + 0.5
    size = np.array([width_px, height_px])
    return np.concatenate([(low + high) / 2 / size, (high - low) / size])


def edges_of(shares: Float[np.ndarray, "4"], width_px: int, height_px: int) -> Float64[np.ndarray, "4"]:
    """The inverse of `shares_of`: x_min, y_min, x_max, y_max, pixels."""
    centre, half, size = shares[:2], shares[2:] / 2, np.array([width_px, height_px], np.float64)
    return np.concatenate([(centre - half) * size, (centre + half) * size]) - 0.5
