"""Which stored pseudo-views belong together: the front and the side view of one object at one step."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np

from annotator.project import ViewBoxes
from annotator.rcv.pseudo_view import side_axes
from annotator.types import Box2D

# Axes come back from the store as they were; this forgives a file that rounds them.
SAME_AXES = 1e-6

ObjectViews = dict[tuple[int, Box2D], dict[int, list[ViewBoxes]]]


def views_by_object(views: Iterable[ViewBoxes]) -> ObjectViews:
    """By frame and box on its camera image, and then by step, the views with boxes whose place in space is known."""
    found: ObjectViews = defaultdict(lambda: defaultdict(list))
    for view in views:
        known = view.geometry is not None and view.geometry.image_box is not None
        if view.frame_id is not None and view.step is not None and known and view.boxes:
            assert view.geometry is not None and view.geometry.image_box is not None  # as `known` says
            found[view.frame_id, view.geometry.image_box][view.step].append(view)
    return found


def front_and_side(views: Sequence[ViewBoxes]) -> tuple[ViewBoxes, ViewBoxes] | None:
    """The pair that was labelled last, front view first; None where no two of the views are a pair.

    Whoever labels pictures may do so in any order, and views of an earlier try may still be there.

    Args:
        views: of one object and step, in the order of their labelling.
    """
    for later in range(len(views) - 1, 0, -1):
        for earlier in range(later - 1, -1, -1):
            for front, side in ((views[earlier], views[later]), (views[later], views[earlier])):
                if _is_pair(front, side):
                    return front, side
    return None


def _is_pair(front: ViewBoxes, side: ViewBoxes) -> bool:
    if front.geometry is None or side.geometry is None:
        return False
    return bool(np.allclose(side_axes(np.array(front.geometry.axes)), side.geometry.axes, atol=SAME_AXES))
