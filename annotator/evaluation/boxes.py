"""Oriented boxes of a whole dataset: as columns, the pairs that overlap, and their protocol.

The protocol gives average precision with exact 3D IoU, mean IoU, and pose errors. Average precision is the area under
the precision envelope (PASCAL VOC since 2010), over all frames together. Detections are processed in order of
descending score. Each is compared only with the true box of its frame that it overlaps most. It is a true positive if
the IoU is above the threshold and the box has not been matched before. SUN RGB-D's benchmark is the same as in VoteNet
(`utils/eval_det.py`, area under the envelope).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, Int, Int64, Shaped
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import intersection_volume_pairs
from annotator.types import OrientedBox


def pairs_within(
    groups_a: Int[np.ndarray, "n"], groups_b: Int[np.ndarray, "m"]
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """All pairs of a row of one table and a row of the other in the same group, such as the same frame.

    Args:
        groups_a, groups_b: the group of each row, any integers.

    Returns:
        indices into both, ordered by the first and then by the second.
    """
    order = np.argsort(groups_b, kind="stable")
    ordered = groups_b[order]
    begin = np.searchsorted(ordered, groups_a, side="left")
    count = np.searchsorted(ordered, groups_a, side="right") - begin
    rows = np.repeat(np.arange(len(groups_a)), count)
    # the place of each pair among those of its row
    places = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    return rows, order[np.repeat(begin, count) + places]


# Detections per pass, so that memory does not grow with the dataset.
BLOCK = 20_000


def blocks_within(
    groups_a: Int[np.ndarray, "n"], groups_b: Int[np.ndarray, "m"]
) -> Iterator[tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]]:
    """Yields `pairs_within` in blocks of rows of the first table."""
    for start in range(0, len(groups_a), BLOCK):
        rows, columns = pairs_within(groups_a[start : start + BLOCK], groups_b)
        yield rows + start, columns


T = TypeVar("T", bound="Table")


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of many frames as columns.

    Attributes:
        frame: number of the frame, the same for detections and truth.
        label: class name.
    """

    frame: Int64[np.ndarray, "n"]
    label: Shaped[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.frame)

    def take(self: T, rows: Shaped[np.ndarray, "k"]) -> T:
        """The rows selected by indices or a mask."""
        return type(self)(*(getattr(self, column.name)[rows] for column in fields(self)))


@dataclass(frozen=True, eq=False)
class BoxTable(Table):
    """Boxes of many frames, in any order.

    Attributes:
        center, rotation, size: as in `OrientedBox`; all boxes of a frame in the same coordinates.
        score: of detections; any number, higher means more confident.
    """

    center: Float64[np.ndarray, "n 3"]
    rotation: Float64[np.ndarray, "n 3 3"]
    size: Float64[np.ndarray, "n 3"]
    score: Float64[np.ndarray, "n"]

    def of_class(self, label: str) -> BoxTable:
        """The boxes of one class."""
        return self.take(self.label == label)

    @property
    def volume_m3(self) -> Float64[np.ndarray, "n"]:
        return np.asarray(self.size.prod(axis=1))

    @classmethod
    def of(cls, rows: Iterable[tuple[int, str, OrientedBox, float]]) -> BoxTable:
        """A table from the frame number, class, box and score of each box."""
        frames, labels, boxes, scores = list(map(list, zip(*rows, strict=True))) or ([], [], [], [])
        poses = np.array([box.pose for box in boxes]).reshape(-1, 4, 4)
        return cls(
            np.array(frames, np.int64),
            np.array(labels, np.str_),
            poses[:, :3, 3],
            poses[:, :3, :3],
            np.array([box.size_m for box in boxes], np.float64).reshape(-1, 3),
            np.array(scores, np.float64),
        )


@dataclass(frozen=True, eq=False)
class BoxPairs:
    """The overlapping pairs of a detection and a true box of the same frame, ordered by detection.

    Attributes:
        detection, truth: row indices.
        iou: exact 3D IoU, above 0.
    """

    detection: Int[np.ndarray, "p"]
    truth: Int[np.ndarray, "p"]
    iou: Float64[np.ndarray, "p"]

    def take(self, pairs: Shaped[np.ndarray, "k"]) -> BoxPairs:
        """The pairs selected by indices or a mask."""
        return BoxPairs(self.detection[pairs], self.truth[pairs], self.iou[pairs])

    def best(self) -> BoxPairs:
        """For each detection, the pair with the largest IoU; for equal IoUs, the first true box."""
        order = np.lexsort((self.truth, -self.iou, self.detection))
        _, first = np.unique(self.detection[order], return_index=True)
        return self.take(order[first])


def overlapping(detections: T, truth: T, measure: Callable[[T, T], Float64[np.ndarray, "p"]]) -> BoxPairs:
    """The overlapping pairs of two tables, regardless of class.

    Args:
        measure: returns the IoU of the rows of two tables, pair by pair.
    """
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for rows, columns in blocks_within(detections.frame, truth.frame):
        iou = measure(detections.take(rows), truth.take(columns))
        parts.append((rows[iou > 0], columns[iou > 0], iou[iou > 0]))
    return BoxPairs(*map(np.concatenate, zip(*parts, strict=True)))


