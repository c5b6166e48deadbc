"""Labelling an object by five drags (the paper's Fig. 6): image box -> two views -> two more views -> its 3D box.

Nothing is kept of an object between the drags: all that a step shows follows from the frame and the boxes drawn so far.

The final box, measured with the simulated operator (24 people, 24 hands of generated recordings, mean IoU to truth,
exact drags | edges off by 1 % of the picture). Around silhouettes: the span of the second step's boxes 0.79 | 0.74 and
0.51 | 0.50; the tightest box of the points that the drags cut out 0.72 | 0.64 and 0.47 | 0.28; one fit through all four
views 0.56 | 0.48 and 0.40 | 0.39. So the span it is. Boxes that mean the whole object (`BoxKind.BOX`) are another
thing: where its vertical is known, the fit gives 1.00 | 0.74 against the span's 0.73 | 0.73.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.geometry.edges import visible_edges
from annotator.geometry.oriented_box import box_corners
from annotator.project import Project
from annotator.rcv.canonical import canonical_box
from annotator.rcv.config import RcvConfig
from annotator.rcv.cross_view import choose, make_pair, measured_intervals, pair_all
from annotator.rcv.interval_fit import fit_box
from annotator.rcv.operator import first_views, next_views
from annotator.rcv.recursion import held_direction
from annotator.types import Box2D, BoxKind, Detector, Frame, OrientedBox, PseudoView
from annotator.types.errors import ConfigError
from annotator.workflows.frames import orientation_for
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.rcv_settings import rcv_config

Views = tuple[PseudoView, PseudoView]
Boxes = Sequence[Box2D | None]

VIEWS_A_STEP = 2
MOST_BOXES = 4
# Longer side of the views that people draw on: on smaller ones a pixel is too coarse for a hand.
LABEL_VIEW_PX = 256


@dataclass(frozen=True, eq=False)
class Step:
    """One step of an object.

    Attributes:
        views: front and side.
        suggested: what the view detector found on each, to be corrected; None where it has nothing to say, and on both
            where both boxes are drawn.
    """

    views: Views
    suggested: tuple[Box2D | None, Box2D | None]


@dataclass(frozen=True, eq=False)
class Labelling:
    """An object as far as it is drawn.

    Attributes:
        steps: whose views can be shown.
        box: the cross-view box so far; None before both boxes of the first step.
        outline: (k, 2, 2) pixels of it on the image.
        points: how many points lie in it; in the frustum as long as there is none.
        stop: why there is no next step although all boxes are drawn, or None.
    """

    steps: tuple[Step, ...]
    box: OrientedBox | None
    outline: Float64[np.ndarray, "k 2 2"]
    points: int
    stop: str | None

    @property
    def views(self) -> tuple[PseudoView, ...]:
        """All views, in the order of the boxes on them."""
        return tuple(view for step in self.steps for view in step.views)


def frame_config(project: Project, frame: Frame) -> RcvConfig:
    """The recursion's settings for a frame of a project."""
    orientation = orientation_for(project.config.settings.rotation, frame)
    return rcv_config(project).model_copy(update={"orientation": orientation})


def label_config(project: Project, frame: Frame) -> RcvConfig:
    """The same for views that people draw on."""
    return to_draw_on(project, frame_config(project, frame))


def to_draw_on(project: Project, config: RcvConfig) -> RcvConfig:
    """Settings with large views, however small the detector's are; where the project says a size itself, with that."""
    said = project.config.settings.rcv.get("view")
    if isinstance(said, dict) and "size_px" in said:
        return config
    size_px = max(config.view.size_px, LABEL_VIEW_PX)
    return config.model_copy(update={"view": config.view.model_copy(update={"size_px": size_px})})


