"""Thinning of clouds, and an index of a large cloud for fast queries of the points in a box.

The points are sorted by the cells of a grid along the two axes of largest spread. A query reads, of each row of cells
that the box intersects, one slice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from annotator.geometry.oriented_box import box_corners, contains
from annotator.types import OrientedBox

# Cells along each axis. The number of a cell then fits into 16 bits, which numpy sorts by radix: in linear time.
SIDE = 256
# Number of points from which the grid's extent is taken, and the share of them on each side that may lie beyond it:
# a few points far away would make the cells too large for the others.
SAMPLE = 4096
BEYOND = 0.005


@dataclass(frozen=True, eq=False)
class PointIndex:
    """A sorted cloud.

    Attributes:
        xyz_m: (n, 3) the points, cell by cell.
        order: (n,) index of each in the original cloud.
        axes: index of the coordinate along which the rows of cells follow each other, and of the one along a row.
        low_m: (2,) lower end of the grid along both axes. The outermost cells also hold all points beyond the grid.
        cells_per_m: (2,) cells per meter along both axes.
        starts: (SIDE ** 2 + 1,) first point of each cell, and the end of the last cell.
    """

    xyz_m: Float32[np.ndarray, "n 3"]
    order: Int64[np.ndarray, "n"]
    axes: tuple[int, int]
    low_m: Float32[np.ndarray, "2"]
    cells_per_m: Float32[np.ndarray, "2"]
    starts: Int64[np.ndarray, "cells"]

    @classmethod
    def of(cls, xyz_m: Float32[np.ndarray, "n 3"]) -> PointIndex:
        """The index of a cloud of finite points."""
        sample = xyz_m[:: max(1, len(xyz_m) // SAMPLE)]
        spread = np.argsort(-sample.std(axis=0)) if len(sample) else np.arange(3)
        axes = (int(spread[0]), int(spread[1]))
        ends = np.quantile(sample[:, axes], (BEYOND, 1 - BEYOND), axis=0) if len(sample) else np.zeros((2, 2))
        low_m = ends[0].astype(np.float32)
        cells_per_m = (SIDE / (ends[1] - ends[0]).clip(min=1e-6)).astype(np.float32)
        row, column = (_cell(xyz_m[:, axis], low_m[i], cells_per_m[i]) for i, axis in enumerate(axes))
        key = row.astype(np.uint16) * SIDE + column
        order = np.argsort(key, kind="stable")
        starts = np.zeros(SIDE**2 + 1, np.int64)
        np.cumsum(np.bincount(key, minlength=SIDE**2), out=starts[1:])
        return cls(xyz_m[order], order, axes, low_m, cells_per_m, starts)

    def inside(self, box: OrientedBox, margin_m: float = 0.0) -> Int64[np.ndarray, "m"]:
        """Indices, in the original cloud, of the points in a box with its faces moved outwards by `margin_m`."""
        near = self._near(box, margin_m)
        return self.order[near[contains(box, self.xyz_m[near], margin_m)]]

    def count(self, box: OrientedBox, margin_m: float = 0.0) -> int:
        """The number of points in a box with its faces moved outwards by `margin_m`."""
        return int(contains(box, self.xyz_m[self._near(box, margin_m)], margin_m).sum())

    def _near(self, box: OrientedBox, margin_m: float) -> Int64[np.ndarray, "m"]:
        """Indices into `xyz_m` of candidates: the points in all cells that the box's extent along both axes touches."""
        reach = box_corners(box)[:, self.axes]
        # the margin moves a corner by at most sqrt(3) times its value; the second term is for float32 rounding
        slack = np.sqrt(3.0) * abs(margin_m) + 1e-5 * float(np.abs(reach).max())
        ends = np.stack([reach.min(axis=0) - slack, reach.max(axis=0) + slack]).astype(np.float32)
        (first, last), (left, right) = (_cell(ends[:, i], self.low_m[i], self.cells_per_m[i]) for i in range(2))
        rows = np.arange(int(first), int(last) + 1) * SIDE
        begins, stops = self.starts[rows + int(left)], self.starts[rows + int(right) + 1]
        return np.concatenate([np.arange(begin, stop) for begin, stop in zip(begins, stops, strict=True)])


def _cell(along_m: Float32[np.ndarray, "n"], low_m: np.float32, cells_per_m: np.float32) -> UInt8[np.ndarray, "n"]:
    """Numbers of the cells along one axis. They are monotonic in float32, too, so a query misses no point."""
    return ((along_m - low_m) * cells_per_m).clip(0, SIDE - 1).astype(np.uint8)


# Arbitrary, but fixed, so that a frame is always drawn with the same points.
SEED = 20231


def thin(n_points: int, most: int) -> Int64[np.ndarray, "m"] | None:
    """Indices of the points to keep, ascending; None = all.

    The cloud is divided into `most` runs of equal length, and one random point of each is kept. Consecutive points of a
    scan or an image are neighbours, so the cloud is thinned evenly. The time does not depend on the cloud's size.
    """
    if n_points <= most:
        return None
    edges = np.arange(most + 1, dtype=np.int64) * n_points // most
    return edges[:-1] + (_positions(most) * np.diff(edges)).astype(np.int64)


@lru_cache(maxsize=8)
def _positions(most: int) -> Float64[np.ndarray, "m"]:
    """The position of each kept point within its run, 0..1."""
    return np.random.default_rng(SEED).random(most)
