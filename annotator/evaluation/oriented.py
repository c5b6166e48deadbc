"""The protocol for oriented boxes: average precision with exact 3D IoU, mean IoU, pose errors, point masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import linear_sum_assignment

from annotator.evaluation.average_precision import PrecisionRecall, precision_recall
from annotator.evaluation.boxes import BoxPairs, BoxTable, overlapping
from annotator.evaluation.poses import pose_errors
from annotator.geometry.oriented_box import contains
from annotator.types import OrientedBox, PointCloud

THRESHOLDS = (0.25, 0.5, 0.7)
# Minimum IoU of pairs whose poses are compared; below it, angles are meaningless.
POSE_IOU = 0.25


@dataclass(frozen=True)
class OrientedClass:
    """The result of one class.

    Attributes:
        curves: by IoU threshold.
        objects, detections: number of true boxes and of detections.
        matched: number of assigned pairs with an IoU above `POSE_IOU`, whose poses were compared.
        mean_iou: mean over all true boxes, 0 for those without a detection.
        center_error_m, rotation_error_rad, size_error: means over the matched pairs (see `pose_errors`); NaN
            without pairs.
    """

    curves: Mapping[float, PrecisionRecall]
    objects: int
    detections: int
    matched: int
    mean_iou: float
    center_error_m: float
    rotation_error_rad: float
    size_error: float


@dataclass(frozen=True)
class OrientedResult:
    """The results of all classes with a true box."""

    classes: Mapping[str, OrientedClass]

    def mean(self, threshold: float) -> float:
        """Mean average precision over the classes, 0..1; NaN without classes."""
        areas = [one.curves[threshold].area for one in self.classes.values()]
        return float(np.mean(areas)) if areas else float("nan")


def evaluate_oriented(
    detections: BoxTable, truth: BoxTable, thresholds: Sequence[float] = THRESHOLDS
) -> OrientedResult:
    """Evaluates the detections of all frames, class by class."""
    labels = np.unique(truth.label).tolist()
    return OrientedResult(
        {label: _class(detections.of_class(label), truth.of_class(label), thresholds) for label in labels}
    )


def _class(detections: BoxTable, truth: BoxTable, thresholds: Sequence[float]) -> OrientedClass:
    pairs, counts = overlapping(detections, truth), np.ones(len(truth), bool)
    chosen = assigned(pairs, truth.frame)
    near = chosen.take(chosen.iou > POSE_IOU)
    errors = pose_errors(detections.take(near.detection), truth.take(near.truth))
    return OrientedClass(
        curves={threshold: precision_recall(detections.score, pairs, counts, threshold) for threshold in thresholds},
        objects=len(truth),
        detections=len(detections),
        matched=len(near.iou),
        mean_iou=float(chosen.iou.sum() / len(truth)),
        center_error_m=_mean(errors.center_m),
        rotation_error_rad=_mean(errors.rotation_rad),
        size_error=_mean(errors.size),
    )


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Detections and truth of one class in one frame.

    Attributes:
        boxes, scores: detections.
        truth: true boxes.
        ignored: true boxes that do not count, such as objects with too few points. Their detections are neither
            true nor false positives, as in KITTI's evaluation.
    """

    boxes: Sequence[OrientedBox]
    scores: Sequence[float]
    truth: Sequence[OrientedBox]
    ignored: Sequence[OrientedBox] = ()


def matched_ious(result: FrameResult) -> Float64[np.ndarray, "t"]:
    """The exact IoU of each true box with its detection; 0 without one.

    Detections are assigned to true boxes one to one, with the largest total IoU.
    """
    ious = np.zeros(len(result.truth))
    pairs = assigned(overlapping(_table([result.boxes]), _table([result.truth])), np.zeros(len(ious), np.int64))
    ious[pairs.truth] = pairs.iou
    return ious


def average_precision(results: Sequence[FrameResult], iou_threshold: float) -> float:
    """Average precision of one class with exact oriented 3D IoU, as in `annotator.evaluation.average_precision`.

    Returns:
        0..1; NaN without true boxes.
    """
    detections = _table([result.boxes for result in results])
    true_boxes = _table([[*result.truth, *result.ignored] for result in results])
    counts = [flag for r in results for flag in (*(True for _ in r.truth), *(False for _ in r.ignored))]
    if not any(counts):
        return float("nan")
    scores = np.array([score for result in results for score in result.scores], np.float64)
    pairs = overlapping(detections, true_boxes)
    return precision_recall(scores, pairs, np.array(counts, bool), iou_threshold).area


def assigned(pairs: BoxPairs, truth_frame: Int64[np.ndarray, "g"]) -> BoxPairs:
    """The pairs of the one-to-one assignment with the largest total IoU, per frame.

    Args:
        pairs: all overlapping pairs.
        truth_frame: the frame of each true box.
    """
    chosen = [np.zeros(0, np.int64)]
    order = np.argsort(truth_frame[pairs.truth], kind="stable")
    starts = np.flatnonzero(np.diff(truth_frame[pairs.truth[order]])) + 1
    for in_frame in np.split(order, starts):
        _, rows = np.unique(pairs.detection[in_frame], return_inverse=True)
        _, columns = np.unique(pairs.truth[in_frame], return_inverse=True)
        shape = (rows.max(initial=-1) + 1, columns.max(initial=-1) + 1)
        iou, pair = np.zeros(shape), np.full(shape, -1)
        iou[rows, columns], pair[rows, columns] = pairs.iou[in_frame], in_frame
        matched = pair[linear_sum_assignment(-iou)]
        chosen.append(matched[matched >= 0])
    return pairs.take(np.concatenate(chosen))


def _table(boxes: Sequence[Sequence[OrientedBox]]) -> BoxTable:
    """A table of each frame's boxes, of one class."""
    return BoxTable.of((frame, "", box, 0.0) for frame, in_frame in enumerate(boxes) for box in in_frame)


@dataclass(frozen=True)
class MaskAgreement:
    """Agreement of the points inside boxes with a point mask.

    Attributes:
        recall: share of the mask's points that lie in a box.
        precision: share of the points in boxes that belong to the mask.
    """

    recall: float
    precision: float


def mask_agreement(boxes: Sequence[OrientedBox], cloud: PointCloud, of_object: Bool[np.ndarray, "n"]) -> MaskAgreement:
    """Compares the points inside any box with the points of an object; (0, 0) without boxes."""
    inside = np.zeros(len(cloud), bool)
    for box in boxes:
        inside |= contains(box, cloud.xyz_m)
    both = int((inside & of_object).sum())
    return MaskAgreement(both / max(int(of_object.sum()), 1), both / max(int(inside.sum()), 1))
