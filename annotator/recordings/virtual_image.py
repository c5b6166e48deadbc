"""A picture of a point cloud from a camera that nobody had: what an operator and a detector look at without one."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from annotator.geometry.projection import project
from annotator.types import Camera, PointCloud

# A point is drawn as a square as large as this length looks at its distance, within these bounds.
POINT_SIZE_M = 0.06
SMALLEST_PX, LARGEST_PX = 2, 9
NEAREST_M = 0.1


def virtual_image(camera: Camera, cloud: PointCloud) -> UInt8[np.ndarray, "h w 3"]:
    """The points as squares, the nearest in front, in their colours; without any, in colours of their distance.

    Args:
        camera: where the picture is taken from.
        cloud: in the camera's frame.
    """
    image = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    px = project(camera, cloud.xyz_m)
    z_m = cloud.xyz_m[:, 2]
    inside = (px >= -0.5).all(axis=1) & (px < np.array([camera.width_px, camera.height_px]) - 0.5).all(axis=1)
    drawn = np.flatnonzero(inside & (z_m > NEAREST_M))
    # what is written later covers what was there
    drawn = drawn[np.argsort(-z_m[drawn], kind="stable")]
    colors = _colors(cloud)[drawn]
    size_px = np.clip(np.ceil(POINT_SIZE_M * camera.fx / z_m[drawn]), SMALLEST_PX, LARGEST_PX).astype(np.int64)
    corner = np.floor(px[drawn] - size_px[:, None] / 2 + 1).astype(np.int64)
    # squares of one size are drawn at once, and these come in the order of distance, too
    for size in range(LARGEST_PX, SMALLEST_PX - 1, -1)[::-1]:
        of_size = size_px == size
        offsets = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2)
        u, v = (corner[of_size][:, None] + offsets).reshape(-1, 2).T
        kept = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
        image[v[kept], u[kept]] = np.repeat(colors[of_size], size * size, axis=0)[kept]
    return image


def _colors(cloud: PointCloud) -> UInt8[np.ndarray, "n 3"]:
    """The points' own colours, or those of their distance: red near, blue far; reflectance is their brightness."""
    import cv2

    if cloud.rgb is not None:
        return cloud.rgb
    near = 1 / np.maximum(np.linalg.norm(cloud.xyz_m, axis=1), 1.0)
    level = np.rint(255 * np.sqrt(near)).astype(np.uint8)
    bgr = cv2.applyColorMap(level[:, None], cv2.COLORMAP_JET)[:, 0]
    if cloud.reflectance is None:
        return np.ascontiguousarray(bgr[:, ::-1])
    brightness = 0.5 + 0.5 * np.sqrt(cloud.reflectance)
    return np.rint(bgr[:, ::-1] * brightness[:, None]).astype(np.uint8)
