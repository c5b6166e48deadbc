"""2D outlines of 3D labels on a camera image, and the labels among them without a drawn box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from annotator.geometry.outline import MIN_SIDE_PX, box_on_image
from annotator.rcv.measure import box_iou
from annotator.types import Box2D, Camera, Label

# 2D IoU from which a drawn box and an outline of the same class belong to the same object. Low, because the drawn box
# of a half hidden object is much smaller than its outline.
SAME_IOU = 0.2


def outlines(camera: Camera, labels: Sequence[Label], min_side_px: float = MIN_SIDE_PX) -> dict[str, Box2D]:
    """Returns the image box of each label by uid; labels outside the image are left out.

    Args:
        min_side_px: boxes with a shorter side are left out.
    """
    pairs = [(label.uid, box_on_image(camera, label.box, label.label, min_side_px)) for label in labels]
    return {uid: box for uid, box in pairs if box is not None}


def undrawn(
    camera: Camera, labels: Sequence[Label], drawn: Sequence[Box2D], min_side_px: float = MIN_SIDE_PX
) -> dict[str, Box2D]:
    """Returns the outlines by uid of the labels without a drawn box, after matching drawn boxes one to one.

    Args:
        min_side_px: as for `outlines`.
    """
    boxes = outlines(camera, labels, min_side_px)
    matched = drawn_of(boxes, drawn)
    return {uid: box for uid, box in boxes.items() if uid not in matched}


def drawn_of(boxes: Mapping[str, Box2D], drawn: Sequence[Box2D]) -> dict[str, int]:
    """Returns which drawn box belongs to an outline, by the outline's uid: those that overlap most, one to one."""
    if not boxes or not drawn:
        return {}
    uids = list(boxes)
    overlap = np.array([[box_iou(box, boxes[uid]) * (box.label == boxes[uid].label) for box in drawn] for uid in uids])
    rows, columns = linear_sum_assignment(overlap, maximize=True)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {uids[row]: column for row, column in pairs if overlap[row, column] >= SAME_IOU}
