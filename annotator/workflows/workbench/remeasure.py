"""Recomputes the 3D boxes of finished objects after the frame's box kind has changed."""

from __future__ import annotations

import numpy as np

from annotator.geometry.oriented_box import same_box
from annotator.project.event_types import ImageBoxesSet, LabelEdited
from annotator.project.overview import FramePage
from annotator.project.records import BoxRecord
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind, OrientedBox
from annotator.workflows.views.write_pictures import changes_kind
from annotator.workflows.workbench.drawing_steps import MAX_BOXES, VIEWS_PER_STEP, label_steps
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.frame_state import ShownObject, shown_objects


def remeasured(page: FramePage, opened: OpenFrame, config: RcvConfig, on_image: ImageBoxesSet) -> list[LabelEdited]:
    """Returns the edits of those labels whose drawn boxes now give another 3D box, except labels corrected since.

    Args:
        page: the frame before the change.
        opened: the same frame.
        config: with the orientation for the frame.
        on_image: the new boxes on the image, and what they measure.
    """
    if page.image_boxes is None or not changes_kind(page, on_image):
        return []
    labels = {stored.label.uid: stored.label for stored in page.labels}
    edits = []
    for item in shown_objects(page):
        if item.uid is None or item.image_box not in on_image.boxes:
            continue
        label = labels[item.uid]
        before, now = (_measured(opened, item, config, kind) for kind in (page.image_boxes.box_kind, on_image.box_kind))
        if before is None or now is None or not same_box(before, label.box):
            continue
        if same_box(now, label.box) and label.box_kind is on_image.box_kind:
            continue
        edits.append(
            LabelEdited(
                uid=label.uid,
                label=label.label,
                box=BoxRecord.of(now),
                track_id=label.track_id,
                image_box=item.image_box,
                suggestion=label.suggestion,  # nobody has corrected it
                box_kind=on_image.box_kind,
            )
        )
    return edits


def _measured(opened: OpenFrame, item: ShownObject, config: RcvConfig, kind: BoxKind) -> OrientedBox | None:
    """Returns the 3D box that an object's drawn boxes give; None if one of these is missing."""
    if len(item.views) != MAX_BOXES or any(len(view.boxes) != 1 for view in item.views):
        return None
    boxes, geometry = [view.boxes[0] for view in item.views], item.views[VIEWS_PER_STEP].geometry
    axes = None if geometry is None else np.array(geometry.axes)
    return label_steps(opened, item.image_box, boxes, config, kind, axes=axes).box
