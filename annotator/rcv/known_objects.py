"""The labelling procedure of the paper, and the 2D boxes of known 3D boxes (RCV paper, section III.A, Fig. 5 and 6).

The procedure is: image box -> two views -> two more views -> the object. Operators in the browser and the simulated
operator of the benchmarks follow the same steps: five 2D boxes per object. A known object goes through them with its
projected 3D box in place of each drawn box. Unlike manually labelled views, its views have boxes for all visible
objects: a frustum often contains neighbours, which would otherwise be unlabelled background in training.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64

from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import NEAR_M, box_on_image
from annotator.geometry.projection import in_frustum
from annotator.rcv.axes import camera_axes, find_axes, frame_with_normals, with_normals
from annotator.rcv.config import MIN_POINTS, RcvConfig, Strategy
from annotator.rcv.measure import any_cut, make_pair
from annotator.rcv.pseudo_view import frustum_views, render_pairs
from annotator.rcv.recursion import cut_cloud, held_direction, shown_box
from annotator.rcv.teach import is_shown, project_box
from annotator.types import Box2D, Frame, PseudoView, Truth

LABELLED_STEPS = 2

DrawOnView = Callable[[PseudoView], Box2D | None]
"""Draws the object's box on a pseudo-view; None if the object is not visible."""

Views = tuple[PseudoView, PseudoView]
Span = tuple[np.ndarray, np.ndarray]
"""A view's axes (3, 3), and the view coordinates (2, 2) of the box on it, metres: (low, high) of x and y."""


@dataclass(frozen=True, eq=False)
class DrawnView:
    """A pseudo-view, the number of its step (from 0), and the boxes on it; that of the drawn object is the first."""

    view: PseudoView
    step: int
    boxes: tuple[Box2D, ...]

    @property
    def box(self) -> Box2D:
        return self.boxes[0]


@dataclass(frozen=True, eq=False)
class DrawnObject:
    """An object's box on the camera image, and its views: front and side of each step."""

    image_box: Box2D
    views: tuple[DrawnView, ...]


def draw_object(frame: Frame, image_box: Box2D, draw: DrawOnView, config: RcvConfig) -> DrawnObject | None:
    """Draws one object's boxes in both steps.

    Returns:
        None if too few points are left, or if the object is not visible on a view.
    """
    drawn: list[DrawnView] = []
    views = first_views(frame, image_box, config)
    for step in range(LABELLED_STEPS):
        boxes = None if views is None else [draw(view) for view in views]
        if views is None or boxes is None or boxes[0] is None or boxes[1] is None:
            return None
        drawn += [DrawnView(view, step, (box,)) for view, box in zip(views, boxes, strict=True) if box is not None]
        if step + 1 < LABELLED_STEPS:
            spans = [(d.view.axes, d.view.interval_m(d.box)) for d in drawn]
            views = next_views(frame, image_box, spans, config)
    return DrawnObject(image_box, tuple(drawn))


def first_views(frame: Frame, image_box: Box2D, config: RcvConfig) -> Views | None:
    """Front and side view of an image box's frustum along the camera axes; None if it has too few points."""
    cloud = frame.cloud.select(in_frustum(frame.camera, frame.cloud.xyz_m, image_box))
    if len(cloud) < MIN_POINTS:
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
        spans: of the boxes on the front and the side view, in this order.
        next_axes: rows = axes of the next front view; None: those of the points' normals.

    Returns:
        None if too few points are left.
    """
    (axes, front_span), (_, side_span) = spans
    mask = in_frustum(frame.camera, frame.cloud.xyz_m, image_box)
    if mask.sum() < MIN_POINTS:
        return None
    frustum = with_normals(frame, mask).select(mask)
    # as in the recursion, so that these views look like those that the detector will process
    views = frustum_views(frustum, axes, config)
    drawn = [view.box_px(span, image_box.label) for view, span in zip(views, (front_span, side_span), strict=True)]
    box = make_pair(views, drawn[0], drawn[1]).box
    cloud = cut_cloud(frustum, box, views)
    if len(cloud) < MIN_POINTS:
        return None
    if next_axes is None:
        next_axes = find_axes(cloud, Strategy.NORMALS, axes, held_direction(frame.up, config), config).axes
    show = box_corners(shown_box(box, any_cut(views, [[drawn[0]], [drawn[1]]], (0, 0))))
    front, side = render_pairs(cloud, [next_axes], config.view_px, show)
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


# An object without points counts as hidden if at least this share of the points in its frustum lie in front of it.
HIDING_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class KnownFrame:
    """The 2D boxes of a frame's 3D boxes.

    Attributes:
        on_image: boxes on the image of all visible objects, including those without views.
        outside: classes of the objects outside the image.
        hidden: classes of the objects without points that are hidden behind something else.
        without_views: classes of the visible objects with too few points for both steps.
    """

    on_image: tuple[Box2D, ...]
    objects: tuple[DrawnObject, ...]
    outside: tuple[str, ...]
    hidden: tuple[str, ...]
    without_views: tuple[str, ...]


def boxes_of_known(frame: Frame, truths: Sequence[Truth], config: RcvConfig) -> KnownFrame:
    """The 2D boxes of known objects on the image and on the views of the first two steps.

    The box of an object that is cut off by the image border covers its visible part. The box of a partly hidden object
    covers its whole extent, as for `BoxKind.BOX`.

    Args:
        frame: with cloud; missing normals are estimated.
        truths: all labelled objects of the classes to learn.
    """
    points = [int(contains(truth.box, frame.cloud.xyz_m).sum()) for truth in truths]
    outside, hidden, visible = [], [], []
    for index, truth in enumerate(truths):
        image_box = box_on_image(frame.camera, truth.box, truth.label)
        if image_box is None:
            outside.append(truth.label)
        elif points[index] == 0 and _is_hidden(frame, truth, image_box):
            hidden.append(truth.label)
        else:
            visible.append((index, image_box))
    frame = frame_with_normals(frame, [box for index, box in visible if points[index]])

    def drawn_on(view: PseudoView, index: int) -> Box2D | None:
        """The box of an object, if a view shows it well enough."""
        inside = int(contains(truths[index].box, view.xyz_m).sum())
        return project_box(view, truths[index].box, truths[index].label) if is_shown(inside, points[index]) else None

    def others_on(view: PseudoView, own: int) -> list[Box2D]:
        boxes = [drawn_on(view, index) for index in range(len(truths)) if index != own]
        return [box for box in boxes if box is not None]

    objects, without_views = [], []
    for index, image_box in visible:
        drawn = draw_object(frame, image_box, partial(drawn_on, index=index), config)
        if drawn is None:
            without_views.append(truths[index].label)
        else:
            views = [replace(d, boxes=(d.box, *others_on(d.view, index))) for d in drawn.views]
            objects.append(replace(drawn, views=tuple(views)))
    on_image = tuple(box for _, box in visible)
    return KnownFrame(on_image, tuple(objects), tuple(outside), tuple(hidden), tuple(without_views))


def _is_hidden(frame: Frame, truth: Truth, image_box: Box2D) -> bool:
    """True for an object without points if the measured points in its frustum lie in front of it.

    If nothing was measured there, or only points behind the object (far objects, glass), the image may show it.
    """
    depth_m = frame.cloud.xyz_m[in_frustum(frame.camera, frame.cloud.xyz_m, image_box), 2]
    nearest_m = max(float(box_corners(truth.box)[:, 2].min()), NEAR_M)
    return len(depth_m) > 0 and float((depth_m < nearest_m).mean()) >= HIDING_SHARE
