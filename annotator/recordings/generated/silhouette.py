"""Where a mesh of convex parts would be on the image."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import RigidTransform

from annotator.geometry.projection import project
from annotator.recordings.generated.mesh import Mesh
from annotator.types import Camera


def silhouette(
    camera: Camera, T_camera_world: RigidTransform, mesh: Mesh, border_px: int = 0
) -> UInt8[np.ndarray, "h w"] | None:
    """1 where `mesh` (world frame) covers the image if nothing is in front, 0 elsewhere, right to a pixel.

    A convex part covers the convex hull of its vertices' projections.

    Returns:
        The picture with a border of `border_px` more pixels on every side, or None where a part of the mesh is beside
        or behind the camera, so that it has no outline.
    """
    import cv2

    px = project(camera, T_camera_world.apply(mesh.vertices.astype(np.float64))) + border_px
    if not np.isfinite(px).all():
        return None
    picture = np.zeros((camera.height_px + 2 * border_px, camera.width_px + 2 * border_px), np.uint8)
    starts = np.flatnonzero(np.diff(mesh.parts, prepend=-1))
    for part in np.split(np.rint(px).astype(np.int32), starts[1:]):
        cv2.fillConvexPoly(picture, cv2.convexHull(part), 1)
    return picture
