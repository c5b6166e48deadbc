"""Overlap of upright boxes: polygon clipping on the ground, and the overlap of heights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from annotator.geometry.transforms import right_handed_frame
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

# A box whose z axis leans further than this from the vertical is not upright.
MAX_TILT_RAD = 1e-3

CHUNK = 4096


def iou_upright(a: OrientedBox, b: OrientedBox, up: Float[np.ndarray, "3"]) -> float:
    """3D IoU of two upright boxes: the same as `iou_3d`, by another way.

    Args:
        a, b: boxes whose z axes are parallel or antiparallel to `up`.
        up: vector against gravity in the frame of the boxes; of any length.

    Raises:
        GeometryError: a box leans by more than `MAX_TILT_RAD`, or `up` is zero.
    """
    return float(iou_upright_matrix([a], [b], up)[0, 0])


def iou_bev(a: OrientedBox, b: OrientedBox, up: Float[np.ndarray, "3"]) -> float:
    """IoU of the ground rectangles of two upright boxes (bird's-eye view); arguments and errors as `iou_upright`."""
    return float(iou_bev_matrix([a], [b], up)[0, 0])


def iou_upright_matrix(
    boxes_a: Sequence[OrientedBox], boxes_b: Sequence[OrientedBox], up: Float[np.ndarray, "3"]
) -> Float64[np.ndarray, "n m"]:
    """`iou_upright` of every box of the first list with every box of the second."""
    a, b = _footprints(boxes_a, up), _footprints(boxes_b, up)
    rows, columns = _near(a, b)
    area = _intersection_areas(a, b, rows, columns)
    height = np.minimum(a.top[rows], b.top[columns]) - np.maximum(a.bottom[rows], b.bottom[columns])
    volume = area * np.maximum(height, 0.0)
    union = (a.area * (a.top - a.bottom))[rows] + (b.area * (b.top - b.bottom))[columns] - volume
    return _scattered(len(a.area), len(b.area), rows, columns, np.minimum(volume / union, 1.0))


def iou_bev_matrix(
    boxes_a: Sequence[OrientedBox], boxes_b: Sequence[OrientedBox], up: Float[np.ndarray, "3"]
) -> Float64[np.ndarray, "n m"]:
    """`iou_bev` of every box of the first list with every box of the second."""
    a, b = _footprints(boxes_a, up), _footprints(boxes_b, up)
    rows, columns = _near(a, b)
    area = _intersection_areas(a, b, rows, columns)
    union = a.area[rows] + b.area[columns] - area
    return _scattered(len(a.area), len(b.area), rows, columns, np.minimum(area / union, 1.0))


def rectangle_intersection_pairs(
    centers_a: Float64[np.ndarray, "n 2"],
    yaws_a_rad: Float64[np.ndarray, "n"],
    sizes_a: Float64[np.ndarray, "n 2"],
    centers_b: Float64[np.ndarray, "n 2"],
    yaws_b_rad: Float64[np.ndarray, "n"],
    sizes_b: Float64[np.ndarray, "n 2"],
) -> Float64[np.ndarray, "n"]:
    """Area of the intersection of rectangle a and rectangle b of each of n pairs.

    Args:
        centers_a, centers_b: in one plane.
        yaws_a_rad, yaws_b_rad: direction of the first side, from the plane's first axis towards its second.
        sizes_a, sizes_b: full lengths of the first and second side, positive.
    """
    a, b = _rectangles(centers_a, yaws_a_rad, sizes_a), _rectangles(centers_b, yaws_b_rad, sizes_b)
    every = np.arange(len(centers_a))
    return _intersection_areas(a, b, every, every)


@dataclass(frozen=True, eq=False)
class _Footprints:
    """Ground rectangles and heights of upright boxes; two axes on the ground, metres."""

    center: Float64[np.ndarray, "n 2"]
    along: Float64[np.ndarray, "n 2"]
    half: Float64[np.ndarray, "n 2"]
    bottom: Float64[np.ndarray, "n"]
    top: Float64[np.ndarray, "n"]

    @property
    def area(self) -> Float64[np.ndarray, "n"]:
        return 4.0 * self.half.prod(axis=1)


def _footprints(boxes: Sequence[OrientedBox], up: Float[np.ndarray, "3"]) -> _Footprints:
    frame = right_handed_frame(up, np.array([1.0, 0.0, 0.0]))
    centers = np.array([box.center_m for box in boxes]).reshape(-1, 3) @ frame
    axes = frame.T @ np.array([box.rotation for box in boxes]).reshape(-1, 3, 3)
    sizes = np.array([box.size_m for box in boxes]).reshape(-1, 3)
    # of the box's z axis: what lies on the ground against what lies along the vertical
    tilt = np.arctan2(np.linalg.norm(axes[:, 1:, 2], axis=1), np.abs(axes[:, 0, 2]))
    if (tilt > MAX_TILT_RAD).any():
        worst = int(tilt.argmax())
        raise GeometryError(
            f"box {worst} leans by {tilt[worst]:.4f} rad from the vertical; only boxes within {MAX_TILT_RAD} rad "
            "have an upright or bird's-eye overlap, use iou_3d"
        )
    along = axes[:, 1:, 0] / np.linalg.norm(axes[:, 1:, 0], axis=1, keepdims=True)
    half_height = 0.5 * sizes[:, 2]
    return _Footprints(
        centers[:, 1:], along, 0.5 * sizes[:, :2], centers[:, 0] - half_height, centers[:, 0] + half_height
    )


def _rectangles(
    centers: Float64[np.ndarray, "n 2"], yaws_rad: Float64[np.ndarray, "n"], sizes: Float64[np.ndarray, "n 2"]
) -> _Footprints:
    along = np.stack([np.cos(yaws_rad), np.sin(yaws_rad)], axis=1)
    flat = np.zeros(len(centers))
    return _Footprints(centers, along, 0.5 * sizes, flat, flat)


def _near(a: _Footprints, b: _Footprints) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """The pairs whose circumscribed circles meet."""
    apart = np.linalg.norm(a.center[:, None] - b.center[None], axis=2)
    reach = np.linalg.norm(a.half, axis=1)[:, None] + np.linalg.norm(b.half, axis=1)[None]
    rows, columns = np.nonzero(apart <= reach)
    return rows, columns


def _scattered(
    n: int, m: int, rows: Int[np.ndarray, "k"], columns: Int[np.ndarray, "k"], values: Float64[np.ndarray, "k"]
) -> Float64[np.ndarray, "n m"]:
    matrix = np.zeros((n, m))
    matrix[rows, columns] = values
    return matrix


def _intersection_areas(
    a: _Footprints, b: _Footprints, rows: Int[np.ndarray, "k"], columns: Int[np.ndarray, "k"]
) -> Float64[np.ndarray, "k"]:
    areas = np.zeros(len(rows))
    for start in range(0, len(rows), CHUNK):
        part = slice(start, start + CHUNK)
        corners = _corners_in(a, rows[part], b, columns[part])
        areas[part] = _clipped_areas(corners, b.half[columns[part]])
    return areas


def _corners_in(
    a: _Footprints, rows: Int[np.ndarray, "k"], b: _Footprints, columns: Int[np.ndarray, "k"]
) -> Float64[np.ndarray, "k 4 2"]:
    """Corners of the first rectangles, counter-clockwise, in the frames of the second."""
    x, origin = b.along[columns], b.center[columns]
    to_local = np.stack([x, np.stack([-x[:, 1], x[:, 0]], axis=1)], axis=1)
    length = a.along[rows] * a.half[rows, :1]
    width = np.stack([-a.along[rows, 1], a.along[rows, 0]], axis=1) * a.half[rows, 1:]
    around = np.stack([-length - width, length - width, length + width, width - length], axis=1)
    return (around + (a.center[rows] - origin)[:, None]) @ np.swapaxes(to_local, 1, 2)


def _clipped_areas(
    polygons: Float64[np.ndarray, "k v 2"], half: Float64[np.ndarray, "k 2"]
) -> Float64[np.ndarray, "k"]:
    """Areas of convex polygons clipped to rectangles around the origin."""
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            polygons = _clip(polygons, half[:, axis, None] - side * polygons[:, :, axis])
    following = np.roll(polygons, -1, axis=1)
    cross = polygons[..., 0] * following[..., 1] - polygons[..., 1] * following[..., 0]
    return np.maximum(0.5 * cross.sum(axis=1), 0.0)


def _clip(polygons: Float64[np.ndarray, "k v 2"], inside: Float64[np.ndarray, "k v"]) -> Float64[np.ndarray, "k w 2"]:
    """Each polygon cut along a line (Sutherland and Hodgman, 1974); `inside` is each corner's distance from it.

    Polygons with fewer corners than others repeat their last one; those with none become a point.
    """
    following, inside_next = np.roll(polygons, -1, axis=1), np.roll(inside, -1, axis=1)
    keep, crosses = inside >= 0, (inside >= 0) != (inside_next >= 0)
    share = np.where(crosses, inside / np.where(crosses, inside - inside_next, 1.0), 0.0)
    crossing = polygons + share[..., None] * (following - polygons)
    candidates = np.stack([polygons, crossing], axis=2).reshape(len(polygons), -1, 2)
    return _compacted(candidates, np.stack([keep, crosses], axis=2).reshape(len(polygons), -1))


def _compacted(points: Float64[np.ndarray, "k v 2"], valid: Bool[np.ndarray, "k v"]) -> Float64[np.ndarray, "k w 2"]:
    """The valid points of each row, in order, the last repeated up to the longest row's number."""
    count = valid.sum(axis=1)
    order = np.argsort(~valid, axis=1, kind="stable")
    slots = np.minimum(np.arange(max(int(count.max(initial=0)), 1)), np.maximum(count - 1, 0)[:, None])
    chosen = np.take_along_axis(order, slots, axis=1)
    packed = np.take_along_axis(points, chosen[..., None], axis=1)
    return np.where((count > 0)[:, None, None], packed, 0.0)
