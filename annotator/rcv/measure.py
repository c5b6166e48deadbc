"""The box of a step from the detections on its views: from a pair, the consensus of all, or the tightest pair.

Cross-View: a front and a side box that agree on their shared axis give one 3D box (RCV paper, section II.C).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from jaxtyping import Float64

from annotator.geometry.iou import box_iou
from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv.interval_fit import BoxFit, Intervals, fit_box
from annotator.types import Box2D, OrientedBox, PointCloud, PseudoView, StepTrace

# Expected error of a detected edge if the detector does not tell it, share of the view's extent.
EDGE_NOISE = 0.02
# First step: objects of one frustum.
MOST_OBJECTS = 5
# The expected error of an edge is divided by the square root of its detection's score, or of this if it is larger.
LEAST_SCORE = 0.05
# First step: least 1D IoU of a front and a side box on their shared axis.
MIN_SHARED_OVERLAP = 0.3
# Added to a detection's IoU with the last box to give its weight.
STRANGER_WEIGHT = 0.1
# An edge this near to the view's border counts as cut off, pixels, and the factor on its expected error.
BORDER_PX, CUT_DOUBT = 1.0, 3.0
# Margins around a step's box within which points are kept: share of its mean side, and, for the detector's inaccuracy,
# share of the view's extent.
KEEP_MARGIN, KEEP_MARGIN_VIEW = 0.03, 0.04
# Silhouettes: a hypothesis with less than this share of the median point count is discarded; margin within which points
# count as inside, share of the box's size.
WHOLE_SHARE, SILHOUETTE_MARGIN = 0.95, 0.03
# Expected error of the faces of a warm start's box, share of its mean side; a smaller value raises its weight.
START_DOUBT = 0.05


@dataclass(frozen=True, eq=False)
class Pair:
    """The 3D box that a front and a side detection give.

    Attributes:
        axes: rows = axes of the front view.
        spans_m: low and high end along each of them.
        shared_overlap: 1D IoU of the two detections along their shared axis.
        disagreement: mean difference of their ends along it, relative to the fused length.
        score: geometric mean of the detections' scores.
    """

    axes: Float64[np.ndarray, "3 3"]
    spans_m: Float64[np.ndarray, "3 2"]
    shared_overlap: float
    disagreement: float
    score: float

    @cached_property
    def box(self) -> OrientedBox:
        return span_box(self.axes, self.spans_m)


def span_box(axes: Float64[np.ndarray, "3 3"], spans_m: Float64[np.ndarray, "3 2"]) -> OrientedBox:
    """The box that spans (low, high) metres along each row of `axes`."""
    rotation = axes.T
    center = rotation @ spans_m.mean(axis=1)
    size = np.maximum(spans_m[:, 1] - spans_m[:, 0], 1e-4)
    return OrientedBox.from_parts(center, rotation, size)


def make_pair(views: Sequence[PseudoView], front: Box2D, side: Box2D) -> Pair:
    """Fuses the detections on a front and its side view; their shared intervals are averaged, weighted by score."""
    across, shared_front = views[0].interval_m(front)
    depth, shared_side = views[1].interval_m(side)
    weight = front.score / max(front.score + side.score, 1e-9)
    shared = weight * shared_front + (1 - weight) * shared_side
    (low_a, high_a), (low_b, high_b) = shared_front, shared_side
    both = max(min(high_a, high_b) - max(low_a, low_b), 0.0)
    overlap = float(both / max(max(high_a, high_b) - min(low_a, low_b), 1e-12))
    disagreement = float(np.abs(shared_front - shared_side).mean() / max(shared[1] - shared[0], 1e-9))
    spans = np.stack([across, shared, depth])
    return Pair(views[0].axes, spans, overlap, disagreement, float(np.sqrt(front.score * side.score)))


def of_class(boxes: Sequence[Box2D], detected: str, label: str, min_score: float) -> tuple[Box2D, ...]:
    """The detections of a class of the detector, under the name of the object's class.

    Args:
        detected: the detector's class; differs from `label` for class-agnostic detectors.
        min_score: boxes with a lower score are left out.
    """
    chosen = (box for box in boxes if box.label == detected and box.score >= min_score)
    return tuple(chosen if detected == label else (replace(box, label=label) for box in chosen))


def measured_intervals(views: Sequence[PseudoView], boxes: Sequence[Box2D]) -> Intervals:
    """The intervals that detections measure along their views' x and y axes, two per view."""
    # dimensions of the arrays: view, axis, end
    metres_per_px = np.array([view.metres_per_px for view in views])[:, None, None]
    origins_m = np.array([view.origin_m for view in views])[:, :, None]
    sizes_px = np.array([view.rgb.shape[1::-1] for view in views])[:, :, None]
    edges_px = np.array([(box.x_min, box.x_max, box.y_min, box.y_max) for box in boxes]).reshape(-1, 2, 2)
    scores = np.array([max(box.score, LEAST_SCORE) for box in boxes])[:, None, None]
    is_cut = np.array([cut_edges(view, box) for view, box in zip(views, boxes, strict=True)])
    noise_m = EDGE_NOISE * (sizes_px * metres_per_px) / np.sqrt(scores)
    is_cut = is_cut.reshape(-1, 2, 2)
    # a cut-off edge is only a bound, so its expected error is larger
    sigma_m = noise_m * np.where(is_cut, CUT_DOUBT, 1.0)
    # NaN where the detector does not tell
    told_px = np.array([box.edge_sigma_px or (np.nan,) * 4 for box in boxes])[:, [0, 2, 1, 3]].reshape(-1, 2, 2)
    sigma_m = np.where(is_cut | np.isnan(told_px), sigma_m, told_px * metres_per_px)
    directions = np.concatenate([view.axes[:2] for view in views])
    return Intervals(directions, (origins_m + edges_px * metres_per_px).reshape(-1, 2), sigma_m.reshape(-1, 2))


