"""From the detections of one step's views to one box: a pair, the consensus of all, or the tightest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv import cross_view
from annotator.rcv.config import RcvConfig
from annotator.rcv.interval_fit import Intervals, fit_box
from annotator.types import Box2D, OrientedBox, PointCloud, PseudoView

UNFIXED = "consensus: the measured intervals fix no box"


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a step measured.

    Attributes:
        box: the step's box, axes in any order.
        frame: rows, the axes that count as the step's.
        disagreement: see `Quality.view_disagreement`.
        score: mean score of the detections used.
        used: per view, which detection was used.
        intervals: everything measured of the object so far.
        fallback: what was tried first and could not be used, with the reason.
        cut: a used detection touches the border of its picture.
    """

    box: OrientedBox
    frame: Float64[np.ndarray, "3 3"]
    disagreement: float
    score: float
    used: tuple[int | None, ...]
    intervals: Intervals | None = None
    fallback: tuple[str, ...] = ()
    cut: bool = False


def choose_all(
    views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], last: OrientedBox | None, config: RcvConfig
) -> tuple[int | None, ...]:
    """For each view the one detection that continues the last box."""
    corners = None if last is None else box_corners(last)
    return tuple(cross_view.choose(view, found, corners, config) for view, found in zip(views, boxes, strict=True))


def measure_pair(
    frame: Float64[np.ndarray, "3 3"],
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    last: OrientedBox | None,
    config: RcvConfig,
) -> Measurement | None:
    """The paper's step: one front and one side detection; None where a view has none."""
    front, side = choose_all(views, boxes, last, config)
    if front is None or side is None:
        return None
    pair = cross_view.make_pair(frame, (views[0], views[1]), boxes[0], boxes[1], front, side)
    used = (front, side)
    return Measurement(pair.box, frame, pair.disagreement, pair.score, used, cut=any_cut(views, boxes, used, config))


def measure_consensus(
    frames: Sequence[Float64[np.ndarray, "3 3"]],
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    last: OrientedBox | None,
    earlier: Intervals | None,
    up: Float64[np.ndarray, "3"] | None,
    config: RcvConfig,
    seed: OrientedBox | None = None,
) -> Measurement | None:
    """One box through the intervals of all views with a detection, and of the steps before.

    Args:
        seed: a box that the object had a moment ago, which counts as a weak measurement.

    None where no view has a detection; the least-volume pair where the intervals do not fix a box.
    """
    used = choose_all(views, boxes, last, config)
    seen = [(view, found[i]) for view, found, i in zip(views, boxes, used, strict=True) if i is not None]
    if not seen:
        return None
    parts = [cross_view.measured_intervals([view for view, _ in seen], [box for _, box in seen], config)]
    if seed is not None:
        parts.append(_remembered(seed, parts[0], config))
    intervals = Intervals.concatenate(parts if earlier is None else [earlier, *parts])
    fit = fit_box(intervals, up, None if last is None else last.rotation, config.fit)
    if fit is None:
        pairs = _pairs(frames, views, boxes, used)
        return _least_volume(pairs, used, intervals, (UNFIXED,))
    box = OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m)
    score = float(np.mean([b.score for _, b in seen])) * len(seen) / len(views)
    spread = fit.residual_m / float(box.size_m.mean())
    return Measurement(box, fit.rotation.T, spread, score, used, intervals, cut=any_cut(views, boxes, used, config))


def _remembered(seed: OrientedBox, seen: Intervals, config: RcvConfig) -> Intervals:
    """The seed as a measurement, put where the middles of the measured intervals say that the object is now.

    A few views leave a side that they see badly open to their errors; a box of the moment before knows it better.
    """
    center = np.linalg.lstsq(seen.directions, seen.ends_m.mean(axis=1), rcond=None)[0]
    axes = seed.rotation.T
    ends = (axes @ center)[:, None] + np.stack([-seed.size_m / 2, seed.size_m / 2], axis=1)
    return Intervals(axes, ends, np.full((3, 2), config.warm.seed_doubt * float(seed.size_m.mean())))


def _pairs(
    frames: Sequence[Float64[np.ndarray, "3 3"]],
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    used: Sequence[int | None],
) -> list[cross_view.Pair]:
    pairs = []
    for k, frame in enumerate(frames):
        front, side = used[2 * k], used[2 * k + 1]
        if front is not None and side is not None:
            two = (views[2 * k], views[2 * k + 1])
            pairs.append(cross_view.make_pair(frame, two, boxes[2 * k], boxes[2 * k + 1], front, side))
    return pairs


def any_cut(
    views: Sequence[PseudoView], boxes: Sequence[Sequence[Box2D]], used: Sequence[int | None], config: RcvConfig
) -> bool:
    """True where a used detection touches the border of its picture."""
    return any(
        i is not None and any(cross_view.cut_edges(view, found[i], config))
        for view, found, i in zip(views, boxes, used, strict=True)
    )


def _least_volume(
    pairs: Sequence[cross_view.Pair],
    used: tuple[int | None, ...],
    intervals: Intervals | None,
    fallback: tuple[str, ...] = (),
) -> Measurement | None:
    if not pairs:
        return None
    best = min(pairs, key=lambda pair: pair.box.volume_m3)
    return Measurement(best.box, best.frame, best.disagreement, best.score, used, intervals, fallback)


def measure_tightest(
    frames: Sequence[Float64[np.ndarray, "3 3"]],
    views: Sequence[PseudoView],
    boxes: Sequence[Sequence[Box2D]],
    last: OrientedBox | None,
    cloud: PointCloud,
    config: RcvConfig,
) -> Measurement | None:
    """The least-volume box among the hypotheses: silhouettes are narrower than the box off its own axes.

    A hypothesis whose detections missed a part of the object would win by being small; so those that hold clearly
    fewer points than most do not take part.
    """
    used = choose_all(views, boxes, last, config)
    pairs = _pairs(frames, views, boxes, used)
    if not pairs:
        return None
    margin = config.consensus.silhouette_margin * float(np.median([pair.box.size_m.mean() for pair in pairs]))
    held = np.array([contains(pair.box, cloud.xyz_m, margin).sum() for pair in pairs])
    whole = [
        pair
        for pair, points in zip(pairs, held, strict=True)
        if points >= config.consensus.whole_share * np.median(held)
    ]
    return _least_volume(whole, used, None)
