"""Points sorted along one axis, so that a look into one box of a large cloud does not touch all of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from annotator.geometry.oriented_box import box_corners, contains
from annotator.types import OrientedBox


@dataclass(frozen=True, eq=False)
class PointIndex:
    """A cloud, sorted.

    Attributes:
        xyz_m: (n, 3) the points, sorted by coordinate `axis`.
        order: (n,) the place of each in the cloud as it was.
        axis: the coordinate in which the points spread most.
    """

    xyz_m: Float32[np.ndarray, "n 3"]
    order: Int64[np.ndarray, "n"]
    axis: int

    @classmethod
    def of(cls, xyz_m: Float32[np.ndarray, "n 3"]) -> PointIndex:
        """Sorts a cloud; every point finite."""
        axis = int(np.argmax(xyz_m.std(axis=0))) if len(xyz_m) else 0
        order = np.argsort(xyz_m[:, axis], kind="stable").astype(np.int64)
        return cls(xyz_m[order], order, axis)

    def inside(self, box: OrientedBox, margin_m: float = 0.0) -> Int64[np.ndarray, "m"]:
        """The places, in the cloud as it was, of the points in a box whose faces are moved outwards by `margin_m`."""
        first, last = self._slice(box, margin_m)
        return self.order[first:last][contains(box, self.xyz_m[first:last], margin_m)]

    def count(self, box: OrientedBox, margin_m: float = 0.0) -> int:
        """How many points lie in a box whose faces are moved outwards by `margin_m`."""
        first, last = self._slice(box, margin_m)
        return int(contains(box, self.xyz_m[first:last], margin_m).sum())

    def _slice(self, box: OrientedBox, margin_m: float) -> tuple[int, int]:
        reach = box_corners(box)[:, self.axis]
        # moving all faces moves a corner by at most the margin along each box axis; and float32 rounds
        slack = np.sqrt(3.0) * abs(margin_m) + 1e-5 * float(np.abs(reach).max())
        along = self.xyz_m[:, self.axis]
        first, last = np.searchsorted(along, np.array([reach.min() - slack, reach.max() + slack], np.float32))
        return int(first), min(int(last) + 1, len(along))