def traced_intervals(trace: Sequence[StepTrace]) -> Intervals | None:
    """The intervals that the used detections of a trace measured; None without any."""
    views, boxes = [], []
    for step in trace:
        for view in step.views:
            if view.used is not None:
                blank = np.zeros((view.height_px, view.width_px, 3), np.uint8)
                none = np.zeros((0, 3), np.float32)
                views.append(PseudoView(blank, np.array(view.axes), view.metres_per_px, np.array(view.origin_m), none))
                boxes.append(view.boxes[view.used])
    return measured_intervals(views, boxes) if views else None


def cut_edges(view: PseudoView, box: Box2D) -> tuple[bool, bool, bool, bool]:
    """Which edges of a box lie on the view's border: left, right, top, bottom."""
    height_px, width_px = view.rgb.shape[:2]
    near, right, bottom = BORDER_PX - 0.5, width_px - 0.5 - BORDER_PX, height_px - 0.5 - BORDER_PX
    return bool(box.x_min <= near), bool(box.x_max >= right), bool(box.y_min <= near), bool(box.y_max >= bottom)


def cut_margin_m(box: OrientedBox, views: Sequence[PseudoView]) -> float:
    """The margin around a step's box within which points are kept, metres: a share of the box and of the views."""
    extent = max(max(view.rgb.shape[:2]) * view.metres_per_px for view in views)
    return KEEP_MARGIN * float(box.size_m.mean()) + KEEP_MARGIN_VIEW * extent


UNDETERMINED = "consensus: the measured intervals do not determine a box"


@dataclass(frozen=True, eq=False)
class Measurement:
    """The result of a step's detections.

    Attributes:
        box: the step's box, axes in any order.
        disagreement: see `Quality.view_disagreement`.
        score: mean score of the detections used.
        used: per view, the index of the detection that was used.
        cut: whether a used detection touches the border of its view.
        fit: the fit that gave the box; None for a pair of views.
    """

    box: OrientedBox
    axes: Float64[np.ndarray, "3 3"]
    disagreement: float
    score: float
    used: tuple[int | None, ...]
    intervals: Intervals | None = None
    fallback: tuple[str, ...] = ()
    cut: bool = False
    fit: BoxFit | None = None


def choose_all(
    views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], last: OrientedBox | None
) -> tuple[int | None, ...]:
    """On each view, the detection that continues an object: that with the best score times agreement with its last box.

    Indices into `boxes`; None on views without detections. Without a last box, only the scores are compared.
    """
    corners = None if last is None else box_corners(last)
    chosen: list[int | None] = []
    for view, on_view in zip(views, boxes, strict=True):
        rank = np.array([box.score for box in on_view])
        if corners is not None and len(on_view) > 1:
            along = corners @ view.axes[:2].T
            expected = view.box_px(np.stack([along.min(axis=0), along.max(axis=0)], axis=1), on_view[0].label)
            rank = rank * (STRANGER_WEIGHT + np.array([box_iou(box, expected) for box in on_view]))
        chosen.append(int(np.argmax(rank)) if len(on_view) else None)
    return tuple(chosen)


def measure_objects(
    views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], cloud: PointCloud
) -> list[Measurement]:
    """The pairs of several objects in one frustum, best first; each detection is used at most once.

    Objects on the same floor overlap on the shared axis even in wrong pairs. So a pair is also ranked by its support:
    the IoU of the sets of points in its front box and in its side box.
    """
    along = cloud.xyz_m @ views[0].axes.T.astype(np.float32)
    ranked: list[tuple[float, Pair, tuple[int, int]]] = []
    for used in product(*(range(len(on_view)) for on_view in boxes)):
        pair = make_pair(views, boxes[0][used[0]], boxes[1][used[1]])
        if pair.shared_overlap < MIN_SHARED_OVERLAP:
            continue
        low, high = (pair.spans_m + cut_margin_m(pair.box, views) * np.array([-1.0, 1.0])).T.astype(np.float32)
        across, shared, depth = ((along >= low) & (along <= high)).T
        in_both = np.count_nonzero(across & shared & depth)
        if in_both:
            support = in_both / np.count_nonzero(shared & (across | depth))
            ranked.append((support * pair.shared_overlap * pair.score, pair, (used[0], used[1])))
    ranked.sort(key=lambda item: -item[0])
    chosen: list[tuple[Pair, tuple[int, int]]] = []
    for _, pair, (front, side) in ranked:
        if len(chosen) < MOST_OBJECTS and all(front != used[0] and side != used[1] for _, used in chosen):
            chosen.append((pair, (front, side)))
    return [_of_pair(pair, used, any_cut(views, boxes, used)) for pair, used in chosen]


