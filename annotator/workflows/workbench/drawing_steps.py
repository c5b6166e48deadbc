"""Labelling an object from its box on the image: boxes on two views of the frustum, then on two views of the object.

No state is stored between the drags: each step is computed from the frame and the boxes drawn so far. With a view
detector, all boxes that are not drawn yet are suggested: `fit` finds the object's 3D box, and the suggestions are its
ends on each view. The second step's views then look along the axes of the 3D box. Boxes that the operator draws or
corrects are known to `fit`, so the other suggestions follow. Without a detector, the operator draws all five boxes (the
paper's Fig. 6), and the second step's views look along the normals of the points.

How the final box is computed was chosen by measurement with the simulated operator: 24 people and 24 hands of generated
recordings, mean IoU to the true box, with exactly drawn boxes | with edges off by 1 % of the view.

    boxes around silhouettes                                 people        hands
    span of the second step's boxes (used)                   0.79 | 0.74   0.51 | 0.50
    tightest box of the points inside all drawn boxes        0.72 | 0.64   0.47 | 0.28
    one fit through all four views                           0.56 | 0.48   0.40 | 0.39

For boxes around the whole object (`BoxKind.BOX`) with a known up direction, the fit reaches 1.00 | 0.74 and the span
0.73 | 0.73, so the fit is used there.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeGuard

import numpy as np
from jaxtyping import Float64

from annotator.geometry.oriented_box import box_corners, canonical_box
from annotator.geometry.outline import visible_edges
from annotator.project import Project, StoredFrame, ViewBoxes
from annotator.project.records import ViewGeometry
from annotator.rcv.axes import camera_axes, match_axes
from annotator.rcv.config import MIN_POINTS, RcvConfig
from annotator.rcv.interval_fit import fit_box
from annotator.rcv.known_objects import Span, first_views, next_views
from annotator.rcv.measure import make_pair, measured_intervals
from annotator.rcv.recursion import held_direction
from annotator.rcv.whole_box import Offered, SeenObject, whole_boxes
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, PseudoView
from annotator.types.errors import AnnotatorError, ConfigError, FrameError
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.samples import drawn_objects, taught_by_drags
from annotator.workflows.workbench.frame_cache import Memo, OpenFrame, Views
from annotator.workflows.workbench.loaded_detectors import ReadyDetector
from annotator.workflows.workbench.refit import FoundBox, find_box, not_found

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


Boxes = Sequence[Box2D | None]
Planes = Sequence[ViewGeometry | None]
Axes = Float64[np.ndarray, "3 3"]
Fit = Callable[[Sequence[Span]], FoundBox]
"""Finds an object's 3D box from its box on the image and what the boxes drawn on its views span."""

LOG = logging.getLogger("annotator.detectors")

VIEWS_PER_STEP = 2
MAX_BOXES = 4
# Smallest side length of views to draw on: on smaller ones a pixel is too coarse to draw by hand.
LABEL_VIEW_PX = 256


@dataclass(frozen=True, eq=False)
class Step:
    """One step of an object.

    Attributes:
        views: front and side.
        suggested: a box for each view without a drawn one; None where nothing is suggested.
    """

    views: Views
    suggested: tuple[Box2D | None, Box2D | None]


@dataclass(frozen=True, eq=False)
class Labelling:
    """The state of an object after the boxes drawn so far.

    Attributes:
        steps: the steps whose views can be drawn.
        box: the 3D box of the drawn and suggested boxes; None until the first step has both.
        outline: (k, 2, 2) its visible edges on the image, pixels.
        points: number of points in the box; in the frustum while there is no box.
        stop: why no further step is possible, or None.
        drawn: the drawn boxes on these views; None where none is drawn.
    """

    steps: tuple[Step, ...]
    box: OrientedBox | None
    outline: Float64[np.ndarray, "k 2 2"]
    points: int
    stop: str | None
    note: str | None = None
    drawn: tuple[Box2D | None, ...] = ()

    @property
    def views(self) -> tuple[PseudoView, ...]:
        """All views, in the order of the boxes on them."""
        return tuple(view for step in self.steps for view in step.views)


