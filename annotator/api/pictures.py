"""Draws boxes on camera images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from annotator.geometry.oriented_box import EDGES, box_corners
from annotator.geometry.outline import heading_px
from annotator.geometry.projection import project
from annotator.types import Box2D, Frame, Label, OrientedBox, Proposal, Truth

# Colours of 3D and of 2D boxes, RGB.
GREEN, RED = (60, 220, 90), (230, 60, 50)
# Length of an arrow's head, pixels for each pixel of the lines' thickness.
HEAD_PX = 5.0
# Edges with an end beyond this are left out: drawing libraries do not support such coordinates.
FARTHEST_PX = 1e5


def draw_boxes(
    frame: Frame, boxes: Sequence[Proposal | Label | Truth | OrientedBox | Box2D], thickness_px: int = 2
) -> UInt8[np.ndarray, "h w 3"]:
    """The frame's image (RGB) with boxes drawn on it: 3D boxes green, with an arrow along the heading; 2D boxes red.

    Lines that reach behind the camera are left out. To save the result: `cv2.imwrite(name, picture[..., ::-1])`.
    """
    import cv2

    picture = np.ascontiguousarray(frame.rgb).copy()
    for each in boxes:
        if isinstance(each, Box2D):
            low, high = np.rint(np.array(each.xyxy).reshape(2, 2)).astype(int)
            cv2.rectangle(picture, tuple(low.tolist()), tuple(high.tolist()), RED, thickness_px, cv2.LINE_AA)
            continue
        box = each if isinstance(each, OrientedBox) else each.box
        corners = project(frame.camera, box_corners(box))
        arrow = heading_px(frame.camera, box, HEAD_PX * thickness_px)
        for ends in (*(corners[[a, b]] for a, b in EDGES), *arrow):
            if (np.abs(ends) < FARTHEST_PX).all():
                start, end = np.rint(ends).astype(int).tolist()
                cv2.line(picture, tuple(start), tuple(end), GREEN, thickness_px, cv2.LINE_AA)
    return picture
