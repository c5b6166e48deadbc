"""Oriented boxes of a whole dataset as columns, and the pairs that overlap."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, Int, Int64, Shaped

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
