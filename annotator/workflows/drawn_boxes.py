"""Boxes drawn on images: for scripts, on the live page, and on the validation images of a detector."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from annotator.geometry.outline import heading_px, visible_edges
from annotator.types import Box2D, Camera, OrientedBox

Colour = tuple[int, int, int]
FONT, FONT_SIZE, PLATE = cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20, 20, 20)
# Length of the head of a heading's arrow, in thicknesses of its lines.
HEAD = 5.0
# Number of fractional bits of pixel coordinates for cv2.
SHIFT = 4


class Canvas:
    """A scaled copy of an image to draw on; boxes are in the pixels of the image.

    Attributes:
        rgb: the copy, RGB order, as colours are.
    """

    def __init__(self, rgb: UInt8[np.ndarray, "h w 3"], scale: float = 1.0) -> None:
        height, width = (round(side * scale) for side in rgb.shape[:2])
        # enlarged images, too, are those of smooth things
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        self.rgb = (
            np.ascontiguousarray(rgb).copy() if scale == 1 else cv2.resize(rgb, (width, height), interpolation=way)
        )
        self._scale = scale

    def box(self, box: Box2D, colour: Colour, text: str = "", thickness_px: int = 1) -> None:
        """Draws a 2D box with a line of text above its upper left corner, or below it at the image's upper border."""
        first, last = self._points(np.array(box.xyxy).reshape(2, 2)).tolist()
        cv2.rectangle(self.rgb, first, last, colour, thickness_px, cv2.LINE_AA, SHIFT)
        if not text:
            return
        text = text.encode("ascii", "replace").decode()  # OpenCV draws no other characters
        (width, height), below = cv2.getTextSize(text, FONT, FONT_SIZE, 1)
        left, line, top = max(first[0] >> SHIFT, 0), height + below + 2, first[1] >> SHIFT
        bottom = top if top >= line else top + line
        cv2.rectangle(self.rgb, (left, bottom - line), (left + width + 2, bottom), PLATE, cv2.FILLED)
        cv2.putText(self.rgb, text, (left + 1, bottom - below), FONT, FONT_SIZE, colour, 1, cv2.LINE_AA)

    def solid(self, camera: Camera, box: OrientedBox, colour: Colour, thickness_px: int = 2) -> None:
        """Draws what the image shows of the edges of a 3D box (camera frame), and an arrow along its heading."""
        (edges,) = visible_edges(camera, [box])
        for line in (*edges, *heading_px(camera, box, HEAD * thickness_px / self._scale)):
            cv2.polylines(self.rgb, [self._points(line)], False, colour, thickness_px, cv2.LINE_AA, SHIFT)

    def _points(self, px: Float64[np.ndarray, "2 2"]) -> np.ndarray:
        """Pixels as cv2 takes them; (0, 0) is the centre of the first one, in the copy, too."""
        return np.round(((px + 0.5) * self._scale - 0.5) * (1 << SHIFT)).astype(np.int32)