def frame_config(
    project: Project,
    frame: Frame,
    detector: ReadyDetector | None = None,
    kind: BoxKind | None = None,
    image_kind: BoxKind = BoxKind.BOX,
) -> RcvConfig:
    """Returns the recursion's settings for a frame of a project.

    Args:
        detector: the view detector that will be used; None = one with the project's classes, for whole boxes.
        kind: what a class-agnostic detector, which knows both, should measure; None = its usual kind.
        image_kind: what the boxes on the image enclose.
    """
    orientation = orientation_for(project.config.settings.rotation, frame)
    config = rcv_config(project).model_copy(update={"orientation": orientation})
    if detector is None:
        return config
    own_kind = kind if kind is not None and detector.class_agnostic else detector.box_kind
    return config.for_detector(own_kind, detector.class_agnostic, image_kind, detector.trained)


def label_config(project: Project, frame: Frame) -> RcvConfig:
    """Returns `frame_config` with views large enough to draw on."""
    return to_draw_on(project, frame_config(project, frame))


def to_draw_on(project: Project, config: RcvConfig) -> RcvConfig:
    """Raises the view size to `LABEL_VIEW_PX`, unless the project's settings state a size."""
    if "view_px" in project.config.settings.rcv:
        return config
    return config.model_copy(update={"view_px": max(config.view_px, LABEL_VIEW_PX)})


def label_object(
    project: Project,
    opened: OpenFrame,
    image_box: Box2D,
    boxes: Boxes,
    kind: BoxKind,
    planes: Planes,
    detector: ReadyDetector | None,
) -> Labelling:
    """As `label_steps` with the project's settings; a detector that fails gives a note instead of suggestions."""
    fit = None
    if detector is not None:
        settings = frame_config(project, opened.frame, detector, kind, kind)
        fit = partial(_fit_or_note, opened, image_box, settings, detector)
    config = label_config(project, opened.frame)
    return label_steps(opened, image_box, boxes, config, kind, planes=planes, fit=fit)


def _fit_or_note(
    opened: OpenFrame, image_box: Box2D, config: RcvConfig, detector: ReadyDetector, known: Sequence[Span]
) -> FoundBox:
    # boxes can be drawn and saved without suggestions
    try:
        return find_box(opened, image_box, config, detector, known=known)
    except AnnotatorError as error:
        return not_found(str(error))
    except Exception:
        LOG.exception("frame %s: the detector's suggestions failed", opened.frame.key)
        return not_found("internal error, see the server's log")


def label_steps(
    opened: OpenFrame,
    image_box: Box2D,
    boxes: Boxes,
    config: RcvConfig,
    kind: BoxKind = BoxKind.SILHOUETTE,
    *,
    axes: Axes | None = None,
    planes: Planes = (),
    fit: Fit | None = None,
) -> Labelling:
    """Computes the state of an object from the boxes drawn so far.

    Args:
        boxes: on the first step's front and side view, then on the second's; None for a box not drawn yet.
        config: as `label_config` returns it.
        kind: what the boxes measure.
        axes: rows = axes of the second step's front view, if a box was drawn on that step; None = those of `planes`, or
            else not decided yet.
        planes: of the views that the boxes were drawn on. An image box or an earlier box may have changed since: then
            a box keeps its place in metres, and is gone if its view has other axes or does not show it any more.
        fit: suggests boxes; None = no suggestions.
    """
    if len(boxes) > MAX_BOXES:
        raise ConfigError(f"an object has {MAX_BOXES} boxes on its views, not {len(boxes)}")
    drawn = [*boxes, *[None] * (MAX_BOXES - len(boxes))]
    planes = [*planes, *[None] * (MAX_BOXES - len(planes))]
    if axes is None:
        axes = _front_axes(planes[2:])
    up = held_direction(opened.frame.up, config)
    first = opened.views((image_box.xyxy, config), lambda frame: first_views(frame, image_box, config))
    if first is None:
        return _labelling(opened, (), None, f"fewer than {MIN_POINTS} points lie in this box's frustum")
    drawn[:2] = _placed(first, drawn[:2], planes[:2])
    known = _spans(first, drawn[:2])
    found = fit(known) if fit is not None and None in drawn else None
    on_first = suggested_boxes(opened, first, drawn[:2], image_box, None if found is None else found.box, kind)
    steps = [Step(first, on_first)]
    note = None if found is None else found.note
    filled = _filled(drawn[:2], on_first)
    if not _are_both(filled):
        return _labelling(opened, tuple(steps), None, None, note, drawn)
    box = cross_box(first, filled, up)
    if axes is None and found is not None and found.box is not None:
        axes = match_axes(found.box.rotation.T, camera_axes(up))
    spans = _spans(first, filled)
    key = (image_box.xyxy, *(b.xyxy for b in filled), None if axes is None else axes.tobytes(), config)
    second = opened.views(key, lambda frame: next_views(frame, image_box, spans, config, axes))
    if second is None:
        return _labelling(opened, tuple(steps), box, f"fewer than {MIN_POINTS} points lie in both boxes", note, drawn)
    drawn[2:] = _placed(second, drawn[2:], planes[2:])
    drawn_there = _spans(second, drawn[2:])
    if fit is not None and len(drawn_there) == 1:
        found = fit([*known, *drawn_there])
    in_3d = None if found is None or found.box is None else turned_onto(found.box, second[0].axes)
    on_second = suggested_boxes(opened, second, drawn[2:], image_box, in_3d, kind)
    steps.append(Step(second, on_second))
    last = _filled(drawn[2:], on_second)
    if _are_both(last):
        box = final_box((*first, *second), (*filled, *last), up, kind)
    return _labelling(opened, tuple(steps), box, None, note if found is None else found.note, drawn)


