"""Fully oriented boxes against truth: exact-IoU average precision, mean IoU, points inside."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import linear_sum_assignment

from annotator.geometry.iou import iou_3d_matrix
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
    if result.boxes and result.truth:
        matrix = iou_3d_matrix(result.truth, result.boxes)
        rows, columns = linear_sum_assignment(-matrix)
        ious[rows] = matrix[rows, columns]
    return ious


def average_precision(results: Sequence[FrameResult], iou_threshold: float) -> float:
    """Area under the precision envelope (PASCAL VOC 2010 on), with exact oriented 3D IoU.

    All frames are pooled; detections in descending score each look at the true box of their frame that they overlap
    most, taken or not; a hit needs IoU above the threshold and a box not yet taken. A detection whose box is one that
    is ignored, with IoU above the threshold, does not count.

    Returns:
        0..1; NaN where there is no true box.
    """
    total = sum(len(result.truth) for result in results)
    if total == 0:
        return float("nan")
    rows = [(score, frame, index) for frame, result in enumerate(results) for index, score in enumerate(result.scores)]
    known = [[*result.truth, *result.ignored] for result in results]
    matrices = {i: iou_3d_matrix(r.boxes, known[i]) for i, r in enumerate(results) if r.boxes and known[i]}
    taken: dict[int, set[int]] = defaultdict(set)
    hits: list[int] = []
    for _, frame, index in sorted(rows, key=lambda row: (-row[0], row[1], row[2])):
        best, iou = _best(matrices[frame][index]) if frame in matrices else (0, 0.0)
        if iou > iou_threshold and best >= len(results[frame].truth):
            continue
        hit = iou > iou_threshold and best not in taken[frame]
        hits.append(int(hit))
        if hit:
            taken[frame].add(best)
    found = np.cumsum(hits)
    recall = np.concatenate([[0.0], found / total, [1.0]])
    precision = np.concatenate([[0.0], found / np.arange(1, len(hits) + 1), [0.0]])
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(recall) * envelope[1:]))


def _best(ious: Float64[np.ndarray, "t"]) -> tuple[int, float]:
    place = int(np.argmax(ious))
    return place, float(ious[place])


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
