"""Fully oriented boxes against truth, a few frames at a time: average precision, mean IoU, points inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import linear_sum_assignment

from annotator.evaluation.average_precision import precision_recall
from annotator.evaluation.boxes import BoxPairs, BoxTable, overlapping
from annotator.geometry.oriented_box import contains
from annotator.types import OrientedBox, PointCloud


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Detections and truth of one class in one frame.

    Attributes:
        boxes, scores: what was proposed.
        truth: what is there and shall be found.
        ignored: what is there, too, but cannot be asked for, as with too few points; to find it is neither right nor
            wrong, as in KITTI's own evaluation.
    """

    boxes: Sequence[OrientedBox]
    scores: Sequence[float]
    truth: Sequence[OrientedBox]
    ignored: Sequence[OrientedBox] = ()


def matched_ious(result: FrameResult) -> Float64[np.ndarray, "t"]:
    """The exact IoU of each true box with the proposal assigned to it (best total, one to one); 0 where none is."""
    ious = np.zeros(len(result.truth))
    pairs = assigned(overlapping(_table([result.boxes]), _table([result.truth])), np.zeros(len(ious), np.int64))
    ious[pairs.truth] = pairs.iou
    return ious


def average_precision(results: Sequence[FrameResult], iou_threshold: float) -> float:
    """Average precision of one class with exact oriented 3D IoU, as in `annotator.evaluation.average_precision`.

    A detection whose box is one that is ignored, with IoU above the threshold, does not count.

    Returns:
        0..1; NaN where there is no true box.
    """
    detections = _table([result.boxes for result in results])
    known = _table([[*result.truth, *result.ignored] for result in results])
    counts = [flag for r in results for flag in (*(True for _ in r.truth), *(False for _ in r.ignored))]
    if not any(counts):
        return float("nan")
    scores = np.array([score for result in results for score in result.scores], np.float64)
    pairs = overlapping(detections, known)
    return precision_recall(scores, pairs, np.array(counts, bool), iou_threshold).area


def assigned(pairs: BoxPairs, truth_frame: Int64[np.ndarray, "g"]) -> BoxPairs:
    """Of the pairs that overlap those that are assigned to each other: one to one, the most IoU in total, per frame.

    Args:
        pairs: what overlaps.
        truth_frame: the frame of each true box.
    """
    chosen = [np.zeros(0, np.int64)]
    order = np.argsort(truth_frame[pairs.truth], kind="stable")
    starts = np.flatnonzero(np.diff(truth_frame[pairs.truth[order]])) + 1
    for own in np.split(order, starts):
        _, rows = np.unique(pairs.detection[own], return_inverse=True)
        _, columns = np.unique(pairs.truth[own], return_inverse=True)
        shape = (rows.max(initial=-1) + 1, columns.max(initial=-1) + 1)
        iou, place = np.zeros(shape), np.full(shape, -1)
        iou[rows, columns], place[rows, columns] = pairs.iou[own], own
        found = place[linear_sum_assignment(-iou)]
        chosen.append(found[found >= 0])
    return pairs.take(np.concatenate(chosen))


def _table(boxes: Sequence[Sequence[OrientedBox]]) -> BoxTable:
    """The boxes of each frame, of one class."""
    return BoxTable.of((frame, "", box, 0.0) for frame, own in enumerate(boxes) for box in own)


@dataclass(frozen=True)
class MaskAgreement:
    """How well boxes hold the points of a mask, points inside boxes grown by nothing.

    Attributes:
        recall: share of the mask's points that lie in a box.
        precision: share of the boxes' points that are of the mask.
    """

    recall: float
    precision: float


def mask_agreement(boxes: Sequence[OrientedBox], cloud: PointCloud, of_object: Bool[np.ndarray, "n"]) -> MaskAgreement:
    """Compares the points inside any box with the points that belong to the object; (0, 0) without a box."""
    inside = np.zeros(len(cloud), bool)
    for box in boxes:
        inside |= contains(box, cloud.xyz_m)
    both = int((inside & of_object).sum())
    return MaskAgreement(both / max(int(of_object.sum()), 1), both / max(int(inside.sum()), 1))
