"""The upright box nearest to a tilted box, for formats without pitch and roll."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
from jaxtyping import Float, Float64

from annotator.types import OrientedBox


def nearest_upright(box: OrientedBox, up: Float[np.ndarray, "3"]) -> tuple[OrientedBox, float]:
    """The nearest box with the same centre and sides and a vertical z axis, and the angle between both, radians.

    The box's z axis becomes vertical, unless another axis is closer to the vertical; that axis then becomes the height.
    The length axis stays the length if it is still horizontal. Among these boxes, the one with the smallest rotation
    angle is returned; an upright box is returned unchanged.

    Args:
        up: unit vector against gravity, in the box's frame.
    """
    candidates = [_made_upright(box, up, order) for order in _orders(box, up)]
    return min(candidates, key=lambda pair: pair[1])


def _orders(box: OrientedBox, up: np.ndarray) -> list[tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]]:
    """Candidate labellings (rotation, size): the given one; for a box on its side, those with a vertical z axis."""
    R, size = box.rotation, box.size_m
    rise = R.T @ up
    vertical = int(np.argmax(np.abs(rise)))
    if vertical == 2 or abs(rise[vertical]) - abs(rise[2]) < 1e-9:
        return [(R if rise[2] >= 0 else _turned_over(R), size)]
    candidates = []
    for order in permutations(range(3)):
        if order[2] != vertical:
            continue
        axes = R[:, order] * np.array([1.0, 1.0, math.copysign(1.0, rise[vertical])])
        axes[:, 1] *= np.linalg.det(axes)
        candidates.append((axes, size[list(order)]))
    # the length axis is kept if it is still horizontal
    return [pair for pair in candidates if vertical == 0 or np.allclose(np.abs(pair[0][:, 0]), np.abs(R[:, 0]))]


def _turned_over(R: np.ndarray) -> np.ndarray:
    """The rotation after half a turn about the length axis: the same heading, upside down."""
    return R * np.array([1.0, -1.0, -1.0])


def _made_upright(
    box: OrientedBox, up: np.ndarray, candidate: tuple[np.ndarray, np.ndarray]
) -> tuple[OrientedBox, float]:
    """The upright box nearest to a candidate, and the angle between both, radians."""
    R, size_m = candidate
    tilt = math.acos(min(1.0, max(-1.0, float(R[:, 2] @ up))))
    if tilt < 1e-12:
        return OrientedBox.from_parts(box.center_m, R, size_m), 0.0
    # the smallest rotation that makes z vertical; any additional yaw would increase the angle
    axis = np.cross(R[:, 2], up)
    norm = np.linalg.norm(axis)
    axis = axis / norm if norm > 1e-12 else R[:, 0]
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + math.sin(tilt) * K + (1 - math.cos(tilt)) * K @ K
    return OrientedBox.from_parts(box.center_m, turn @ R, size_m), tilt
