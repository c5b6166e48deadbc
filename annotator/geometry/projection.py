"""From metres to pixels and back, with OpenCV's camera model.

Pixels are continuous and the centre of the first pixel is (0, 0), as in `cv2.projectPoints`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from annotator.geometry.distortion import distort, undistort
from annotator.types import Camera
from annotator.types.errors import GeometryError

# All that decides where a pixel looks: width, height, fx, fy, cx, cy, distortion.
CameraKey = tuple[int, int, float, float, float, float, tuple[float, ...]]


def project(camera: Camera, xyz_m: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """Where points appear on the image.

    Args:
        camera: intrinsics and distortion.
        xyz_m: points in the camera frame, metres.

    Returns:
        (n, 2) pixels u, v, not clipped to the image. NaN where z <= 0, where a coordinate is NaN, and where a
        point is further off the axis than the distortion model reaches.
    """
    z = np.asarray(xyz_m[:, 2], np.float64)
    z = np.where(z > 0, z, np.nan)
    # column by column: rows of two and three numbers are slow to walk through
    xy = np.stack([xyz_m[:, 0] / z, xyz_m[:, 1] / z]).T
    if not camera.is_ideal:
        xy = distort(camera.distortion, xy)
    xy *= (camera.fx, camera.fy)
    xy += (camera.cx, camera.cy)
    return xy


def inside_image(camera: Camera, px: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
    """Which pixels (n, 2) lie on the image, whose first and last pixels reach half a pixel beyond their centres."""
    return np.asarray((px >= -0.5).all(axis=1) & (px < np.array([camera.width_px, camera.height_px]) - 0.5).all(axis=1))


def undistort_px(camera: Camera, px: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    """The ideal normalised image coordinates (x/z, y/z) of pixels: the ray of a pixel is (x, y, 1).

    NaN where the distortion model has no inverse (far outside the image).
    """
    xy = (np.asarray(px, np.float64) - np.array([camera.cx, camera.cy])) / np.array([camera.fx, camera.fy])
    return xy if camera.is_ideal else undistort(camera.distortion, xy)


def pixel_rays(camera: Camera) -> Float32[np.ndarray, "h w 2"]:
    """x/z and y/z of the ray through every pixel's centre; read-only, computed once a camera.

    NaN for pixels in a corner that the distortion model does not reach.
    """
    return _pixel_rays(camera_key(camera))


def camera_key(camera: Camera) -> CameraKey:
    """The numbers of a camera: equal cameras have equal keys, so that what is computed once a camera can be kept."""
    return (camera.width_px, camera.height_px, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)


def unproject_depth(
    camera: Camera, depth_m: Float[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "n"]]:
    """The points that a depth image shows.

    Args:
        camera: the camera that the depth is registered to.
        depth_m: (h, w) z in the camera frame, metres; zero, negative, NaN and infinite mean none.

    Returns:
        Points (n, 3) in the camera frame, metres, in row-major order of their pixels; and the pixel of each,
        `v * width + u`.

    Raises:
        GeometryError: the depth image has another size than the camera.
    """
    require_image_size(camera, depth_m)
    rays = pixel_rays(camera)
    depth = np.asarray(depth_m, np.float32)
    usable = (depth > 0) & (depth < np.inf)
    if (reached := _reached(camera_key(camera))) is not None:
        usable &= reached
    index = np.flatnonzero(usable)
    z = depth.reshape(-1).take(index)
    xyz = np.empty((len(index), 3), np.float32)
    xyz[:, :2] = rays.reshape(-1, 2).take(index, axis=0)
    xyz[:, :2] *= z[:, None]
    xyz[:, 2] = z
    return xyz, index.astype(np.int32)


def require_image_size(camera: Camera, depth_m: Float[np.ndarray, "h w"]) -> None:
    """Raises GeometryError where a depth image does not have the camera's size."""
    if depth_m.shape != (camera.height_px, camera.width_px):
        height_px, width_px = depth_m.shape
        raise GeometryError(
            f"the depth image has {width_px} x {height_px} px, the camera {camera.width_px} x {camera.height_px}; "
            "register the depth to the colour camera, or use the calibration of its size"
        )


@lru_cache(maxsize=4)
def _pixel_rays(key: CameraKey) -> Float32[np.ndarray, "h w 2"]:
    camera = Camera(*key)
    u, v = np.meshgrid(np.arange(camera.width_px, dtype=np.float64), np.arange(camera.height_px, dtype=np.float64))
    xy = undistort_px(camera, np.stack([u.reshape(-1), v.reshape(-1)], axis=1))
    rays = xy.reshape(camera.height_px, camera.width_px, 2).astype(np.float32)
    rays.flags.writeable = False
    return rays


@lru_cache(maxsize=4)
def _reached(key: CameraKey) -> Bool[np.ndarray, "h w"] | None:
    """Which pixels have a ray; None where all have one."""
    reached = ~np.isnan(_pixel_rays(key)[..., 0])
    return None if reached.all() else reached
