"""The box of a step from the detections on its views: from a pair, the consensus of all, or the tightest pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv.config import RcvConfig
from annotator.rcv.cross_view import Pair, choose, cut_edges, make_pair, measured_intervals
from annotator.rcv.interval_fit import BoxFit, Intervals, fit_box
from annotator.types import Box2D, OrientedBox, PointCloud, PseudoView

UNDETERMINED = "consensus: the measured intervals do not determine a box"


@dataclass(frozen=True, eq=False)
class Measurement:
    """The result of a step's detections.

    Attributes:
        box: the step's box, axes in any order.
        axes: rows = the axes of the step.
        disagreement: see `Quality.view_disagreement`.
        score: mean score of the detections used.
        used: per view, the index of the detection that was used.
        intervals: all intervals measured of the object so far.
        fallback: what failed before, with the reason.
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
    views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], last: OrientedBox | None, config: RcvConfig
) -> tuple[int | None, ...]:
    """The detection on each view that continues the last box, see `choose`."""
    corners = None if last is None else box_corners(last)
    return tuple(choose(view, on_view, corners, config) for view, on_view in zip(views, boxes, strict=True))


def measure_pair(
    axes: Float64[np.ndarray, "3 3"],
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    last: OrientedBox | None,
    config: RcvConfig,
) -> Measurement | None:
    """The paper's step: a pair of one front and one side detection; None if a view has none."""
    front, side = choose_all(views, boxes, last, config)
    if front is None or side is None:
        return None
    pair = make_pair(axes, (views[0], views[1]), boxes[0], boxes[1], front, side)
    used = (front, side)
    return Measurement(pair.box, axes, pair.disagreement, pair.score, used, cut=any_cut(views, boxes, used, config))


def measure_consensus(
    axes: Sequence[Float64[np.ndarray, "3 3"]],
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    last: OrientedBox | None,
    earlier: Intervals | None,
    up: Float64[np.ndarray, "3"] | None,
    config: RcvConfig,
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
    used = choose_all(views, boxes, last, config)
    detected = [(view, on_view[i]) for view, on_view, i in zip(views, boxes, used, strict=True) if i is not None]
    if not detected:
        return None
    parts = [measured_intervals([view for view, _ in detected], [box for _, box in detected], config)]
    if start_box is not None:
        parts.append(_start_intervals(start_box, parts[0], config))
    intervals = Intervals.concatenate(parts if earlier is None else [earlier, *parts])
    known = intervals if bounds is None else Intervals.concatenate([intervals, bounds])
    fit = fit_box(known, up, None if last is None else last.rotation, config.fit)
    if fit is None:
        pairs = _pairs(axes, views, boxes, used)
        return _least_volume(pairs, used, intervals, (UNDETERMINED,))
    box = OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m)
    score = float(np.mean([b.score for _, b in detected])) * len(detected) / len(views)
    spread = fit.residual_m / float(box.size_m.mean())
    is_cut = any_cut(views, boxes, used, config)
    return Measurement(box, fit.rotation.T, spread, score, used, intervals, cut=is_cut, fit=fit)


def _start_intervals(start_box: OrientedBox, measured: Intervals, config: RcvConfig) -> Intervals:
    """The start box as three intervals around the centre of the measured intervals.

    It stabilises sides that the few views of a warm start measure inaccurately.
    """
    center = np.linalg.lstsq(measured.directions, measured.ends_m.mean(axis=1), rcond=None)[0]
    axes, half = start_box.rotation.T, start_box.size_m / 2
    ends = (axes @ center)[:, None] + np.stack([-half, half], axis=1)
    return Intervals(axes, ends, np.full((3, 2), config.warm.seed_doubt * float(start_box.size_m.mean())))


def _pairs(
    axes: Sequence[Float64[np.ndarray, "3 3"]],
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    used: Sequence[int | None],
) -> list[Pair]:
    pairs = []
    for k, rows in enumerate(axes):
        front, side = used[2 * k], used[2 * k + 1]
        if front is not None and side is not None:
            two = (views[2 * k], views[2 * k + 1])
            pairs.append(make_pair(rows, two, boxes[2 * k], boxes[2 * k + 1], front, side))
    return pairs


def any_cut(
    views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], used: Sequence[int | None], config: RcvConfig
) -> bool:
    """True if a used detection touches the border of its view."""
    return any(
        i is not None and any(cut_edges(view, on_view[i], config))
        for view, on_view, i in zip(views, boxes, used, strict=True)
    )


def _least_volume(
    pairs: Sequence[Pair],
    used: tuple[int | None, ...],
    intervals: Intervals | None,
    fallback: tuple[str, ...] = (),
) -> Measurement | None:
    if not pairs:
        return None
    best = min(pairs, key=lambda pair: pair.box.volume_m3)
    return Measurement(best.box, best.axes, best.disagreement, best.score, used, intervals, fallback)


def measure_tightest(
    axes: Sequence[Float64[np.ndarray, "3 3"]],
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    last: OrientedBox | None,
    cloud: PointCloud,
    config: RcvConfig,
) -> Measurement | None:
    """The pair of least volume among the hypotheses, because silhouettes fit tightly only along the object's axes.

    If detections miss a part of the object, their hypothesis is too small. So hypotheses that contain clearly fewer
    points than the median are discarded.
    """
    used = choose_all(views, boxes, last, config)
    pairs = _pairs(axes, views, boxes, used)
    if not pairs:
        return None
    margin = config.consensus.silhouette_margin * float(np.median([pair.box.size_m.mean() for pair in pairs]))
    inside = np.array([contains(pair.box, cloud.xyz_m, margin).sum() for pair in pairs])
    whole = [
        pair
        for pair, points in zip(pairs, inside, strict=True)
        if points >= config.consensus.whole_share * np.median(inside)
    ]
    return _least_volume(whole, used, None)
