"""Changes to 2D boxes that follow from an operator's change to a frame.

Detectors must not learn from withdrawn labels. So the image box is removed with the label drawn from it, and the boxes
on pseudo-views are removed with their image box.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from annotator.project.log.event_types import (
    ImageBoxesSet,
    LabelAccepted,
    LabelDeleted,
    LabelEdited,
    LabelRejected,
    Payload,
    ViewBoxesRemoved,
    ViewBoxesSet,
)
from annotator.project.overview import FramePage
from annotator.types import Box2D, ReviewState
from annotator.workflows.views.pairs import views_by_object


def image_follower(page: FramePage, payloads: Sequence[Payload]) -> ImageBoxesSet | None:
    """Returns the boxes on the image after a review of labels; None if they do not change.

    A drawn label that is deleted or rejected removes its box on the image. A rejected label that is accepted or edited
    restores it, so that detectors do not learn the object as background.

    Args:
        page: the frame before the change.
        payloads: the changes to its labels.
    """
    if page.image_boxes is None:
        return None
    drawn = {stored.label.uid: stored for stored in page.labels if stored.image_box is not None}
    boxes = list(page.image_boxes.boxes)
    for payload in payloads:
        match payload:
            case LabelDeleted(uid=uid) | LabelRejected(uid=uid) if uid in drawn:
                boxes = [box for box in boxes if box != drawn[uid].image_box]
            case LabelAccepted(uid=uid) | LabelEdited(uid=uid) if uid in drawn:
                box = drawn[uid].image_box
                if box is not None and box not in boxes and drawn[uid].label.state is ReviewState.REJECTED:
                    boxes.append(box)
    if boxes == list(page.image_boxes.boxes):
        return None
    return ImageBoxesSet(boxes=tuple(boxes), box_kind=page.image_boxes.box_kind)


def changes_kind(page: FramePage, on_image: ImageBoxesSet) -> bool:
    """Returns True if `on_image` changes the box kind of the frame."""
    return page.image_boxes is not None and page.image_boxes.box_kind is not on_image.box_kind


def view_followers(
    page: FramePage, on_image: ImageBoxesSet, *, redrawn: Box2D | None = None, kept: Collection[str] = ()
) -> list[Payload]:
    """Returns the events that keep the boxes on views consistent with those on the image.

    Boxes on views are removed with their image box, since the views are no longer a step of any object. If the box kind
    of the frame changes, that of the views changes as well.

    Args:
        page: the frame before the change.
        on_image: the new boxes on the image.
        redrawn: the image box of an object that is being stored: all its views except `kept` are removed.
        kept: ids of views that are not changed.
    """
    events: list[Payload] = []
    for (_, image_box), steps in views_by_object(page.view_boxes).items():
        is_gone = image_box not in on_image.boxes or image_box == redrawn
        for view in (view for views in steps.values() for view in views if view.view_id not in kept):
            if is_gone:
                events.append(ViewBoxesRemoved(view=view.view_id))
            elif changes_kind(page, on_image) and view.box_kind is not on_image.box_kind:
                events.append(
                    ViewBoxesSet(
                        view=view.view_id,
                        boxes=view.boxes,
                        box_kind=on_image.box_kind,
                        step=view.step,
                        geometry=view.geometry,
                    )
                )
    return events
