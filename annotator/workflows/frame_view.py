"""What a page shows of a frame: its labels with their wire frames, points and doubt, and the objects drawn on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.geometry.edges import visible_edges
from annotator.project import Project, StoredLabel, ViewBoxes
from annotator.project.overview import FramePage, read_page
from annotator.types import Box2D
from annotator.workflows.doubt import doubt
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.view_pairs import ObjectViews, front_and_side, views_by_object


@dataclass(frozen=True, eq=False)
class ShownLabel:
    """A label, and what is drawn and told of it.

    Attributes:
        stored: the label.
        outline: (k, 2, 2) pixels, the visible pieces of its edges on the image.
        points: how many points lie in its box.
        doubt: in 0..1, for a proposal that nobody has reviewed.
    """

    stored: StoredLabel
    outline: Float64[np.ndarray, "k 2 2"]
    points: int
    doubt: float | None


@dataclass(frozen=True, eq=False)
class ShownObject:
    """An object begun or finished by drawing 2D boxes.

    Attributes:
        image_box: on the camera image.
        views: of each step, front and side, as far as they are drawn.
        uid: of the label that it became, or None.
    """

    image_box: Box2D
    views: tuple[ViewBoxes, ...]
    uid: str | None


@dataclass(frozen=True, eq=False)
class ShownFrame:
    """A frame's page with everything that is computed for it."""

    page: FramePage
    labels: tuple[ShownLabel, ...]
    objects: tuple[ShownObject, ...]


def present_page(project: Project, frame_id: int, opened: OpenFrame) -> FramePage:
    """What is known of a frame now; only what has changed since the last time is read.

    Raises:
        NotFoundError: no such frame.
    """
    opened.page = page = read_page(project, frame_id, opened.page)
    return page


def show_frame(project: Project, frame_id: int, opened: OpenFrame) -> ShownFrame:
    """The present state of a frame; what follows from its labels is computed once a revision.

    Raises:
        NotFoundError: no such frame.
    """
    page = present_page(project, frame_id, opened)
    labels, objects = opened.newest(
        "shown", page.frame.revision, lambda: (_shown_labels(page, opened), shown_objects(page))
    )
    return ShownFrame(page, labels, objects)


def _shown_labels(page: FramePage, opened: OpenFrame) -> tuple[ShownLabel, ...]:
    edges = visible_edges(opened.frame.camera, [stored.label.box for stored in page.labels])
    return tuple(
        ShownLabel(stored, outline, opened.points_in(stored.label.box), doubt(stored.quality, stored.label.score))
        for stored, outline in zip(page.labels, edges, strict=True)
    )


def shown_objects(page: FramePage) -> tuple[ShownObject, ...]:
    """The objects that are begun or finished on a frame, in the order of their boxes on its image."""
    if page.image_boxes is None:
        return ()
    views = views_by_object(page.view_boxes)
    uids = {stored.image_box: stored.label.uid for stored in page.labels if stored.image_box is not None}
    return tuple(
        ShownObject(box, _views_of(page.frame.id, box, views), uids.get(box))
        for box in dict.fromkeys(page.image_boxes.boxes)
    )


def _views_of(frame_id: int, image_box: Box2D, views: ObjectViews) -> tuple[ViewBoxes, ...]:
    """Front and side of the first step, then of the second: the last ones that were drawn."""
    found: list[ViewBoxes] = []
    for _, drawn in sorted(views.get((frame_id, image_box), {}).items()):
        pair = front_and_side(drawn)
        if pair is None:
            # a step of which one view is drawn is not gone through any further
            return (*found, drawn[-1])
        found.extend(pair)
    return tuple(found)
