"""The outlines of 3D labels on a camera image, and which of them nobody has drawn there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from annotator.geometry.outline import MIN_SIDE_PX, box_on_image
from annotator.rcv.cross_view import box_iou
from annotator.types import Box2D, Camera, Label

# A drawn box and an outline of the same class that overlap by this are the same object's. What a person draws of an
# object that is half hidden is much less than its outline.
SAME_IOU = 0.2


def outlines(camera: Camera, labels: Sequence[Label], min_side_px: float = MIN_SIDE_PX) -> dict[str, Box2D]:
    """The boxes around the visible part of each label, by uid; labels that are not in the picture have none.

    Args:
        min_side_px: a box that is narrower or lower is none.
    """
    pairs = [(label.uid, box_on_image(camera, label.box, label.label, min_side_px)) for label in labels]
    return {uid: box for uid, box in pairs if box is not None}


def undrawn(
    camera: Camera, labels: Sequence[Label], drawn: Sequence[Box2D], min_side_px: float = MIN_SIDE_PX
) -> dict[str, Box2D]:
    """The outlines, by uid, of those labels that none of the drawn boxes stands for; a drawn box stands for one.

    Args:
        min_side_px: as of `outlines`.
    """
    found = outlines(camera, labels, min_side_px)
    if not found or not drawn:
        return found
    uids = list(found)
    overlap = np.array([[box_iou(box, found[uid]) * (box.label == found[uid].label) for box in drawn] for uid in uids])
    rows, columns = linear_sum_assignment(overlap, maximize=True)
    told = {uids[row] for row, column in zip(rows, columns, strict=True) if overlap[row, column] >= SAME_IOU}
    return {uid: box for uid, box in found.items() if uid not in told}
