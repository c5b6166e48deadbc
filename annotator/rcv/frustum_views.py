"""The first look at an object: front and side view of all that its image box's frustum holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from annotator.geometry.transforms import unit
from annotator.rcv.compute import NUMPY, Compute
from annotator.rcv.config import RcvConfig
from annotator.types import PointCloud, PseudoView


def frustum_views(
    cloud: PointCloud, frame: Float64[np.ndarray, "3 3"], config: RcvConfig, compute: Compute = NUMPY
) -> tuple[PseudoView, PseudoView]:
    """Both views of a frustum's points; of a deep frustum large ones, to be looked at larger than others.

    Args:
        cloud: at least one point, camera frame.
        frame: as in `render_pairs`.
    """
    # Each point is drawn: of a far object among many near points too few would be left.
    view = config.view.model_copy(update={"points_per_px": float(len(cloud))})
    if not is_deep(cloud, config):
        front, side = compute.render_pairs(cloud, [frame], view, None)
        return front, side
    large = view.model_copy(update={"size_px": max(view.size_px, view.deep_size_px)})
    front, side = compute.render_pairs(cloud, [frame], large, None)
    return replace(front, look_px=view.deep_size_px), replace(side, look_px=view.deep_size_px)


def is_deep(cloud: PointCloud, config: RcvConfig) -> bool:
    """Whether the points of a frustum reach so much further into the scene than across that its object is small in it.

    What lies behind a pedestrian in a street makes the side view 60 m wide: of 96 pixels he has two. Into the scene is
    along the frustum, which may lie at any angle to the camera's axis.
    """
    from annotator.rcv.kernels import drawing as kernel

    xyz = np.array(cloud.xyz_m.T, order="C")
    into = unit(xyz.mean(axis=1, dtype=np.float64))
    across = unit(np.cross([0.0, 1.0, 0.0], into))
    axes = np.stack([across, np.cross(into, across), into]).astype(np.float32)
    least, most = np.empty((2, 1, 3), np.float32)
    kernel.extents(xyz, axes[None], least, most)
    reach = (most - least)[0].tolist()
    return bool(reach[2] > config.view.deep * max(reach[:2]))
