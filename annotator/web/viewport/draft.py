"""An object that is being labelled: the pseudo-views of its present step, and the box that the drags measure so far."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.rcv.config import RcvConfig
from annotator.rcv.cross_view import make_pair
from annotator.rcv.operator import LABELLED_STEPS, Views, first_views, next_views
from annotator.types import Box2D, Frame, OrientedBox
from annotator.web.viewport.content import Draft


def draft(frame: Frame, image_box: Box2D, drawn: Sequence[Box2D | None], config: RcvConfig) -> Draft:
    """What an object looks like after some of its drags.

    Args:
        frame: the normals that are estimated for the second step are kept in its cloud where it has them.
        image_box: on the camera image.
        drawn: boxes on the views, front and side of the first step, then of the second; None = not yet.
        config: the project's.

    Returns:
        No views where too few points are left to draw any.
    """
    views = first_views(frame, image_box, config)
    box: OrientedBox | None = None
    for step in range(LABELLED_STEPS):
        pair = (*drawn[2 * step : 2 * step + 2], None, None)[:2]
        front, side = pair
        if views is None or front is None or side is None:
            break
        box = _measured(views, front, side)
        if step + 1 < LABELLED_STEPS:
            spans = [(view.axes, view.interval_m(b)) for view, b in zip(views, (front, side), strict=True)]
            following = next_views(frame, image_box, spans, config)
            if following is None:
                break
            views = following
    return Draft(image_box, () if views is None else views, box)


def _measured(views: Views, front: Box2D, side: Box2D) -> OrientedBox:
    """The box that agrees with a box on the front and one on the side view."""
    return make_pair(views[0].axes, views, [front], [side], 0, 0).box
