"""What a KITTI row says that follows from the 3D box: rotation_y, alpha, the 2D box and how much of it is outside.

The 2D box goes around the projected corners, cut to pixel centres 0..width-1 and 0..height-1, as in the devkit's own
drawings (`computeBox3D.m`). Where a corner is behind the camera, its edges are cut there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.geometry.edges import cut_segments
from annotator.geometry.oriented_box import EDGES, box_corners
from annotator.geometry.projection import project
from annotator.types import Camera, OrientedBox

# Nothing nearer to the camera than this is projected, metres along z of the labels' frame.
NEAR_M = 0.1


@dataclass(frozen=True)
class DerivedBox:
    """The 2D box of a 3D box, pixels: left, top, right, bottom.

    Attributes:
        unclipped: as far as it goes.
        clipped: the part within the image; without extent where it is beside it.
    """

    unclipped: tuple[float, float, float, float]
    clipped: tuple[float, float, float, float]

    @property
    def truncated(self) -> float:
        """The share of the box that is outside the image, 0..1."""
        whole = _area(self.unclipped)
        return 1.0 - _area(self.clipped) / whole if whole > 0 else 1.0


def derived_box(camera: Camera, box: OrientedBox, T_camera_label: RigidTransform | None) -> DerivedBox | None:
    """The 2D box of a 3D box that is given in the labels' frame (rectified camera 0); None for one behind the camera.

    Args:
        camera: the colour camera; an ideal pinhole, as KITTI's rectified cameras are.
        T_camera_label: from rectified camera 0 to the colour camera (`Frame.T_camera_label`); None for identity.
    """
    ends = box_corners(box)[np.array(EDGES)]
    cut, seen = cut_segments(ends, np.array([[0.0, 0.0, 1.0, NEAR_M]]))
    xyz = cut[seen].reshape(-1, 3)
    if len(xyz) == 0:
        return None
    px = project(camera, xyz if T_camera_label is None else T_camera_label.apply(xyz))
    if not np.isfinite(px).all():
        return None
    last = np.array([camera.width_px, camera.height_px]) - 1.0
    low, high = px.min(axis=0), px.max(axis=0)
    return DerivedBox(_edges(low, high), _edges(low.clip(0.0, last), high.clip(0.0, last)))


def heading(box: OrientedBox) -> float:
    """rotation_y of a box in the labels' frame: the direction of its length on the ground, -pi..pi."""
    along = box.rotation[:, 0]
    return math.atan2(-along[2], along[0])


def observation_angle(rotation_y: float, x: float, z: float) -> float:
    """alpha: rotation_y less the direction from the camera to the box's centre, -pi..pi."""
    return math.remainder(rotation_y - math.atan2(x, z), 2.0 * math.pi)


def _edges(low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> tuple[float, float, float, float]:
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _area(edges: tuple[float, float, float, float]) -> float:
    return (edges[2] - edges[0]) * (edges[3] - edges[1])
