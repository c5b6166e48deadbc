"""The camera image of a live frame with its detections drawn on it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from annotator.geometry.oriented_box import EDGES, box_corners
from annotator.geometry.outline import heading_px
from annotator.geometry.projection import project
from annotator.rcv.finish import FrameProposals
from annotator.types import Box2D, Camera, Frame, OrientedBox

# About the width of the panel beside the 3D view, pixels.
WIDTH_PX = 640
BOX_COLOR, SOLID_COLOR, LOST_COLOR = (255, 214, 10), (240, 120, 40), (154, 161, 173)
# Length of the head of a heading's arrow, pixels of the drawn image.
HEAD_PX = 10
# Number of segments per box edge on a distorted image, where edges are curved.
STEPS_DISTORTED = 6
FONT, FONT_SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
# Number of fractional bits of pixel coordinates for cv2.
SHIFT = 4


def draw_detections(frame: Frame, detections: FrameProposals, width_px: int = WIDTH_PX) -> UInt8[np.ndarray, "h w 3"]:
    """The image, at most `width_px` wide, with the image detector's boxes, and the 3D boxes with their headings.

    Image boxes without a 3D box are grey.
    """
    scale = min(width_px / frame.camera.width_px, 1.0)
    size = (round(scale * frame.camera.width_px), round(scale * frame.camera.height_px))
    image = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA) if scale < 1 else frame.rgb.copy()
    for lost in detections.lost:
        _draw_rectangle(image, lost.image_box, scale, LOST_COLOR, lost.label)
    for proposal in detections.proposals:
        _draw_rectangle(image, proposal.image_box, scale, BOX_COLOR, f"{proposal.label} {proposal.score:.2f}")
        for line in (*edges_px(frame.camera, proposal.box), *heading_px(frame.camera, proposal.box, HEAD_PX / scale)):
            points = _fixed_point(_scaled(line, scale))
            cv2.polylines(image, [points], False, SOLID_COLOR, 2, cv2.LINE_AA, SHIFT)
    return image


def edges_px(camera: Camera, box: OrientedBox) -> list[Float64[np.ndarray, "k 2"]]:
    """The edges of a box as lines on the image, pixels; edges that reach behind the camera are left out."""
    corners = box_corners(box)
    steps = 1 if camera.is_ideal else STEPS_DISTORTED
    share = np.linspace(0, 1, steps + 1)[:, None]
    lines = [corners[a] + share * (corners[b] - corners[a]) for a, b in EDGES]
    px = project(camera, np.concatenate(lines)).reshape(len(EDGES), steps + 1, 2)
    # coordinates far outside the image overflow in cv2
    limit = 4 * max(camera.width_px, camera.height_px)
    return [line for line in px if np.isfinite(line).all() and np.abs(line).max() < limit]


def _draw_rectangle(
    image: UInt8[np.ndarray, "h w 3"], box: Box2D, scale: float, color: tuple[int, int, int], text: str
) -> None:
    edges = np.array([[box.x_min, box.y_min], [box.x_max, box.y_max]])
    first, last = (tuple(map(int, corner)) for corner in _fixed_point(_scaled(edges, scale)))
    cv2.rectangle(image, first, last, color, 1, cv2.LINE_AA, SHIFT)
    _write(image, text, (first[0] >> SHIFT, first[1] >> SHIFT), color)


def _write(image: UInt8[np.ndarray, "h w 3"], text: str, corner: tuple[int, int], color: tuple[int, int, int]) -> None:
    """Writes a line above a box's upper left corner, or below it at the image's upper border."""
    (width, height), below = cv2.getTextSize(text, FONT, FONT_SIZE, 1)
    left, line = max(corner[0], 0), height + below + 2
    bottom = corner[1] if corner[1] >= line else corner[1] + line
    cv2.rectangle(image, (left, bottom - line), (left + width + 2, bottom), (20, 20, 20), cv2.FILLED)
    cv2.putText(image, text, (left + 1, bottom - below), FONT, FONT_SIZE, color, 1, cv2.LINE_AA)


def _scaled(px: Float64[np.ndarray, "k 2"], scale: float) -> Float64[np.ndarray, "k 2"]:
    """Pixel coordinates on the scaled image; (0, 0) is the centre of the first pixel on both."""
    return (px + 0.5) * scale - 0.5


def _fixed_point(px: Float64[np.ndarray, "k 2"]) -> np.ndarray:
    return np.round(px * (1 << SHIFT)).astype(np.int32)
