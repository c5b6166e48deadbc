"""Oriented boxes of a whole dataset as columns, and which of them overlap."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float64, Int, Int64, Shaped

from annotator.evaluation.pairs import pairs_within
from annotator.geometry.iou import intersection_volume_pairs
from annotator.types import OrientedBox

# Boxes looked at in one pass, so that memory does not grow with the dataset.
BLOCK = 20_000


@dataclass(frozen=True, eq=False)
class BoxTable:
    """Boxes of many frames, in any order of the frames.

    Attributes:
        frame: number of the frame, the same for detections and truth.
        label: class name.
        center, rotation, size: as of `OrientedBox`; of one frame all in the same frame of reference.
        score: of detections; any number, higher is surer.
    """

    frame: Int64[np.ndarray, "n"]
    label: Shaped[np.ndarray, "n"]
    center: Float64[np.ndarray, "n 3"]
    rotation: Float64[np.ndarray, "n 3 3"]
    size: Float64[np.ndarray, "n 3"]
    score: Float64[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rows: Shaped[np.ndarray, "k"]) -> BoxTable:
        """The rows of these numbers, or of this mask."""
        return BoxTable(*(getattr(self, column.name)[rows] for column in fields(self)))

    def of_class(self, label: str) -> BoxTable:
        """The boxes of one class."""
        return self.take(self.label == label)

    @property
    def volume_m3(self) -> Float64[np.ndarray, "n"]:
        return np.asarray(self.size.prod(axis=1))

    @classmethod
    def of(cls, rows: Iterable[tuple[int, str, OrientedBox, float]]) -> BoxTable:
        """From frame number, class, box and score of each."""
        frames, labels, boxes, scores = list(map(list, zip(*rows, strict=True))) or ([], [], [], [])
        poses = np.array([box.T_camera_box.as_matrix() for box in boxes]).reshape(-1, 4, 4)
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
    """The pairs of a detection and a true box of the same frame that overlap, ordered by detection.

    Attributes:
        detection, truth: row numbers.
        iou: exact 3D IoU, above 0.
    """

    detection: Int[np.ndarray, "p"]
    truth: Int[np.ndarray, "p"]
    iou: Float64[np.ndarray, "p"]

    def take(self, pairs: Shaped[np.ndarray, "k"]) -> BoxPairs:
        """The pairs of these numbers, or of this mask."""
        return BoxPairs(self.detection[pairs], self.truth[pairs], self.iou[pairs])

    def best(self) -> BoxPairs:
        """For each detection the true box that it overlaps most; of equal ones the first."""
        order = np.lexsort((self.truth, -self.iou, self.detection))
        _, first = np.unique(self.detection[order], return_index=True)
        return self.take(order[first])


def overlapping(detections: BoxTable, truth: BoxTable) -> BoxPairs:
    """The overlapping pairs of two tables, whatever their classes."""
    found = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for start in range(0, len(detections), BLOCK):
        rows, columns = pairs_within(detections.frame[start : start + BLOCK], truth.frame)
        rows += start
        near = _meet(detections, truth, rows, columns)
        rows, columns = rows[near], columns[near]
        iou = _iou(detections.take(rows), truth.take(columns))
        found.append((rows[iou > 0], columns[iou > 0], iou[iou > 0]))
    return BoxPairs(*map(np.concatenate, zip(*found, strict=True)))


def _meet(a: BoxTable, b: BoxTable, rows: Int[np.ndarray, "k"], columns: Int[np.ndarray, "k"]) -> Bool[np.ndarray, "k"]:
    """Whether the circumscribed spheres of chosen pairs meet."""
    reach = [0.5 * np.linalg.norm(table.size, axis=1) for table in (a, b)]
    apart = np.linalg.norm(a.center[rows] - b.center[columns], axis=1)
    return np.asarray(apart <= reach[0][rows] + reach[1][columns])


def _iou(a: BoxTable, b: BoxTable) -> Float64[np.ndarray, "k"]:
    inner = intersection_volume_pairs(a.center, a.rotation, a.size, b.center, b.rotation, b.size)
    return np.minimum(inner / (a.volume_m3 + b.volume_m3 - inner), 1.0)
