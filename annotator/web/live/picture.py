"""The camera image of a live frame with what was found on it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from annotator.geometry.oriented_box import EDGES, box_corners
from annotator.geometry.projection import project
from annotator.rcv.finish import FrameProposals
from annotator.types import Box2D, Camera, Frame, OrientedBox

# The panel beside the view is about as wide, pixels.
WIDTH_PX = 640
BOX_COLOR, SOLID_COLOR, LOST_COLOR = (255, 214, 10), (240, 120, 40), (154, 161, 173)
# Straight edges are bent on a distorted image; each is followed in so many steps.
STEPS_DISTORTED = 6
FONT, FONT_SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
# cv2 draws at fractions of a pixel: so many bits of them.
SHIFT = 4


def picture(frame: Frame, found: FrameProposals, width_px: int = WIDTH_PX) -> UInt8[np.ndarray, "h w 3"]:
    """The image, no wider than `width_px`, with the boxes of the image detector, and those in 3D projected on it.

    Image boxes that led to no 3D box are gray.
    """
    share = min(width_px / frame.camera.width_px, 1.0)
    size = (round(share * frame.camera.width_px), round(share * frame.camera.height_px))
    image = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA) if share < 1 else frame.rgb.copy()
    for lost in found.lost:
        _draw_flat(image, lost.image_box, share, LOST_COLOR, lost.label)
    for proposal in found.proposals:
        _draw_flat(image, proposal.image_box, share, BOX_COLOR, f"{proposal.label} {proposal.score:.2f}")
        for line in edges_px(frame.camera, proposal.box):
            points = _fixed(_scaled(line, share))
            cv2.polylines(image, [points], False, SOLID_COLOR, 2, cv2.LINE_AA, SHIFT)
    return image


def edges_px(camera: Camera, box: OrientedBox) -> list[Float64[np.ndarray, "k 2"]]:
    """The twelve edges of a box as lines on the image, pixels; those that reach behind the camera are left out."""
    corners = box_corners(box)
    steps = 1 if camera.is_ideal else STEPS_DISTORTED
    share = np.linspace(0, 1, steps + 1)[:, None]
    lines = [corners[a] + share * (corners[b] - corners[a]) for a, b in EDGES]
    px = project(camera, np.concatenate(lines)).reshape(len(EDGES), steps + 1, 2)
    # what lies far beyond the picture would overflow where it is drawn
    limit = 4 * max(camera.width_px, camera.height_px)
    return [line for line in px if np.isfinite(line).all() and np.abs(line).max() < limit]


def _draw_flat(
    image: UInt8[np.ndarray, "h w 3"], box: Box2D, share: float, color: tuple[int, int, int], text: str
) -> None:
    edges = np.array([[box.x_min, box.y_min], [box.x_max, box.y_max]])
    first, last = (tuple(map(int, corner)) for corner in _fixed(_scaled(edges, share)))
    cv2.rectangle(image, first, last, color, 1, cv2.LINE_AA, SHIFT)
    _write(image, text, (first[0] >> SHIFT, first[1] >> SHIFT), color)


def _write(image: UInt8[np.ndarray, "h w 3"], text: str, corner: tuple[int, int], color: tuple[int, int, int]) -> None:
    """A line above a box's upper left corner, or inside where the picture ends there."""
    (width, height), below = cv2.getTextSize(text, FONT, FONT_SIZE, 1)
    left, line = max(corner[0], 0), height + below + 2
    bottom = corner[1] if corner[1] >= line else corner[1] + line
    cv2.rectangle(image, (left, bottom - line), (left + width + 2, bottom), (20, 20, 20), cv2.FILLED)
    cv2.putText(image, text, (left + 1, bottom - below), FONT, FONT_SIZE, color, 1, cv2.LINE_AA)


def _scaled(px: Float64[np.ndarray, "k 2"], share: float) -> Float64[np.ndarray, "k 2"]:
    """Where pixels are on the smaller picture; both count from the centre of their first pixel."""
    return (px + 0.5) * share - 0.5


def _fixed(px: Float64[np.ndarray, "k 2"]) -> np.ndarray:
    return np.round(px * (1 << SHIFT)).astype(np.int32)
