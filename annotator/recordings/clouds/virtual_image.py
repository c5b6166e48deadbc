"""Renders the image of a virtual camera from a point cloud, for operators and detectors."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from annotator.geometry.projection import inside_image, project
from annotator.types import Camera, Frame, PointCloud

# A point is drawn as a square: this length, projected, is its side, within these bounds in pixels.
POINT_SIZE_M = 0.06
SMALLEST_PX, LARGEST_PX = 2, 9
NEAREST_M = 0.1


def virtual_image(camera: Camera, cloud: PointCloud) -> UInt8[np.ndarray, "h w 3"]:
    """Renders the points as squares, nearest in front, in their colours; without colours, coloured by distance.

    Args:
        camera: the virtual camera.
        cloud: in the camera's frame.
    """
    import cv2

    px = project(camera, cloud.xyz_m)
    z_m = cloud.xyz_m[:, 2]
    drawn = np.flatnonzero(inside_image(camera, px) & (z_m > NEAREST_M))
    # ranks from 1, far to near: the point with the highest rank is visible at a pixel
    drawn = drawn[np.argsort(-z_m[drawn], kind="stable")]
    size_px = np.clip(np.ceil(POINT_SIZE_M * camera.fx / z_m[drawn]), SMALLEST_PX, LARGEST_PX).astype(np.int64)
    corner = np.floor(px[drawn] - size_px[:, None] / 2 + 1).astype(np.int64) + LARGEST_PX
    seen = np.zeros((camera.height_px + LARGEST_PX, camera.width_px + LARGEST_PX))
    for size in range(SMALLEST_PX, LARGEST_PX + 1):
        of_size = np.flatnonzero(size_px == size)
        if len(of_size) == 0:
            continue
        rank = np.zeros_like(seen)
        # if several points have the same corner, the last one stays, which is the nearest
        rank[corner[of_size, 1], corner[of_size, 0]] = of_size + 1
        # fills the square right of and below each corner
        squares = cv2.dilate(rank, np.ones((size, size), np.uint8), anchor=(size - 1, size - 1))
        np.maximum(seen, squares, out=seen)
    palette = np.concatenate([np.zeros((1, 3), np.uint8), _colors(cloud)[drawn]])
    return palette[seen[LARGEST_PX:, LARGEST_PX:].astype(np.int64)]


def has_virtual_image(frame: Frame) -> bool:
    """True if a frame's image is rendered from its cloud, so that the two cannot lie beside each other.

    Args:
        frame: as its recording gives it, without a correction.
    """
    return np.array_equal(frame.rgb, virtual_image(frame.camera, frame.cloud))


def _colors(cloud: PointCloud) -> UInt8[np.ndarray, "n 3"]:
    """Returns the points' colours, or colours by distance (red near, blue far), with reflectance as brightness."""
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
