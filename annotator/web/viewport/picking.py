"""Which box a click in the viewport meant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from annotator.types import OrientedBox


def picked(
    boxes: Sequence[OrientedBox], origin_m: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]
) -> int | None:
    """The box that a ray enters first; one that the viewer stands in comes last, of several such the smallest.

    Args:
        origin_m, direction: of the ray, camera frame.

    Returns:
        Its number, or None where the ray meets no box.
    """
    met = [
        (*distance, box.volume_m3, n) for n, box in enumerate(boxes) if (distance := _enters(box, origin_m, direction))
    ]
    return min(met)[-1] if met else None


def _enters(
    box: OrientedBox, origin_m: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]
) -> tuple[bool, float] | None:
    """Whether the ray begins in the box, and how far along it enters; None where it misses (slab test)."""
    T_box_camera = box.T_camera_box.inv()
    start = T_box_camera.apply(origin_m)
    along = T_box_camera.rotation.apply(direction)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        to_planes = (np.array([[-0.5], [0.5]]) * box.size_m - start) / along
    # a ray along a face's own plane gives 0/0: it is within that slab
    near = np.nan_to_num(np.minimum(*to_planes), nan=-np.inf).max()
    far = np.nan_to_num(np.maximum(*to_planes), nan=np.inf).min()
    if far < max(near, 0.0):
        return None
    return (True, 0.0) if near < 0 else (False, float(near))
