"""Finished objects measured anew, where their boxes are said to measure something else than before."""

from __future__ import annotations

import numpy as np

from annotator.project.overview import FramePage
from annotator.project.payloads import ImageBoxesSet, LabelEdited
from annotator.project.records import BoxRecord
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind, OrientedBox
from annotator.workflows.frame_view import ShownObject, shown_objects
from annotator.workflows.labelling import MOST_BOXES, label_steps
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.view_followers import changes_kind

# Two boxes of the same drags are the same up to rounding, metres and entries of the rotation.
SAME = 1e-9


def remeasured(page: FramePage, opened: OpenFrame, config: RcvConfig, on_image: ImageBoxesSet) -> list[LabelEdited]:
    """The labels whose drags lead to another box now. One that was corrected since it was drawn stays as it is.

    Args:
        page: the frame as it was.
        opened: the same frame.
        config: its orientation is that of the frame.
        on_image: the boxes on the image from now on, and what they measure.
    """
    if page.image_boxes is None or not changes_kind(page, on_image):
        return []
    labels = {stored.label.uid: stored.label for stored in page.labels}
    found = []
    for item in shown_objects(page):
        if item.uid is None or item.image_box not in on_image.boxes:
            continue
        label = labels[item.uid]
        former, now = (_measured(opened, item, config, kind) for kind in (page.image_boxes.box_kind, on_image.box_kind))
        if former is None or now is None or not same_box(former, label.box) or same_box(now, label.box):
            continue
        found.append(
            LabelEdited(
                uid=label.uid,
                label=label.label,
                box=BoxRecord.of(now),
                track_id=label.track_id,
                image_box=item.image_box,
            )
        )
    return found


def _measured(opened: OpenFrame, item: ShownObject, config: RcvConfig, kind: BoxKind) -> OrientedBox | None:
    """The box that all drags of an object lead to; None where some of them are missing."""
    if len(item.views) != MOST_BOXES or any(len(view.boxes) != 1 for view in item.views):
        return None
    return label_steps(opened, item.image_box, [view.boxes[0] for view in item.views], config, kind).box


def same_box(a: OrientedBox, b: OrientedBox) -> bool:
    """True where two boxes have the same place, axes and size."""
    return bool(
        np.allclose(a.T_camera_box.as_matrix(), b.T_camera_box.as_matrix(), atol=SAME)
        and np.allclose(a.size_m, b.size_m, atol=SAME)
    )
