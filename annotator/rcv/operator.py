"""The paper's labelling procedure (Fig. 6): image box -> two views -> two more views -> the object.

Operators in the browser and the simulated operator of the benchmarks follow the same steps: five 2D boxes per object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.projection import in_frustum
from annotator.rcv.axes import camera_axes, find_axes
from annotator.rcv.config import RcvConfig, Strategy
from annotator.rcv.cross_view import make_pair
from annotator.rcv.measure import any_cut
from annotator.rcv.normals import with_normals
from annotator.rcv.pseudo_view import frustum_views, render_pairs
from annotator.rcv.recursion import cut_cloud, held_direction, shown_box
from annotator.types import Box2D, Frame, PseudoView

LABELLED_STEPS = 2

DrawOnView = Callable[[PseudoView], Box2D | None]
"""Draws the object's box on a pseudo-view; None if the object is not visible."""

Views = tuple[PseudoView, PseudoView]
Span = tuple[np.ndarray, np.ndarray]
"""A view's axes (3, 3), and the view coordinates (2, 2) of the box on it, metres: (low, high) of x and y."""


@dataclass(frozen=True, eq=False)
class DrawnView:
    """A pseudo-view, the number of its step (from 0), and the box drawn on it."""

    view: PseudoView
    step: int
    box: Box2D


@dataclass(frozen=True, eq=False)
class DrawnObject:
    """One object with all its drawn boxes.

    Attributes:
        image_box: on the camera image.
        views: front and side of each step.
    """

    image_box: Box2D
    views: tuple[DrawnView, ...]


def draw_object(frame: Frame, image_box: Box2D, draw: DrawOnView, config: RcvConfig) -> DrawnObject | None:
    """Draws one object's boxes in both steps.

    Args:
        frame: with normals (`frame_with_normals`) if several of its objects are drawn.
        draw: draws the boxes on views.

    Returns:
        None if too few points are left, or if the object is not visible on a view.
    """
    drawn: list[DrawnView] = []
    views = first_views(frame, image_box, config)
    for step in range(LABELLED_STEPS):
        boxes = None if views is None else [draw(view) for view in views]
        if views is None or boxes is None or boxes[0] is None or boxes[1] is None:
            return None
        drawn += [DrawnView(view, step, box) for view, box in zip(views, boxes, strict=True) if box is not None]
        if step + 1 < LABELLED_STEPS:
            spans = [(d.view.axes, d.view.interval_m(d.box)) for d in drawn]
            views = next_views(frame, image_box, spans, config)
    return DrawnObject(image_box, tuple(drawn))


def first_views(frame: Frame, image_box: Box2D, config: RcvConfig) -> Views | None:
    """Front and side view of an image box's frustum along the camera axes; None if it has too few points."""
    cloud = frame.cloud.select(in_frustum(frame.camera, frame.cloud.xyz_m, image_box))
    if len(cloud) < config.min_points:
        return None
    return frustum_views(cloud, camera_axes(held_direction(frame.up, config)), config)


def next_views(
    frame: Frame,
    image_box: Box2D,
    spans: Sequence[Span],
    config: RcvConfig,
    next_axes: Float64[np.ndarray, "3 3"] | None = None,
) -> Views | None:
    """The views of the next step: the points inside the front and the side box.

    Args:
        frame: see `draw_object`.
        spans: of the boxes on the front and the side view, in this order.
        next_axes: rows = axes of the next front view; None: those of the points' normals.

    Returns:
        None if too few points are left.
    """
    (axes, front_span), (_, side_span) = spans
    mask = in_frustum(frame.camera, frame.cloud.xyz_m, image_box)
    if mask.sum() < config.min_points:
        return None
    frustum = with_normals(frame, mask, config).select(mask)
    # as in the recursion, so that these views look like those that the detector will process
    front, side = frustum_views(frustum, axes, config)
    label = image_box.label
    drawn = [[front.box_px(front_span, label)], [side.box_px(side_span, label)]]
    box = make_pair(axes, (front, side), drawn[0], drawn[1], 0, 0).box
    cloud = cut_cloud(frustum, box, (front, side), config)
    if len(cloud) < config.min_points:
        return None
    if next_axes is None:
        next_axes = find_axes(cloud, Strategy.NORMALS, axes, held_direction(frame.up, config), config).axes
    show = box_corners(shown_box(box, any_cut((front, side), drawn, (0, 0), config), config))
    front, side = render_pairs(cloud, [next_axes], config.view, show)
    return front, side


def cut_out(frame: Frame, image_box: Box2D, spans: Sequence[tuple[Span, float]]) -> Bool[np.ndarray, "n"]:
    """Which points lie within all 2D boxes of an object: in the frustum, and in the box on every view.

    Args:
        spans: of each view's box, each with the allowed drawing error, metres.
    """
    mask = in_frustum(frame.camera, frame.cloud.xyz_m, image_box)
    for (axes, span), margin_m in spans:
        on_view = frame.cloud.xyz_m @ axes[:2].T
        mask &= ((on_view >= span[:, 0] - margin_m) & (on_view <= span[:, 1] + margin_m)).all(axis=1)
    return mask