def _front_axes(planes: Planes) -> Axes | None:
    """The axes of a step's front view (rows), from those of either of its views; None if both are unknown."""
    front, side = planes
    if front is not None:
        return np.array(front.axes)
    return None if side is None else np.array(side.axes)[[2, 1, 0]] * [[-1.0], [1.0], [1.0]]


def _placed(views: Views, boxes: Boxes, planes: Planes) -> list[Box2D | None]:
    """Boxes at the same place in metres on these views as on the planes that they were drawn on."""
    return [
        box if box is None or plane is None else _placed_on(view, box, plane)
        for view, box, plane in zip(views, boxes, planes, strict=True)
    ]


def _placed_on(view: PseudoView, box: Box2D, plane: ViewGeometry) -> Box2D | None:
    if not np.allclose(plane.axes, view.axes, atol=1e-6):
        return None
    if plane.metres_per_px == view.metres_per_px and np.array_equal(plane.origin_m, view.origin_m):
        return box
    edges = np.array([[box.x_min, box.x_max], [box.y_min, box.y_max]])
    moved = view.box_px(np.array(plane.origin_m)[:, None] + edges * plane.metres_per_px, box.label)
    height_px, width_px = view.rgb.shape[:2]
    x_min, x_max = np.clip([moved.x_min, moved.x_max], -0.5, width_px - 0.5)
    y_min, y_max = np.clip([moved.y_min, moved.y_max], -0.5, height_px - 0.5)
    if min(x_max - x_min, y_max - y_min) < MIN_SIDE_PX / 2:
        return None
    return replace(moved, x_min=float(x_min), y_min=float(y_min), x_max=float(x_max), y_max=float(y_max))


def _spans(views: Views, boxes: Boxes) -> list[Span]:
    return [(view.axes, view.interval_m(box)) for view, box in zip(views, boxes, strict=True) if box is not None]


def _filled(drawn: Boxes, suggested: tuple[Box2D | None, Box2D | None]) -> tuple[Box2D | None, Box2D | None]:
    front, side = (one or other for one, other in zip(drawn, suggested, strict=True))
    return front, side


def _are_both(boxes: tuple[Box2D | None, Box2D | None]) -> TypeGuard[tuple[Box2D, Box2D]]:
    return None not in boxes


def cross_box(views: Views, boxes: tuple[Box2D, Box2D], up: Float64[np.ndarray, "3"] | None) -> OrientedBox:
    """Returns the box of one step: the span of the front and the side box along the step's axes."""
    return canonical_box(make_pair(views, boxes[0], boxes[1]).box, up)


def final_box(
    views: Sequence[PseudoView],
    boxes: tuple[Box2D, Box2D, Box2D, Box2D],
    up: Float64[np.ndarray, "3"] | None,
    kind: BoxKind,
) -> OrientedBox:
    """Returns the 3D box of all four boxes; the module docstring compares the methods."""
    span = cross_box((views[2], views[3]), (boxes[2], boxes[3]), up)
    if kind is BoxKind.SILHOUETTE or up is None:
        return span
    fit = fit_box(measured_intervals(views, boxes), up, span.rotation)
    if fit is None:
        return span
    return canonical_box(OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m), up)