def measure_pair(
    views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], last: OrientedBox | None
) -> Measurement | None:
    """The paper's step: a pair of one front and one side detection; None if a view has none."""
    used = choose_all(views, boxes, last)
    pairs = _pairs(views, boxes, used)
    return _of_pair(pairs[0], used, any_cut(views, boxes, used)) if pairs else None


def measure_consensus(
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    last: OrientedBox | None,
    earlier: Intervals | None,
    up: Float64[np.ndarray, "3"] | None,
    start_box: OrientedBox | None = None,
    bounds: Intervals | None = None,
) -> Measurement | None:
    """The box fitted to the intervals of all detections, of this and earlier steps.

    Args:
        start_box: the box of a warm start; used as an additional measurement of low weight.
        bounds: further intervals for the fit, which later steps do not inherit.

    Returns:
        the fit, or the pair of least volume if the intervals do not determine a box; None without detections.
    """
    used = choose_all(views, boxes, last)
    detected = [(view, on_view[i]) for view, on_view, i in zip(views, boxes, used, strict=True) if i is not None]
    if not detected:
        return None
    parts = [measured_intervals([view for view, _ in detected], [box for _, box in detected])]
    if start_box is not None:
        parts.append(_start_intervals(start_box, parts[0]))
    intervals = Intervals.concatenate(parts if earlier is None else [earlier, *parts])
    known = intervals if bounds is None else Intervals.concatenate([intervals, bounds])
    fit = fit_box(known, up, None if last is None else last.rotation)
    if fit is None:
        return _least_volume(_pairs(views, boxes, used), used, intervals, UNDETERMINED)
    box = OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m)
    score = float(np.mean([b.score for _, b in detected])) * len(detected) / len(views)
    spread = fit.residual_m / float(box.size_m.mean())
    is_cut = any_cut(views, boxes, used)
    return Measurement(box, fit.rotation.T, spread, score, used, intervals, cut=is_cut, fit=fit)


def _start_intervals(start_box: OrientedBox, measured: Intervals) -> Intervals:
    """The start box as three intervals around the centre of the measured intervals.

    It stabilises sides that the few views of a warm start measure inaccurately.
    """
    center = np.linalg.lstsq(measured.directions, measured.ends_m.mean(axis=1), rcond=None)[0]
    axes, half = start_box.rotation.T, start_box.size_m / 2
    ends = (axes @ center)[:, None] + np.stack([-half, half], axis=1)
    return Intervals(axes, ends, np.full((3, 2), START_DOUBT * float(start_box.size_m.mean())))


def _pairs(views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], used: Sequence[int | None]) -> list[Pair]:
    """The pairs of the front and side views that both have a detection."""
    detected = [None if i is None else on_view[i] for on_view, i in zip(boxes, used, strict=True)]
    steps = ((views[k : k + 2], detected[k], detected[k + 1]) for k in range(0, len(views), 2))
    return [make_pair(two, front, side) for two, front, side in steps if front is not None and side is not None]


def _of_pair(
    pair: Pair, used: tuple[int | None, ...], cut: bool, intervals: Intervals | None = None, *fallback: str
) -> Measurement:
    return Measurement(pair.box, pair.axes, pair.disagreement, pair.score, used, intervals, fallback, cut)


def any_cut(views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], used: Sequence[int | None]) -> bool:
    """True if a used detection touches the border of its view."""
    return any(
        i is not None and any(cut_edges(view, on_view[i])) for view, on_view, i in zip(views, boxes, used, strict=True)
    )


def _least_volume(
    pairs: Sequence[Pair], used: tuple[int | None, ...], intervals: Intervals | None = None, *fallback: str
) -> Measurement | None:
    best = min(pairs, key=lambda pair: pair.box.volume_m3, default=None)
    return None if best is None else _of_pair(best, used, False, intervals, *fallback)


def measure_tightest(
    views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], last: OrientedBox | None, cloud: PointCloud
) -> Measurement | None:
    """The pair of least volume among the hypotheses, because silhouettes fit tightly only along the object's axes.

    If detections miss a part of the object, their hypothesis is too small. So hypotheses that contain clearly fewer
    points than the median are discarded.
    """
    used = choose_all(views, boxes, last)
    pairs = _pairs(views, boxes, used)
    if not pairs:
        return None
    margin = SILHOUETTE_MARGIN * float(np.median([pair.box.size_m.mean() for pair in pairs]))
    inside = np.array([contains(pair.box, cloud.xyz_m, margin).sum() for pair in pairs])
    whole = [pair for pair, points in zip(pairs, inside, strict=True) if points >= WHOLE_SHARE * np.median(inside)]
    return _least_volume(whole, used)
