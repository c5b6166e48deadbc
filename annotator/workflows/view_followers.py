"""What follows for the boxes on a camera image and on its pseudo-views from what an operator does to the frame.

Detectors must not learn what was taken back: the box on the image goes with the label that was drawn from it, and the
boxes on views, which were drawn from that one, go with it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from annotator.project.overview import FramePage
from annotator.project.payloads import (
    ImageBoxesSet,
    LabelAccepted,
    LabelDeleted,
    LabelEdited,
    LabelRejected,
    Payload,
    ViewBoxesRemoved,
    ViewBoxesSet,
)
from annotator.types import Box2D, ReviewState
from annotator.workflows.view_pairs import views_by_object


def image_follower(page: FramePage, payloads: Sequence[Payload]) -> ImageBoxesSet | None:
    """The boxes on the image that the review of labels leaves; None where it changes none.

    A label that was drawn, and is deleted or rejected, takes its box on the image along. One that was rejected and is
    no more brings it back, so that the object is not taught as background.

    Args:
        page: the frame as it was.
        payloads: what becomes of its labels.
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
    """True where the boxes of a frame are said to measure something else than before."""
    return page.image_boxes is not None and page.image_boxes.box_kind is not on_image.box_kind


def view_followers(
    page: FramePage, on_image: ImageBoxesSet, *, redrawn: Box2D | None = None, kept: Collection[str] = ()
) -> list[Payload]:
    """The events that keep the boxes on views in step with those on the image.

    Boxes on views whose image box is gone go too: what they show is no step of any object. Where all boxes of the frame
    are said to measure something else, those on views do so as well.

    Args:
        page: the frame as it was.
        on_image: the boxes on the image from now on.
        redrawn: the image box of an object whose views are `kept` and no others.
        kept: ids of views that need no look.
    """
    found: list[Payload] = []
    for (_, image_box), steps in views_by_object(page.view_boxes).items():
        is_gone = image_box not in on_image.boxes or image_box == redrawn
        for view in (view for views in steps.values() for view in views if view.view_id not in kept):
            if is_gone:
                found.append(ViewBoxesRemoved(view=view.view_id))
            elif changes_kind(page, on_image) and view.box_kind is not on_image.box_kind:
                found.append(
                    ViewBoxesSet(
                        view=view.view_id,
                        boxes=view.boxes,
                        box_kind=on_image.box_kind,
                        step=view.step,
                        geometry=view.geometry,
                    )
                )
    return found