def _labelling(
    opened: OpenFrame,
    steps: tuple[Step, ...],
    box: OrientedBox | None,
    stop: str | None,
    note: str | None = None,
    drawn: Boxes = (),
) -> Labelling:
    drawn = tuple(drawn[: VIEWS_PER_STEP * len(steps)])
    if box is None:
        points = len(steps[0].views[0].xyz_m) if steps else 0
        return Labelling(steps, None, np.zeros((0, 2, 2)), points, stop, note, drawn)
    outline = visible_edges(opened.frame.camera, [box])[0]
    return Labelling(steps, box, outline, opened.points_in(box), stop, note, drawn)


# Frames whose drawn objects are kept; one object takes some 200 kB.
MOST_FRAMES = 300


class WholeBoxes:
    """Offers whole boxes for the drawn objects of a project; remembers what its frames show of them. Thread-safe."""

    def __init__(self, project: Project, read: Callable[[StoredFrame], Frame] | None = None) -> None:
        """
        Args:
            read: reads a frame of the project; None = with a `FrameSource`, for recordings that stay where they are.
        """
        self.project = project
        self._read_frame = read or FrameSource(project).read
        self._lock = threading.Lock()
        self._seen = Memo(MOST_FRAMES)

    def of(self, frame: Frame, stored: StoredFrame, image_box: Box2D, detector: ReadyDetector | None) -> list[Offered]:
        """Returns the boxes that a drawn object may have, best first; none while its silhouettes are not all drawn.

        Args:
            detector: for pseudo-views; used if it knows whole boxes.
        """
        views = [one for one in self._drawn(stored.id) if _image_box(one) == image_box]
        cut = taught_by_drags(frame, views[0]) if views else None
        seen = next((one for one in self._objects(stored, frame) if one.image_box == image_box), None)
        if cut is None or cut.points is None or seen is None:
            return []
        config = frame_config(self.project, frame, detector, BoxKind.BOX, BoxKind.SILHOUETTE)
        view = detector if config.box_kind is BoxKind.BOX else None
        cloud = frame.cloud.select(cut.points)
        before, after = self._others(stored, image_box.label)
        return whole_boxes(seen, cloud, before, after, view, config)

    def _others(self, stored: StoredFrame, label: str) -> tuple[Iterator[list[SeenObject]], Iterator[list[SeenObject]]]:
        """The drawn objects of a class in the frames before and after, the nearest first, read one by one."""
        labelled = self.project.boxes.frames_with_images()
        frames = [one for one in self.project.frames.of([stored.recording_id]) if one.index is not None]
        place = next((n for n, one in enumerate(frames) if one.id == stored.id), len(frames))
        before, after = frames[:place][::-1], frames[place + 1 :]
        both = [
            (
                found
                for one in side
                if one.id in labelled
                if (found := [seen for seen in self._objects(one) if seen.image_box.label == label])
            )
            for side in (before, after)
        ]
        return both[0], both[1]

    def _drawn(self, frame_id: int) -> list[tuple[ViewBoxes, ...]]:
        return drawn_objects(self.project.boxes.on_views_of(frame_id)).get(frame_id, [])

    def _objects(self, stored: StoredFrame, frame: Frame | None = None) -> list[SeenObject]:
        """The drawn objects of a frame; none if it cannot be read."""
        drawn = self._drawn(stored.id)
        rotation = self.project.config.settings.rotation
        # what is seen lies in the camera frame, which a correction of the calibration moves
        adjusted = self.project.adjustments.newest(stored.recording_id)
        key = stored.id, rotation, adjusted, tuple(view.event_id for views in drawn for view in views)
        if not drawn:
            return []

        def read() -> list[SeenObject]:
            # one frame at a time: reading takes 0.1 s, and recordings need not be thread-safe
            with self._lock:
                return self._read(self._read_frame(stored) if frame is None else frame, drawn)

        try:
            return self._seen.get(key, read)
        except FrameError:
            return []  # another frame; the operator sees the problem when it is opened

    def _read(self, frame: Frame, drawn: Sequence[tuple[ViewBoxes, ...]]) -> list[SeenObject]:
        up = held_direction(frame.up, frame_config(self.project, frame))
        objects = []
        for views in drawn:
            cut, image_box = taught_by_drags(frame, views), _image_box(views)
            if cut is not None and cut.points is not None and image_box is not None:
                objects.append(SeenObject.of(frame, cut.points, image_box, cut.box.rotation, up))
        return objects


def _image_box(views: Sequence[ViewBoxes]) -> Box2D | None:
    return None if views[0].geometry is None else views[0].geometry.image_box
