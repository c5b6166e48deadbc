"""The silhouette of a mesh of convex parts on the image."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import RigidTransform

from annotator.geometry.projection import project
from annotator.synthetic.mesh import Mesh
from annotator.types import Camera


def silhouette(
    camera: Camera, T_camera_world: RigidTransform, mesh: Mesh, border_px: int = 0
) -> UInt8[np.ndarray, "h w"] | None:
    """A mask of the pixels that `mesh` (world frame) covers without occlusion, accurate to a pixel.

    A convex part covers the convex hull of its projected vertices.

    Returns:
        the mask (1 inside, 0 outside) with `border_px` additional pixels on every side; None if a part of the mesh is
        beside or behind the camera.
    """
    import cv2

    px = project(camera, T_camera_world.apply(mesh.vertices.astype(np.float64))) + border_px
    if not np.isfinite(px).all():
        return None
    mask = np.zeros((camera.height_px + 2 * border_px, camera.width_px + 2 * border_px), np.uint8)
    starts = np.flatnonzero(np.diff(mesh.parts, prepend=-1))
    for part in np.split(np.rint(px).astype(np.int32), starts[1:]):
        cv2.fillConvexPoly(mask, cv2.convexHull(part), 1)
    return mask
