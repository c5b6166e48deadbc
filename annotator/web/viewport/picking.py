"""Picking of boxes by clicks in the viewport."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from annotator.types import OrientedBox


def pick(
    boxes: Sequence[OrientedBox], origin_m: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]
) -> int | None:
    """The box that a ray enters first. Boxes around the ray's origin come last, the smallest of them first.

    Args:
        origin_m, direction: of the ray, camera frame.

    Returns:
        Its index, or None if the ray misses all boxes.
    """
    hits = [(*hit, box.volume_m3, n) for n, box in enumerate(boxes) if (hit := _entry(box, origin_m, direction))]
    return min(hits)[-1] if hits else None


def _entry(
    box: OrientedBox, origin_m: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]
) -> tuple[bool, float] | None:
    """Whether the ray starts inside the box, and the distance at which it enters; None if it misses (slab test)."""
    T_box_camera = box.T_camera_box.inv()
    start = T_box_camera.apply(origin_m)
    along = T_box_camera.rotation.apply(direction)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        to_planes = (np.array([[-0.5], [0.5]]) * box.size_m - start) / along
    # a ray within the plane of a face gives 0/0, and counts as inside that slab
    near = np.nan_to_num(np.minimum(*to_planes), nan=-np.inf).max()
    far = np.nan_to_num(np.maximum(*to_planes), nan=np.inf).min()
    if far < max(near, 0.0):
        return None
    return (True, 0.0) if near < 0 else (False, float(near))
