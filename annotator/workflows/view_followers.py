"""What other boxes on a camera image mean for the boxes on its pseudo-views, which were drawn from them."""

from __future__ import annotations

from collections.abc import Collection

from annotator.project.overview import FramePage
from annotator.project.payloads import ImageBoxesSet, Payload, ViewBoxesRemoved, ViewBoxesSet
from annotator.types import Box2D
from annotator.workflows.view_pairs import views_by_object


def view_followers(
    page: FramePage, on_image: ImageBoxesSet, *, redrawn: Box2D | None = None, kept: Collection[str] = ()
) -> list[Payload]:
    """The events that keep detectors from learning what the operator has taken back.

    Boxes on views whose image box is gone go too: what they show is no step of any object. Where all boxes of the frame
    are said to measure something else, those on views do so as well.

    Args:
        page: the frame as it was.
        on_image: the boxes on the image from now on.
        redrawn: the image box of an object whose views are `kept` and no others.
        kept: ids of views that need no look.
    """
    changes_kind = page.image_boxes is not None and page.image_boxes.box_kind is not on_image.box_kind
    found: list[Payload] = []
    for (_, image_box), steps in views_by_object(page.view_boxes).items():
        is_gone = image_box not in on_image.boxes or image_box == redrawn
        for view in (view for views in steps.values() for view in views if view.view_id not in kept):
            if is_gone:
                found.append(ViewBoxesRemoved(view=view.view_id))
            elif changes_kind and view.box_kind is not on_image.box_kind:
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
