"""New pictures of stored pseudo-views.

After a correction of a recording's calibration, its cloud has other colours, and a frustum holds other points. The
drawn boxes stay on their objects, because the views have moved with the cloud. So a picture is drawn anew in the window
that is stored, of the points that the view would show today.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from annotator.geometry.projection import in_frustum
from annotator.project import ViewBoxes
from annotator.rcv.config import RcvConfig
from annotator.rcv.measure import make_pair
from annotator.rcv.pseudo_view import Window, drawn_points, render_window
from annotator.rcv.recursion import cut_cloud
from annotator.rcv.teach import MIN_POINTS
from annotator.types import Frame, PointCloud
from annotator.workflows.views.pairs import front_and_side
from annotator.workflows.views.places import spans_m

Steps = Mapping[int, Sequence[ViewBoxes]]
SizePx = Callable[[ViewBoxes], tuple[int, int]]


def redrawn(
    frame: Frame, view: ViewBoxes, steps: Steps, size_px: SizePx, config: RcvConfig
) -> UInt8[np.ndarray, "h w 3"] | None:
    """The picture that a stored view shows of a frame; None if its drawn boxes enclose hardly a point.

    Args:
        view: with geometry and image box.
        steps: all views of the same object, by step.
        size_px: gives the width and height of a view's picture.
        config: how views are drawn; their size is that of the picture.
    """
    geometry = view.geometry
    assert geometry is not None and geometry.image_box is not None
    frustum = frame.cloud.select(in_frustum(frame.camera, frame.cloud.xyz_m, geometry.image_box))
    width_px, height_px = size_px(view)
    axes, drawn = np.array(geometry.axes), frustum
    if view.step:
        drawn = _cut(frustum, steps, size_px, config)
        keep = drawn_points(len(drawn), config.view.model_copy(update={"size_px": max(width_px, height_px)}))
        drawn = drawn if keep is None else drawn.select(keep)
    if view.boxes:
        low, high = spans_m(view).T
        on_view = drawn.xyz_m @ axes[:2].T
        if np.count_nonzero(((on_view >= low) & (on_view <= high)).all(axis=1)) < MIN_POINTS:
            return None
    window = Window(np.array(geometry.origin_m), geometry.metres_per_px, width_px, height_px)
    return render_window(drawn, axes, window, config.view.max_splat_px)


def _cut(frustum: PointCloud, steps: Steps, size_px: SizePx, config: RcvConfig) -> PointCloud:
    """The points in the boxes of the first step, as in `rcv.known_objects.next_views`; all if these boxes are gone."""
    pair = front_and_side(steps.get(0, ()))
    if pair is None:
        return frustum
    views = [
        view.geometry.view(np.zeros((*size_px(view)[::-1], 3), np.uint8)) for view in pair if view.geometry is not None
    ]
    front, side = ([replace(view.boxes[0], score=1.0)] for view in pair)
    both = views[0], views[1]
    box = make_pair(both[0].axes, both, front, side, 0, 0).box
    return cut_cloud(frustum, box, both, config)
