"""The paper's labelling procedure (Fig. 6), step by step: image box -> two views -> two more views -> the object.

Whoever draws the boxes, a person in the browser or the simulated operator of the benchmarks, goes through the same
steps: five 2D boxes an object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from annotator.geometry.frustum import in_frustum
from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv import cross_view
from annotator.rcv.axes import camera_frame, find_axes
from annotator.rcv.canonical import canonical_box
from annotator.rcv.config import RcvConfig, Strategy
from annotator.rcv.normals import with_normals
from annotator.rcv.pseudo_view import render_pairs
from annotator.rcv.recursion import held_direction
from annotator.types import Box2D, Frame, OrientedBox, PointCloud, PseudoView

LABELLED_STEPS = 2

DrawOnView = Callable[[PseudoView], Box2D | None]
"""Draws the one box of the object on a pseudo-view; None where it cannot be seen."""


@dataclass(frozen=True, eq=False)
class DrawnView:
    """A pseudo-view, the step that it belongs to (from 0), and the box drawn on it."""

    view: PseudoView
    step: int
    box: Box2D


@dataclass(frozen=True, eq=False)
class DrawnObject:
    """One object after the drags.

    Attributes:
        image_box: on the camera image.
        views: front and side of each step.
        cut: the last step's cross-view box: it holds the object's points.
    """

    image_box: Box2D
    views: tuple[DrawnView, ...]
    cut: OrientedBox


def draw_object(frame: Frame, image_box: Box2D, draw: DrawOnView, config: RcvConfig) -> DrawnObject | None:
    """Goes through the first two steps with one object.

    Returns:
        None where the object gets lost: too few points, or a view on which nothing could be drawn.
    """
    mask = in_frustum(frame.camera, frame.cloud.xyz_m, image_box)
    cloud = with_normals(frame, mask).select(mask)
    up = held_direction(frame.up, config)
    axes, box = camera_frame(up), None
    drawn: list[DrawnView] = []
    for step in range(LABELLED_STEPS):
        if len(cloud) < config.min_points:
            return None
        if step > 0:
            axes = find_axes(cloud, Strategy.NORMALS, axes, up, config).frame
        box = _draw_step(cloud, axes, box, step, draw, drawn, config)
        if box is None:
            return None
        cloud = cloud.select(contains(box, cloud.xyz_m, config.keep_margin * float(box.size_m.mean())))
    assert box is not None  # LABELLED_STEPS is not zero
    return DrawnObject(image_box, tuple(drawn), canonical_box(box, up))


def _draw_step(
    cloud: PointCloud,
    axes: np.ndarray,
    last: OrientedBox | None,
    step: int,
    draw: DrawOnView,
    drawn: list[DrawnView],
    config: RcvConfig,
) -> OrientedBox | None:
    views = render_pairs(cloud, [axes], config.view, None if last is None else box_corners(last))
    boxes = [draw(view) for view in views]
    front, side = boxes
    if front is None or side is None:
        return None
    drawn.extend(DrawnView(view, step, box) for view, box in zip(views, (front, side), strict=True))
    return cross_view.make_pair(axes, (views[0], views[1]), [front], [side], 0, 0).box