def label_steps(
    opened: OpenFrame,
    image_box: Box2D,
    boxes: Boxes,
    config: RcvConfig,
    kind: BoxKind = BoxKind.SILHOUETTE,
    detector: Detector | None = None,
) -> Labelling:
    """What an object's drags have led to so far.

    Args:
        boxes: on the first step's front and side view, then on the second's; None for one that is not drawn yet.
        config: its orientation is that of the frame.
        kind: what the boxes measure.
        detector: for suggestions, or None.

    Raises:
        ConfigError: more than four boxes.
    """
    if len(boxes) > MOST_BOXES:
        raise ConfigError(f"an object has {MOST_BOXES} boxes on its views, not {len(boxes)}")
    drawn = [*boxes, *[None] * (MOST_BOXES - len(boxes))]
    first = opened.views((image_box.xyxy, config), lambda frame: first_views(frame, image_box, config))
    if first is None:
        return _stopped(opened, (), None, f"fewer than {config.min_points} points lie in this box's frustum")
    is_open = drawn[0] is None or drawn[1] is None
    steps = [Step(first, _suggest(opened, detector if is_open else None, first, image_box, None, config))]
    if drawn[0] is None or drawn[1] is None:
        return _stopped(opened, tuple(steps), None, None)
    box = cross_box(first, (drawn[0], drawn[1]), held_direction(opened.frame.up, config))
    spans = [(view.axes, view.interval_m(b)) for view, b in zip(first, drawn[:2], strict=True) if b is not None]
    key = (image_box.xyxy, drawn[0].xyxy, drawn[1].xyxy, config)
    second = opened.views(key, lambda frame: next_views(frame, image_box, spans, config))
    if second is None:
        return _stopped(opened, tuple(steps), box, f"fewer than {config.min_points} points lie in both boxes")
    is_open = drawn[2] is None or drawn[3] is None
    steps.append(Step(second, _suggest(opened, detector if is_open else None, second, image_box, box, config)))
    if drawn[2] is not None and drawn[3] is not None:
        four = (drawn[0], drawn[1], drawn[2], drawn[3])
        box = final_box((*first, *second), four, held_direction(opened.frame.up, config), kind, config)
    return _stopped(opened, tuple(steps), box, None)


def cross_box(views: Views, boxes: tuple[Box2D, Box2D], up: Float64[np.ndarray, "3"] | None) -> OrientedBox:
    """The box of one step: what the front and the side box span along the step's axes."""
    return canonical_box(make_pair(views[0].axes, views, [boxes[0]], [boxes[1]], 0, 0).box, up)


def final_box(
    views: Sequence[PseudoView],
    boxes: tuple[Box2D, Box2D, Box2D, Box2D],
    up: Float64[np.ndarray, "3"] | None,
    kind: BoxKind,
    config: RcvConfig,
) -> OrientedBox:
    """The 3D box of all four drags; see the head of this file."""
    span = cross_box((views[2], views[3]), (boxes[2], boxes[3]), up)
    if kind is BoxKind.SILHOUETTE or up is None:
        return span
    fit = fit_box(measured_intervals(views, boxes, config), up, span.rotation, config.fit)
    if fit is None:
        return span
    return canonical_box(OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m), up)


def _suggest(
    opened: OpenFrame,
    detector: Detector | None,
    views: Views,
    image_box: Box2D,
    last: OrientedBox | None,
    config: RcvConfig,
) -> tuple[Box2D | None, Box2D | None]:
    """The detections that go together best, or continue the last step's box."""
    if detector is None:
        return None, None
    front, side = opened.detections(views, detector)
    front, side = ([box for box in found if box.label == image_box.label] for found in (front, side))
    if last is None and front and side:
        cloud = opened.frame.cloud.select(opened.frustum(image_box))
        pairs = pair_all(views[0].axes, views, front, side, cloud, config)
        if pairs:
            return front[pairs[0].front], side[pairs[0].side]
    corners = None if last is None else box_corners(last)
    best = [choose(view, found, corners, config) for view, found in zip(views, (front, side), strict=True)]
    return (
        None if best[0] is None else front[best[0]],
        None if best[1] is None else side[best[1]],
    )


def _stopped(opened: OpenFrame, steps: tuple[Step, ...], box: OrientedBox | None, stop: str | None) -> Labelling:
    if box is None:
        points = len(steps[0].views[0].xyz_m) if steps else 0
        return Labelling(steps, None, np.zeros((0, 2, 2)), points, stop)
    outline = visible_edges(opened.frame.camera, [box])[0]
    return Labelling(steps, box, outline, opened.index.count(box), stop)
