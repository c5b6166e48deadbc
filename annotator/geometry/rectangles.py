"""Intersection areas of rectangles in a plane, for many pairs at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int

# Pairs per pass, which bounds the memory.
CHUNK = 4096


def rectangle_intersection_pairs(
    centers_a: Float64[np.ndarray, "n 2"],
    yaws_a_rad: Float64[np.ndarray, "n"],
    sizes_a: Float64[np.ndarray, "n 2"],
    centers_b: Float64[np.ndarray, "n 2"],
    yaws_b_rad: Float64[np.ndarray, "n"],
    sizes_b: Float64[np.ndarray, "n 2"],
) -> Float64[np.ndarray, "n"]:
    """The intersection area of rectangles a and b, for each of n pairs.

    Args:
        centers_a, centers_b: coordinates in one plane, metres.
        yaws_a_rad, yaws_b_rad: direction of the first side, from the plane's first axis towards its second.
        sizes_a, sizes_b: full lengths of the first and second side, positive, metres.

    Returns:
        (n,) square metres.
    """
    a, b = _rectangles(centers_a, yaws_a_rad, sizes_a), _rectangles(centers_b, yaws_b_rad, sizes_b)
    areas = np.zeros(len(centers_a))
    for start in range(0, len(areas), CHUNK):
        part = np.arange(start, min(start + CHUNK, len(areas)))
        areas[part] = _clipped_areas(_corners_in(a, b, part), b.half[part])
    return areas


@dataclass(frozen=True, eq=False)
class _Rectangles:
    """Centres, directions of the first side, and half lengths of the sides."""

    center: Float64[np.ndarray, "n 2"]
    along: Float64[np.ndarray, "n 2"]
    half: Float64[np.ndarray, "n 2"]


def _rectangles(
    centers: Float64[np.ndarray, "n 2"], yaws_rad: Float64[np.ndarray, "n"], sizes: Float64[np.ndarray, "n 2"]
) -> _Rectangles:
    return _Rectangles(centers, np.stack([np.cos(yaws_rad), np.sin(yaws_rad)], axis=1), 0.5 * sizes)


def _corners_in(a: _Rectangles, b: _Rectangles, pairs: Int[np.ndarray, "k"]) -> Float64[np.ndarray, "k 4 2"]:
    """Corners of the rectangles a, counter-clockwise, in coordinates along the sides of the rectangles b."""
    x, origin = b.along[pairs], b.center[pairs]
    to_local = np.stack([x, np.stack([-x[:, 1], x[:, 0]], axis=1)], axis=1)
    length = a.along[pairs] * a.half[pairs, :1]
    width = np.stack([-a.along[pairs, 1], a.along[pairs, 0]], axis=1) * a.half[pairs, 1:]
    around = np.stack([-length - width, length - width, length + width, width - length], axis=1)
    return (around + (a.center[pairs] - origin)[:, None]) @ np.swapaxes(to_local, 1, 2)


def _clipped_areas(
    polygons: Float64[np.ndarray, "k v 2"], half: Float64[np.ndarray, "k 2"]
) -> Float64[np.ndarray, "k"]:
    """Areas of convex polygons clipped to axis-aligned rectangles around the origin."""
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            polygons = _clip(polygons, half[:, axis, None] - side * polygons[:, :, axis])
    following = np.roll(polygons, -1, axis=1)
    cross = polygons[..., 0] * following[..., 1] - polygons[..., 1] * following[..., 0]
    return np.maximum(0.5 * cross.sum(axis=1), 0.0)


def _clip(polygons: Float64[np.ndarray, "k v 2"], inside: Float64[np.ndarray, "k v"]) -> Float64[np.ndarray, "k w 2"]:
    """Each polygon clipped at a line (Sutherland and Hodgman, 1974); `inside` is each corner's signed distance from it.

    Polygons with fewer corners than others repeat their last corner; empty polygons become a single point.
    """
    following, inside_next = np.roll(polygons, -1, axis=1), np.roll(inside, -1, axis=1)
    keep, crosses = inside >= 0, (inside >= 0) != (inside_next >= 0)
    share = np.where(crosses, inside / np.where(crosses, inside - inside_next, 1.0), 0.0)
    crossing = polygons + share[..., None] * (following - polygons)
    candidates = np.stack([polygons, crossing], axis=2).reshape(len(polygons), -1, 2)
    return _compacted(candidates, np.stack([keep, crosses], axis=2).reshape(len(polygons), -1))


def _compacted(points: Float64[np.ndarray, "k v 2"], valid: Bool[np.ndarray, "k v"]) -> Float64[np.ndarray, "k w 2"]:
    """The valid points of each row in order, padded with the last one to the length of the longest row."""
    count = valid.sum(axis=1)
    order = np.argsort(~valid, axis=1, kind="stable")
    slots = np.minimum(np.arange(max(int(count.max(initial=0)), 1)), np.maximum(count - 1, 0)[:, None])
    chosen = np.take_along_axis(order, slots, axis=1)
    packed = np.take_along_axis(points, chosen[..., None], axis=1)
    return np.where((count > 0)[:, None, None], packed, 0.0)
