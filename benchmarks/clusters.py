"""A guess of an object's 3D box from geometry alone, with which the base detector is compared."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from jaxtyping import Float, Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from annotator.geometry.oriented_box import aligned_box
from annotator.geometry.projection import in_frustum
from annotator.rcv.axes import camera_axes
from annotator.rcv.first_look import in_middle, width_at
from annotator.rcv.rotations import spread_rotations
from annotator.types import Box2D, Frame, OrientedBox

# Points closer than this share of the object's width are connected.
GAP = 0.08
MIN_POINTS = 5
YAWS, ROTATIONS = 45, 600


def cluster_box(frame: Frame, image_box: Box2D, up: Float64[np.ndarray, "3"] | None) -> OrientedBox | None:
    """The tightest box around the connected points with the largest part in the middle of an image box.

    Args:
        up: unit vector against gravity for an upright box, None for a free one.
    """
    camera = frame.camera
    xyz = frame.cloud.xyz_m[in_frustum(camera, frame.cloud.xyz_m, image_box)].astype(np.float64)
    if len(xyz) < MIN_POINTS:
        return None
    middle = in_middle(camera, xyz, image_box)
    gap = GAP * width_at(camera, image_box, float(np.median(xyz[middle, 2])))
    cells, of = np.unique(np.floor(xyz / gap).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(2.0, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    _, group = connected_components(links, directed=False)
    groups = group[of.reshape(-1)]
    cluster = xyz[groups == np.bincount(groups[middle]).argmax()]
    return None if len(cluster) < MIN_POINTS else _tightest(cluster, up)


def _tightest(xyz: Float[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"] | None) -> OrientedBox:
    """The box of least volume among evenly spread rotations."""
    with suppress(QhullError):  # of flat clusters, all points are used
        xyz = xyz[ConvexHull(xyz).vertices]
    base = camera_axes(up)
    if up is None:
        rotations = spread_rotations(ROTATIONS) @ base.T
    else:
        from scipy.spatial.transform import Rotation

        angles = np.arange(YAWS) * (np.pi / 2 / YAWS)
        rotations = Rotation.from_rotvec(angles[:, None] * up).as_matrix() @ base.T
    boxes = [aligned_box(xyz, rotation) for rotation in rotations]
    return min(boxes, key=lambda box: box.volume_m3)
