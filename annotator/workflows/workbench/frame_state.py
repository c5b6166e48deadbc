"""The state of a frame as the page shows it: labels with outline, point count and doubt, and drawn objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from annotator.geometry.outline import visible_edges
from annotator.project import Project, StoredLabel, ViewBoxes
from annotator.project.overview import FramePage, read_page
from annotator.project.sources.covering import covered_by
from annotator.types import Box2D, ReviewState
from annotator.workflows.rigs import OtherLabel
from annotator.workflows.views.outlines import outlines
from annotator.workflows.views.pairs import ObjectViews, front_and_side, views_by_object
from annotator.workflows.workbench.open_frame import OpenFrame
from annotator.workflows.workbench.review_priority import doubt


@dataclass(frozen=True, eq=False)
class ShownLabel:
    """A label as the page shows it.

    Attributes:
        stored: the label.
        outline: (k, 2, 2) its visible edges on the image, pixels.
        points: number of points in its box.
        doubt: in 0..1, for boxes from an automatic pass; else None.
    """

    stored: StoredLabel
    outline: Float64[np.ndarray, "k 2 2"]
    points: int
    doubt: float | None


@dataclass(frozen=True, eq=False)
class ShownOther:
    """A label of another camera of the rig, with its outline (k, 2, 2) on this image, pixels."""

    other: OtherLabel
    outline: Float64[np.ndarray, "k 2 2"]


@dataclass(frozen=True, eq=False)
class ShownObject:
    """An object drawn with 2D boxes, finished or not.

    Attributes:
        image_box: on the camera image.
        views: the drawn views: front and side of each step.
        uid: of the object's label, or None while it is unfinished.
    """

    image_box: Box2D
    views: tuple[ViewBoxes, ...]
    uid: str | None


@dataclass(frozen=True, eq=False)
class ShownFrame:
    """A frame's page with everything computed for it."""

    page: FramePage
    labels: tuple[ShownLabel, ...]
    objects: tuple[ShownObject, ...]


def present_page(project: Project, frame_id: int, opened: OpenFrame) -> FramePage:
    """Returns the stored state of a frame; only what changed since the last call is read.

    Raises:
        NotFoundError: no such frame.
    """
    opened.page = page = read_page(project, frame_id, opened.page)
    return page


def show_frame(project: Project, frame_id: int, opened: OpenFrame) -> ShownFrame:
    """Returns the present state of a frame; what depends on a label is computed again only if the label has changed.

    Raises:
        NotFoundError: no such frame.
    """
    page = present_page(project, frame_id, opened)
    labels, objects = opened.newest(
        "shown", page.frame.revision, lambda: (_shown_labels(page, opened), shown_objects(page))
    )
    return ShownFrame(page, labels, objects)


def _shown_labels(page: FramePage, opened: OpenFrame) -> tuple[ShownLabel, ...]:
    before: tuple[Sequence[ShownLabel], Any] = opened.latest("shown") or ((), ())
    shown = {each.stored: each for each in before[0]}
    new = [stored for stored in page.labels if stored not in shown]
    edges = visible_edges(opened.frame.camera, [stored.label.box for stored in new])
    for stored, outline in zip(new, edges, strict=True):
        points, label = opened.points_in(stored.label.box), stored.label
        shown[stored] = ShownLabel(stored, outline, points, doubt(stored.quality, label.score))
    return tuple(shown[stored] for stored in page.labels)


def shown_others(others: Sequence[OtherLabel], own: Sequence[StoredLabel], opened: OpenFrame) -> list[ShownOther]:
    """Returns the labels of other cameras that the image shows, without rejected ones and those of own labels' objects.

    Args:
        others: their boxes are in this frame's camera.
        own: the frame's labels.
    """
    present = [other for other in others if other.label.state is not ReviewState.REJECTED]
    if not present:
        return []
    covers = covered_by([other.label for other in present], [each.label for each in own])
    on_image = outlines(opened.frame.camera, [other.label for other in present])
    seen = [
        other for other, cover in zip(present, covers, strict=True) if cover is None and other.label.uid in on_image
    ]
    edges = visible_edges(opened.frame.camera, [other.label.box for other in seen])
    return [ShownOther(other, outline) for other, outline in zip(seen, edges, strict=True)]


def shown_objects(page: FramePage) -> tuple[ShownObject, ...]:
    """Returns the drawn objects of a frame, finished or not, in the order of their boxes on the image."""
    if page.image_boxes is None:
        return ()
    views = views_by_object(page.view_boxes)
    uids = {stored.image_box: stored.label.uid for stored in page.labels if stored.image_box is not None}
    return tuple(
        ShownObject(box, _views_of(page.frame.id, box, views), uids.get(box))
        for box in dict.fromkeys(page.image_boxes.boxes)
    )


def _views_of(frame_id: int, image_box: Box2D, views: ObjectViews) -> tuple[ViewBoxes, ...]:
    """Returns front and side of the first step, then of the second, each as drawn last."""
    pairs: list[ViewBoxes] = []
    for _, drawn in sorted(views.get((frame_id, image_box), {}).items()):
        pair = front_and_side(drawn)
        if pair is None:
            # only one view of this step is drawn, so there is no later step
            return (*pairs, drawn[-1])
        pairs.extend(pair)
    return tuple(pairs)
