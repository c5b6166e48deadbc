"""The upright box that is nearest to a tilted one, for formats that know no pitch and roll."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
from jaxtyping import Float, Float64

from annotator.types import OrientedBox


def nearest_upright(box: OrientedBox, up: Float[np.ndarray, "3"]) -> tuple[OrientedBox, float]:
    """The same centre and sides with one axis vertical, and by how much the box was turned for it, radians.

    The box's own z axis is made vertical, unless another axis is nearer to it: then the sides change their names, and
    the length stays that of the axis that points forward most nearly as before. Of all such boxes it is the one whose
    rotation is nearest (the least angle); an upright box comes back as it is.

    Args:
        up: unit vector against gravity, in the box's frame.
    """
    candidates = [_held(box, up, order) for order in _orders(box, up)]
    return min(candidates, key=lambda pair: pair[1])


def _orders(box: OrientedBox, up: np.ndarray) -> list[tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]]:
    """The box as it is and, where it lies on its side, with its most vertical axis as the height: rotation, size."""
    R, size = box.rotation, box.size_m
    rise = R.T @ up
    vertical = int(np.argmax(np.abs(rise)))
    if vertical == 2 or abs(rise[vertical]) - abs(rise[2]) < 1e-9:
        return [(R if rise[2] >= 0 else _turned_over(R), size)]
    found = []
    for order in permutations(range(3)):
        if order[2] != vertical:
            continue
        axes = R[:, order] * np.array([1.0, 1.0, math.copysign(1.0, rise[vertical])])
        axes[:, 1] *= np.linalg.det(axes)
        found.append((axes, size[list(order)]))
    # what was the length stays it, if it still lies on the ground
    return [pair for pair in found if vertical == 0 or np.allclose(np.abs(pair[0][:, 0]), np.abs(R[:, 0]))]


def _turned_over(R: np.ndarray) -> np.ndarray:
    """Half a turn about the length: the same solid and heading, the other way up."""
    return R * np.array([1.0, -1.0, -1.0])


def _held(box: OrientedBox, up: np.ndarray, candidate: tuple[np.ndarray, np.ndarray]) -> tuple[OrientedBox, float]:
    """The upright rotation nearest to a candidate's, and the angle between them."""
    R, size_m = candidate
    tilt = math.acos(min(1.0, max(-1.0, float(R[:, 2] @ up))))
    if tilt < 1e-12:
        return OrientedBox.from_parts(box.center_m, R, size_m), 0.0
    # the shortest turn that makes z vertical is the nearest: any yaw on top of it only adds to the angle
    axis = np.cross(R[:, 2], up)
    norm = np.linalg.norm(axis)
    axis = axis / norm if norm > 1e-12 else R[:, 0]
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + math.sin(tilt) * K + (1 - math.cos(tilt)) * K @ K
    return OrientedBox.from_parts(box.center_m, turn @ R, size_m), tilt
