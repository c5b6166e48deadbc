"""Groups stored pseudo-views by object and step, and pairs front and side views."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np

from annotator.project import ViewBoxes
from annotator.project.log.records import Rotation3
from annotator.rcv.pseudo_view import side_axes
from annotator.types import Box2D

# Tolerance for axes that a file has rounded; the store returns them exactly.
SAME_AXES = 1e-6

ObjectViews = dict[tuple[int, Box2D], dict[int, list[ViewBoxes]]]


def views_by_object(views: Iterable[ViewBoxes]) -> ObjectViews:
    """Groups views with boxes and known geometry by (frame, image box), then by step."""
    grouped: ObjectViews = defaultdict(lambda: defaultdict(list))
    for view in views:
        image_box = None if view.geometry is None else view.geometry.image_box
        if view.frame_id is not None and view.step is not None and image_box is not None and view.boxes:
            grouped[view.frame_id, image_box][view.step].append(view)
    return grouped


def front_and_side(views: Sequence[ViewBoxes]) -> tuple[ViewBoxes, ViewBoxes] | None:
    """Returns the pair that was labelled last, front view first; None if no two views are a pair.

    Views may have been labelled in any order, and may include those of an earlier attempt.

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
    return _are_beside(front.geometry.axes, side.geometry.axes)


@lru_cache(maxsize=1024)
def _are_beside(front: Rotation3, side: Rotation3) -> bool:
    return bool(np.allclose(side_axes(np.array(front)), side, atol=SAME_AXES))
