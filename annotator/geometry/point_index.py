"""An index of a large cloud, for fast queries of the points in a box.

The points are divided into slabs along the axis of largest spread, with equal numbers of points. Within a slab, they
are sorted along the axis with the next largest spread. A query reads one slice of each slab that the box intersects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from annotator.geometry.oriented_box import box_corners, contains
from annotator.types import OrientedBox

POINTS_A_SLAB = 2000


@dataclass(frozen=True, eq=False)
class PointIndex:
    """A sorted cloud.

    Attributes:
        xyz_m: (n, 3) the points, slab by slab.
        order: (n,) index of each in the original cloud.
        axes: index of the coordinate that is divided into slabs, and of the one that each slab is sorted by.
        starts: (k + 1,) first point of each slab, and the end of the last slab.
        lows: (k,) lowest coordinate of each slab along the first axis.
    """

    xyz_m: Float32[np.ndarray, "n 3"]
    order: Int64[np.ndarray, "n"]
    axes: tuple[int, int]
    starts: Int64[np.ndarray, "k1"]
    lows: Float32[np.ndarray, "k"]

    @classmethod
    def of(cls, xyz_m: Float32[np.ndarray, "n 3"]) -> PointIndex:
        """The index of a cloud of finite points."""
        n = len(xyz_m)
        spread = np.argsort(-xyz_m.std(axis=0)) if n else np.arange(3)
        first, second = int(spread[0]), int(spread[1])
        order = np.argsort(xyz_m[:, first])
        starts = np.arange(0, n + POINTS_A_SLAB, POINTS_A_SLAB).clip(max=n) if n else np.zeros(1, np.int64)
        lows = xyz_m[order[starts[:-1]], first]
        # one sort key: the integer part is the slab, the fraction is the position within the slab
        along = xyz_m[order, second].astype(np.float64)
        width = float(np.ptp(along)) * 1.001 + 1e-9 if n else 1.0
        order = order[np.argsort(np.arange(n) // POINTS_A_SLAB + (along - along.min(initial=np.inf)) / width)]
        return cls(xyz_m[order], order.astype(np.int64), (first, second), starts.astype(np.int64), lows)

    def inside(self, box: OrientedBox, margin_m: float = 0.0) -> Int64[np.ndarray, "m"]:
        """Indices, in the original cloud, of the points in a box with its faces moved outwards by `margin_m`."""
        near = self._near(box, margin_m)
        return self.order[near[contains(box, self.xyz_m[near], margin_m)]]

    def count(self, box: OrientedBox, margin_m: float = 0.0) -> int:
        """The number of points in a box with its faces moved outwards by `margin_m`."""
        return int(contains(box, self.xyz_m[self._near(box, margin_m)], margin_m).sum())

    def _near(self, box: OrientedBox, margin_m: float) -> Int64[np.ndarray, "m"]:
        """Indices into `xyz_m` of candidates: the points within the box's extent along both axes, and a few more."""
        reach = box_corners(box)[:, self.axes]
        # the margin moves a corner by at most sqrt(3) times its value; the second term is for float32 rounding
        slack = np.sqrt(3.0) * abs(margin_m) + 1e-5 * float(np.abs(reach).max())
        (low, low_in), (high, high_in) = reach.min(axis=0) - slack, reach.max(axis=0) + slack
        first = max(int(np.searchsorted(self.lows, low)) - 1, 0)
        last = int(np.searchsorted(self.lows, high, side="right"))
        parts = []
        for slab in range(first, last):
            begin, end = int(self.starts[slab]), int(self.starts[slab + 1])
            along = self.xyz_m[begin:end, self.axes[1]]
            a, b = np.searchsorted(along, np.array([low_in, high_in], np.float32))
            # one additional point on each side, because the limits are rounded
            parts.append(np.arange(begin + max(int(a) - 1, 0), begin + min(int(b) + 1, end - begin)))
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)
