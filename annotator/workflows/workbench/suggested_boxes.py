"""Where the 3D box of an object ends on its pseudo-views: the boxes that the page suggests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from annotator.geometry.oriented_box import box_corners
from annotator.rcv.axes import match_axes
from annotator.types import Box2D, BoxKind, OrientedBox, PseudoView
from annotator.workflows.workbench.open_frame import OpenFrame

# Smallest side of a suggested box, pixels: it must be possible to grab it.
MIN_SIDE_PX = 2.0
# Cosine of the largest angle by which a box is turned onto the axes of views.
SAME_AXES = float(np.cos(np.deg2rad(20)))


def suggested_boxes(
    opened: OpenFrame,
    views: tuple[PseudoView, PseudoView],
    drawn: Sequence[Box2D | None],
    image_box: Box2D,
    box: OrientedBox | None,
    kind: BoxKind,
) -> tuple[Box2D | None, Box2D | None]:
    """Returns a box for each view of a step on which none is drawn, within the view.

    A silhouette ends with the object's points, a box with the 3D box. If only one box is drawn, the other one takes
    over its span along the axis that both views share.

    Args:
        views: front and side.
        drawn: on each of them, or None.
        image_box: has the object's class.
        box: the object's 3D box; None = nothing is suggested.
        kind: what the boxes measure.
    """
    if box is None or None not in drawn:
        return None, None
    if kind is BoxKind.SILHOUETTE:
        points = opened.frame.cloud.xyz_m[opened.inside(box)].astype(np.float64)
    else:
        points = box_corners(box)
    if len(points) == 0:
        return None, None
    shared = next(
        (view.interval_m(known)[1] for view, known in zip(views, drawn, strict=True) if known is not None), None
    )
    front, side = (
        _around(view, points, shared, image_box.label) if known is None else None
        for view, known in zip(views, drawn, strict=True)
    )
    return front, side


def turned_onto(box: OrientedBox, axes: Float64[np.ndarray, "3 3"]) -> OrientedBox:
    """Returns the box turned so that its axes are the rows of `axes`; unchanged if they differ by more than 20 degrees.

    A box fitted after the operator has drawn on a view is thereby measured along that view.
    """
    rows = match_axes(box.rotation.T, axes)
    if np.einsum("ij,ij->i", rows, axes).min() < SAME_AXES:
        return box
    permutation = np.abs(np.rint(rows @ box.rotation))
    return OrientedBox.from_parts(box.center_m, axes.T, permutation @ box.size_m)


def _around(
    view: PseudoView, points: Float64[np.ndarray, "n 3"], shared_m: Float64[np.ndarray, "2"] | None, label: str
) -> Box2D | None:
    """The box around points on a view, clipped to it; None if they are outside."""
    on_view = points @ view.axes[:2].T
    spans_m = np.stack([on_view.min(axis=0), on_view.max(axis=0)], axis=1)
    if shared_m is not None:
        spans_m[1] = shared_m
    height_px, width_px = view.rgb.shape[:2]
    box = view.box_px(spans_m, label)
    ends = np.array([[box.x_min, box.x_max], [box.y_min, box.y_max]])
    middles, halves = ends.mean(axis=1), np.maximum(np.diff(ends)[:, 0], MIN_SIDE_PX) / 2
    low = np.clip(middles - halves, -0.5, None)
    high = np.clip(middles + halves, None, np.array([width_px, height_px]) - 0.5)
    if (high - low < MIN_SIDE_PX / 2).any():
        return None
    return Box2D(label, float(low[0]), float(low[1]), float(high[0]), float(high[1]))
