"""A depth image whose camera is not the colour camera: of another size, at another place, or both.

The points are those of the depth camera's pixels. Depth is never resampled: values between the pixels of an object and
its background would be surface that does not exist. Left out are points

- without depth, or outside the range of the depth lens,
- outside the colour image, since they have no colour and no 2D box can hold them,
- hidden from the colour camera by other points, since they would get the colour of what hides them. From the same
  place, one camera hides nothing from the other.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.geometry.projection import (
    CameraKey,
    camera_key,
    distort_planes,
    pixel_colors,
    pixel_rays,
    require_image_size,
)
from annotator.types import Camera, PointCloud
from annotator.types.errors import GeometryError

# A point is hidden if another one in the same cell of the colour image is nearer by more than this.
HIDDEN_BEHIND_M, HIDDEN_BEHIND_SHARE = 0.01, 0.03
# A cell is so large that a frontal surface has a point in nearly every one.
CELL_DEPTH_PX = 1.5
POINTS_AT_ONCE = 16384


def registered(
    depth_m: Float32[np.ndarray, "h w"],
    depth_camera: Camera,
    T_color_depth: RigidTransform,
    rgb: UInt8[np.ndarray, "H W 3"],
    color_camera: Camera,
) -> tuple[PointCloud, Float32[np.ndarray, "H W"]]:
    """Returns the points of a depth image that the colour camera sees, and the same depth in its pixels.

    Args:
        depth_m: z in the depth camera's frame, metres; zero, negative, NaN and infinite values mean no measurement.
        depth_camera, color_camera: of the images' sizes.
        T_color_depth: from the depth camera's frame to the colour camera's, metres.

    Returns:
        The cloud in the colour camera's frame, in the order of the depth image's pixels. Each point has the colour of
        the nearest pixel. There is no `pixel_index`: a point is not at a pixel's centre, and several may share one.
        It is empty if no point lies in the image.

        The colour camera's z of the nearest point in each pixel, metres; 0 without a point. A coarse depth image
        gives few pixels of a fine colour image, so no neighbours are to be expected.
    """
    if rgb.shape[:2] != (color_camera.height_px, color_camera.width_px):
        raise GeometryError(
            f"the image has {rgb.shape[1]} x {rgb.shape[0]} px, the camera {color_camera.width_px} x "
            f"{color_camera.height_px}; use a calibration for its size"
        )
    xyz_m, pixel = seen_points(depth_m, depth_camera, T_color_depth, color_camera)
    nearest_m = np.full(color_camera.width_px * color_camera.height_px, np.inf, np.float32)
    np.minimum.at(nearest_m, pixel, xyz_m[:, 2])
    nearest_m[np.isinf(nearest_m)] = 0
    return PointCloud(xyz_m, rgb=pixel_colors(rgb, pixel)), nearest_m.reshape(rgb.shape[:2])


def seen_points(
    depth_m: Float32[np.ndarray, "h w"],
    depth_camera: Camera,
    T_color_depth: RigidTransform,
    color_camera: Camera,
    reach: float = np.inf,
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "n"]]:
    """Returns the points of `registered`, and the pixel of each, `v * width + u` in the colour image.

    The image itself is not needed, so it can be decoded in parallel. `reach` is the calibrated radius of the depth
    lens, as distance of (x/z, y/z) from the axis.
    """
    require_image_size(depth_camera, depth_m)
    pose = T_color_depth.as_matrix()
    rays, is_known = _color_rays(camera_key(depth_camera), reach, tuple(pose.ravel()))
    shift_m = pose[:3, 3].astype(np.float32)[:, None]
    depth = depth_m.reshape(-1)
    parts = []
    # some at a time, so that intermediate results stay in the processor's cache: three times as fast
    for first in range(0, len(depth), POINTS_AT_ONCE):
        span = slice(first, first + POINTS_AT_ONCE)
        z_m = depth[span]
        measured = np.flatnonzero((z_m > 0) & (z_m < np.inf) & is_known[span])
        # coordinate by coordinate: faster than indexing rows of three numbers
        xyz_m = np.stack([ray[span].take(measured) for ray in rays])
        xyz_m *= z_m.take(measured)
        xyz_m += shift_m
        parts.append(_inside(color_camera, xyz_m))
    xyz_m, u, v = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    if shift_m.any():
        cell_px = max(round(CELL_DEPTH_PX * color_camera.fx / depth_camera.fx), 1)
        visible = np.flatnonzero(~_hidden(color_camera, cell_px, u, v, xyz_m[2]))
        xyz_m, u, v = xyz_m.take(visible, axis=1), u.take(visible), v.take(visible)
    return np.ascontiguousarray(xyz_m.T), v * np.int32(color_camera.width_px) + u


@lru_cache(maxsize=4)
def _color_rays(
    depth: CameraKey, reach: float, pose: tuple[float, ...]
) -> tuple[Float32[np.ndarray, "3 n"], Bool[np.ndarray, "n"]]:
    """Returns each depth pixel's ray in the colour camera's frame, and whether the pixel is calibrated.

    A ray is the vector to the point at depth 1 m in the depth camera's frame, without the translation.
    """
    xy = pixel_rays(Camera(*depth)).reshape(-1, 2).astype(np.float64)
    # NaN beyond the range of the distortion model compares as false
    is_known = (xy**2).sum(axis=1) <= reach**2
    rays = np.array(pose).reshape(4, 4)[:3, :3] @ np.stack([xy[:, 0], xy[:, 1], np.ones(len(xy))])
    rays = rays.astype(np.float32)
    for each in (rays, is_known):
        each.flags.writeable = False
    return rays, is_known


def _inside(
    camera: Camera, xyz_m: Float32[np.ndarray, "3 n"]
) -> tuple[Float32[np.ndarray, "3 m"], Int32[np.ndarray, "m"], Int32[np.ndarray, "m"]]:
    """Returns the points inside the image, and the column and row of each one's pixel."""
    x, y, z = xyz_m
    # single precision, unlike `project`: an error of 1e-4 px does not matter for colours, and it takes half the time
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u, v = distort_planes(camera.distortion, x / z, y / z)
        u *= np.float32(camera.fx)
        u += np.float32(camera.cx + 0.5)
        v *= np.float32(camera.fy)
        v += np.float32(camera.cy + 0.5)
    inside = np.flatnonzero((z > 0) & (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px))
    return xyz_m.take(inside, axis=1), u.take(inside).astype(np.int32), v.take(inside).astype(np.int32)


def _hidden(
    camera: Camera,
    cell_px: int,
    u: Int32[np.ndarray, "n"],
    v: Int32[np.ndarray, "n"],
    z_m: Float32[np.ndarray, "n"],
) -> Bool[np.ndarray, "n"]:
    """True for each point that is hidden by others in its cell of the image; `u` and `v` are its pixel."""
    across = camera.width_px // cell_px + 1
    cell = v // cell_px * across + u // cell_px
    nearest = np.full(across * (camera.height_px // cell_px + 1), np.inf, np.float32)
    np.minimum.at(nearest, cell, z_m)
    limit = nearest * np.float32(1 + HIDDEN_BEHIND_SHARE) + np.float32(HIDDEN_BEHIND_M)
    return np.asarray(z_m > limit.take(cell))
