"""One size of a rigid object for all its frames, from the sides that its boxes and its points show.

As in Auto4D (B. Yang et al., "Auto4D: Learning to Label 4D Objects from Sequential Point Clouds", 2021), the size
belongs to the track, the pose to the frame. Each box says how long its sides are. Points are on the surface, so that no
side is shorter than what they span in the frames that show it best; a frame that hides a side spans less of it, and
does not count there. Boxes count by the root of their points, since near ones are measured better.

Measured with the base detector from true 2D boxes: docs/benchmarks.md, `benchmarks.follow`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from annotator.types import OrientedBox

# Margin around a box within which points belong to its object, share of the mean side; along one axis at a time.
MARGIN = 0.1
# The lowest part, share of the height, has the points of the ground; it tells nothing of length and width.
FOOT = 0.1
# The outermost points are often strays, shares; fewer points span nothing.
OUTERMOST, LEAST_POINTS = 0.01, 5
# Share of the boxes, by weight, that span less than the best ones.
SPANNED = 0.9


@dataclass(frozen=True, eq=False)
class SizedBox:
    """What a frame says of an object's size.

    Attributes:
        size_m: of its box: length, width, height.
        spans_m: how far its points reach along these; 0 = hardly any points.
        points: their number.
    """

    size_m: Float64[np.ndarray, "3"]
    spans_m: Float64[np.ndarray, "3"]
    points: int

    @classmethod
    def of(cls, box: OrientedBox, xyz_m: Float[np.ndarray, "n 3"], is_reviewed: bool = False) -> SizedBox:
        """As a frame's cloud shows it; box and points in the same frame. Of a reviewed box, no point is outside."""
        local = (xyz_m.astype(np.float64) - box.center_m) @ box.rotation
        margin_m, half = 0.0 if is_reviewed else MARGIN * float(box.size_m.mean()), box.size_m / 2
        stands = local[:, 2] > (FOOT - 0.5) * box.size_m[2]
        spans, most = np.zeros(3), 0
        for axis in range(3):
            reach = half + margin_m * (np.arange(3) == axis)
            own = local[(np.abs(local) <= reach).all(axis=1) & (stands | (axis == 2)), axis]
            most = max(most, len(own))
            if len(own) >= LEAST_POINTS:
                spans[axis] = np.diff(np.quantile(own, (OUTERMOST, 1 - OUTERMOST)))[0]
        return cls(box.size_m, spans, most)


def common_size(boxes: Sequence[SizedBox]) -> Float64[np.ndarray, "3"]:
    """The size (length, width, height) that fits all boxes of an object (at least one), metres."""
    weights = np.sqrt([each.points + 1.0 for each in boxes])
    spans = np.array([each.spans_m for each in boxes])
    least = np.quantile(spans, SPANNED, axis=0, method="inverted_cdf", weights=weights)
    sizes = np.maximum([each.size_m for each in boxes], least)
    return np.asarray(np.average(sizes, axis=0, weights=weights))