def exact_iou(a: BoxTable, b: BoxTable) -> Float64[np.ndarray, "k"]:
    """The 3D IoU of the boxes in the same rows."""
    reach = [0.5 * np.linalg.norm(table.size, axis=1) for table in (a, b)]
    # the circumscribed spheres intersect
    near = np.linalg.norm(a.center - b.center, axis=1) <= reach[0] + reach[1]
    iou = np.zeros(len(a))
    a, b = a.take(near), b.take(near)
    inner = intersection_volume_pairs(a.center, a.rotation, a.size, b.center, b.rotation, b.size)
    iou[near] = np.minimum(inner / (a.volume_m3 + b.volume_m3 - inner), 1.0)
    return iou


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall after each detection, in order of descending score; both 0..1."""

    recall: Float64[np.ndarray, "n"]
    precision: Float64[np.ndarray, "n"]

    @property
    def area(self) -> float:
        """Average precision, 0..1: the area under the envelope, the best precision at this or any higher recall."""
        recall = np.concatenate([[0.0], self.recall, [1.0]])
        precision = np.concatenate([[0.0], self.precision, [0.0]])
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        return float(np.sum(np.diff(recall) * envelope[1:]))

    @property
    def final_recall(self) -> float:
        """The share of the true boxes that were detected."""
        return float(self.recall[-1]) if len(self.recall) else 0.0


def precision_recall(
    score: Float64[np.ndarray, "d"], pairs: BoxPairs, objects: int, iou_threshold: float
) -> PrecisionRecall:
    """The curve of one class.

    Args:
        score: of each detection; equal scores are processed in the order of the rows.
        pairs: the overlapping pairs of detections and true boxes.
        objects: number of true boxes, at least 1.
        iou_threshold: a match needs a larger IoU.
    """
    best = pairs.best()
    best = best.take(best.iou > iou_threshold)
    target = np.full(len(score), -1)
    target[best.detection] = best.truth
    order = np.argsort(-score, kind="stable")
    target = target[order]
    hits = np.zeros(len(target), bool)
    hits[np.unique(target, return_index=True)[1]] = True
    hits &= target >= 0
    true_positives = np.cumsum(hits)
    return PrecisionRecall(true_positives / objects, true_positives / np.arange(1, len(hits) + 1))


# Labellings whose size misfit is within this factor of the best one are equivalent: a nearly square footprint looks the
# same after a quarter turn.
SAME_LENGTHS = 1.1

# The 24 labellings of a box's axes: which axis, with which sign, becomes x, y, z.
LABELLINGS = np.rint(Rotation.create_group("O").as_matrix())
LABELLINGS.flags.writeable = False


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """The errors of n pairs of a detection and a true box.

    Attributes:
        center_m: distance of the centres.
        rotation_rad: the smallest rotation that aligns the axes, 0..pi.
        size: mean of |length - true length| / true length over the three axes.
    """

    center_m: Float64[np.ndarray, "n"]
    rotation_rad: Float64[np.ndarray, "n"]
    size: Float64[np.ndarray, "n"]


def pose_errors(boxes: BoxTable, truth: BoxTable) -> PoseErrors:
    """Compares the i-th box with the i-th true box.

    24 labellings of the axes describe the same box. Among the labellings whose sizes fit the true ones best
    (within `SAME_LENGTHS`), the one with the smallest rotation counts. So front and back are equivalent, and length and
    width are equivalent if they are similar.
    """
    every = np.arange(len(boxes))
    sizes = np.abs(LABELLINGS).transpose(0, 2, 1)[:, None] @ boxes.size[None, :, :, None]
    share = sizes[..., 0] / truth.size
    misfit = np.abs(np.log(share)).max(axis=2)
    allowed = misfit <= misfit.min(axis=0) + np.log(SAME_LENGTHS)
    turned = np.swapaxes(truth.rotation, 1, 2) @ boxes.rotation @ LABELLINGS[:, None]
    # precise near 0, unlike the arc cosine of the trace
    chord = np.linalg.norm(turned - np.eye(3), axis=(2, 3)) / np.sqrt(8.0)
    angle = np.where(allowed, 2.0 * np.arcsin(np.minimum(chord, 1.0)), np.inf)
    # for equal rotations, the best sizes
    best = np.lexsort((misfit, np.round(angle, 9)), axis=0)[0]
    return PoseErrors(
        np.linalg.norm(boxes.center - truth.center, axis=1),
        angle[best, every],
        np.abs(share[best, every] - 1.0).mean(axis=1),
    )


THRESHOLDS, SUNRGBD_THRESHOLDS = (0.25, 0.5, 0.7), (0.15, 0.25, 0.5)
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
    """Evaluates the detections of all frames, class by class.

    VoteNet intersects upright boxes. The exact intersection used here gives the same result for them, and is also
    defined for tilted boxes.

    Args:
        detections: with scores; those in frames without a true box count as false positives.
    """
    labels = np.unique(truth.label).tolist()
    return OrientedResult(
        {label: _class(detections.of_class(label), truth.of_class(label), thresholds) for label in labels}
    )


def _class(detections: BoxTable, truth: BoxTable, thresholds: Sequence[float]) -> OrientedClass:
    pairs = overlapping(detections, truth, exact_iou)
    chosen = assigned(pairs, truth.frame)
    near = chosen.take(chosen.iou > POSE_IOU)
    errors = pose_errors(detections.take(near.detection), truth.take(near.truth))
    return OrientedClass(
        curves={
            threshold: precision_recall(detections.score, pairs, len(truth), threshold) for threshold in thresholds
        },
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
