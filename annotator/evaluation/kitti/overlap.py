"""Overlap of detections with the true rows of their frame: on the image, in bird's-eye view and in 3D."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from annotator.evaluation.kitti.rows import KittiRows
from annotator.evaluation.pairs import pairs_within
from annotator.geometry.outline import rectangle_intersection_pairs

# Detections per pass, so that memory does not grow with the dataset.
BLOCK = 20_000


@dataclass(frozen=True, eq=False)
class Overlaps:
    """The overlapping pairs, ordered by detection and then by truth.

    Attributes:
        detection, truth: row indices.
        iou: of each pair, above 0.
    """

    detection: Int[np.ndarray, "p"]
    truth: Int[np.ndarray, "p"]
    iou: Float64[np.ndarray, "p"]


Measure = Callable[[KittiRows, KittiRows], Float64[np.ndarray, "p"]]


def overlaps_2d(detections: KittiRows, truth: KittiRows) -> Overlaps:
    """IoU of the 2D boxes; the width of a box is right - left, without an additional pixel."""
    return _overlaps(detections, truth, _iou_2d)


def overlaps_bev(detections: KittiRows, truth: KittiRows) -> Overlaps:
    """IoU of the ground rectangles: length x width in the x-z plane, rotated by rotation_y."""
    return _overlaps(detections, truth, _iou_bev)


def overlaps_3d(detections: KittiRows, truth: KittiRows) -> Overlaps:
    """IoU of the 3D boxes: intersection of the rectangles times that of the heights [y - h, y]; y points down."""
    return _overlaps(detections, truth, _iou_3d)


def covered_share(detections: KittiRows, areas: KittiRows) -> Float64[np.ndarray, "n"]:
    """The largest share of each detection's 2D box that one of the areas (DontCare) covers; not an IoU."""
    share = np.zeros(len(detections))
    for rows, columns in _blocks(detections, areas):
        a, b = detections.take(rows), areas.take(columns)
        inner, area = _intersection_2d(a, b), _area_2d(a)
        np.maximum.at(share, rows, np.divide(inner, area, out=np.zeros(len(area)), where=inner > 0))
    return share


def _overlaps(detections: KittiRows, truth: KittiRows, measure: Measure) -> Overlaps:
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for rows, columns in _blocks(detections, truth):
        iou = measure(detections.take(rows), truth.take(columns))
        keep = iou > 0
        parts.append((rows[keep], columns[keep], iou[keep]))
    return Overlaps(*map(np.concatenate, zip(*parts, strict=True)))


def _blocks(a: KittiRows, b: KittiRows) -> Iterator[tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]]:
    """All pairs of rows of the same frame, in blocks."""
    for start in range(0, len(a), BLOCK):
        rows, columns = pairs_within(a.frame[start : start + BLOCK], b.frame)
        yield rows + start, columns


def _iou_2d(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    inner = _intersection_2d(a, b)
    return _ratio(inner, _area_2d(a) + _area_2d(b) - inner)


def _intersection_2d(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    sides = np.minimum(a.edges[:, 2:], b.edges[:, 2:]) - np.maximum(a.edges[:, :2], b.edges[:, :2])
    return np.asarray(np.maximum(sides, 0.0).prod(axis=1))


def _area_2d(rows: KittiRows) -> Float64[np.ndarray, "n"]:
    return np.asarray((rows.edges[:, 2:] - rows.edges[:, :2]).prod(axis=1))


def _iou_bev(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    inner = _ground_intersection(a, b)
    return _ratio(inner, _ground(a).prod(axis=1) + _ground(b).prod(axis=1) - inner)


def _iou_3d(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    floor, roof = np.minimum(a.bottom[:, 1], b.bottom[:, 1]), np.maximum(_roof(a), _roof(b))
    inner = _ground_intersection(a, b) * np.maximum(floor - roof, 0.0)
    return _ratio(inner, a.size.prod(axis=1) + b.size.prod(axis=1) - inner)


def _roof(rows: KittiRows) -> Float64[np.ndarray, "n"]:
    return rows.bottom[:, 1] - rows.size[:, 0]


def _ground(rows: KittiRows) -> Float64[np.ndarray, "n 2"]:
    """Length and width."""
    return rows.size[:, [2, 1]]


def _ground_intersection(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    """Intersection areas of the ground rectangles; 0 if a row has no 3D box."""
    apart = np.hypot(*(a.bottom[:, [0, 2]] - b.bottom[:, [0, 2]]).T)
    reach = 0.5 * (np.hypot(*_ground(a).T) + np.hypot(*_ground(b).T))
    near = (apart < reach) & (a.size > 0).all(axis=1) & (b.size > 0).all(axis=1)
    areas = np.zeros(len(a))
    a, b = a.take(near), b.take(near)
    # with x to the right and z up, rotation_y is clockwise
    sides = [(rows.bottom[:, [0, 2]], -rows.rotation_y, _ground(rows)) for rows in (a, b)]
    areas[near] = rectangle_intersection_pairs(*sides[0], *sides[1])
    return areas


def _ratio(inner: Float64[np.ndarray, "p"], union: Float64[np.ndarray, "p"]) -> Float64[np.ndarray, "p"]:
    return np.divide(inner, union, out=np.zeros(len(inner)), where=inner > 0)
