"""Interpolation of an object's boxes between two known boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from annotator.tracking.relabel import are_upright, nearest_change, relabelled, relabellings
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError


def between(
    first: OrientedBox, last: OrientedBox, first_time: float, last_time: float, times: Sequence[float]
) -> list[OrientedBox]:
    """Boxes between two known boxes: centre and size by linear interpolation, the rotation by slerp.

    The axes of the last box are first relabelled to be as similar to the first box as possible. Otherwise, if front and
    back were swapped, the boxes in between would make half a turn.

    Args:
        times: strictly between `first_time` and `last_time`.

    Raises:
        GeometryError: a time is not between the two.
    """
    if any(not first_time < time < last_time for time in times):
        raise GeometryError(
            "only frames between the two known boxes can be filled; choose an earlier and a later frame"
        )
    last = relabelled(last, nearest_change(last, first, relabellings(are_upright([first, last]))))
    turn = Slerp([0.0, 1.0], Rotation.concatenate([first.T_camera_box.rotation, last.T_camera_box.rotation]))
    boxes = []
    for share in ((time - first_time) / (last_time - first_time) for time in times):
        center = (1 - share) * first.center_m + share * last.center_m
        size = (1 - share) * first.size_m + share * last.size_m
        boxes.append(OrientedBox.from_parts(center, turn(share).as_matrix(), np.asarray(size)))
    return boxes
