"""The views of an object's first step: front and side view of all points in its image box's frustum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from annotator.geometry.transforms import unit
from annotator.rcv.config import RcvConfig
from annotator.rcv.pseudo_view import render_pairs
from annotator.types import PointCloud, PseudoView


def frustum_views(
    cloud: PointCloud,
    axes: Float64[np.ndarray, "3 3"],
    config: RcvConfig,
    *,
    enlarge_deep: bool = True,
) -> tuple[PseudoView, PseudoView]:
    """Both views of a frustum's points. For a deep frustum they are larger, also as the detector's input.

    Args:
        cloud: at least one point, camera frame.
        axes: as in `render_pairs`.
        enlarge_deep: False for crops of a frustum, which class-agnostic detectors see at the usual size.
    """
    # all points are drawn, because thinning would leave too few points of a far object
    view = config.view.model_copy(update={"points_per_px": float(len(cloud))})
    if not (enlarge_deep and is_deep(cloud, config)):
        front, side = render_pairs(cloud, [axes], view)
        return front, side
    large = view.model_copy(update={"size_px": max(view.size_px, view.deep_size_px)})
    front, side = render_pairs(cloud, [axes], large)
    return replace(front, look_px=view.deep_size_px), replace(side, look_px=view.deep_size_px)


def is_deep(cloud: PointCloud, config: RcvConfig) -> bool:
    """True if a frustum's depth is more than `config.view.deep` times its width and height.

    The object is then small in the side view: with 60 m of street behind, a pedestrian is 2 of 96 pixels wide.
    Depth is measured along the frustum, which may lie at any angle to the camera's axis.
    """
    from annotator.rcv import drawing_kernels as kernel

    xyz = np.array(cloud.xyz_m.T, order="C")
    forward = unit(xyz.mean(axis=1, dtype=np.float64))
    across = unit(np.cross([0.0, 1.0, 0.0], forward))
    frustum_axes = np.stack([across, np.cross(forward, across), forward]).astype(np.float32)
    least, most = np.empty((2, 1, 3), np.float32)
    kernel.extents(xyz, frustum_axes[None], least, most)
    width, height, depth = (most - least)[0].tolist()
    return bool(depth > config.view.deep * max(width, height))
