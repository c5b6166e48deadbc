"""Makes frames from arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.api.inputs import camera_of, depth_of, image_of, points_of, transform_of, up_of
from annotator.geometry.projection import inside_image, pixel_colors, project, unproject_depth
from annotator.recordings.clouds.virtual_camera import world_pose
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import ArgumentError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
else:
    # run-time type checks reject a tuple of numbers as an ArrayLike; `inputs` checks the arguments instead
    ArrayLike = Any

# Nearer points are dropped: they belong to the sensor's housing.
NEAREST_Z_M = 0.1
# A cloud with a smaller share of its points on the image is rejected: its transform or the intrinsics must be wrong.
LEAST_SHARE_ON_IMAGE = 0.01
Intrinsics = ArrayLike | Camera
"""A matrix K (3, 3), the numbers (fx, fy, cx, cy), or a `Camera`; pixels, with the centre of the first at (0, 0)."""


def frame_from_rgbd(
    rgb: ArrayLike,
    depth: ArrayLike,
    intrinsics: Intrinsics,
    *,
    depth_scale: float | None = None,
    distortion: Sequence[float] = (),
    up: ArrayLike | None = None,
    key: str = "frame",
    index: int = 0,
    timestamp_ns: int | None = None,
) -> Frame:
    """A frame of an RGB-D camera.

    Args:
        rgb: (H, W, 3) in RGB order: uint8, or floats in 0..1, which are converted to uint8. The single channel of a
            grey image is repeated three times, and a fourth channel is dropped. The order of the channels cannot be
            checked: convert BGR (OpenCV) with `rgb[..., ::-1]`.
        depth: (H, W) z of each pixel of the image; 0, NaN, infinity, and 65504 and 65535 (saturated) mean no depth.
            Without `depth_scale`, floats are metres and integers millimetres.
        intrinsics: of the camera that took the image; the depth must be registered to it.
        depth_scale: units per metre, such as 1000 for millimetres or 5000 for the TUM datasets.
        distortion: OpenCV's coefficients, as in `Camera`.
        up: (3,) direction against gravity in the camera frame (x right, y down, z forward), if known. Boxes are then
            upright, unless `rotation` is free.
        key: the frame's name, which appears in results.
        index: its position in the recording, from 0.
        timestamp_ns: capture time.

    Raises:
        ArgumentError: an argument with a wrong shape, type or unit, or a depth image in which no pixel has a depth.
    """
    image = image_of(rgb)
    camera = camera_of(intrinsics, image.shape, distortion)
    depth_m = depth_of(depth, depth_scale, image.shape)
    xyz_m, pixel_index = unproject_depth(camera, depth_m)
    cloud = PointCloud(xyz_m, rgb=pixel_colors(image, pixel_index), pixel_index=pixel_index)
    return Frame(key, index, camera, image, cloud, depth_m, up_of(up), None, timestamp_ns)


def frame_from_points(
    rgb: ArrayLike,
    xyz_m: ArrayLike,
    intrinsics: Intrinsics,
    T_camera_points: ArrayLike | RigidTransform | None = None,
    *,
    reflectance: ArrayLike | None = None,
    distortion: Sequence[float] = (),
    up: ArrayLike | None = None,
    key: str = "frame",
    index: int = 0,
    timestamp_ns: int | None = None,
) -> Frame:
    """A frame from a camera image and a point cloud, such as a LiDAR scan.

    Points that are not finite or exactly (0, 0, 0), nearer than 0.1 m, or outside the image are dropped. The others get
    the colour of their pixel.

    Args:
        rgb, intrinsics, distortion, up, key, index, timestamp_ns: as for `frame_from_rgbd`.
        xyz_m: (N, 3) points, metres.
        T_camera_points: (4, 4) from the frame of the points to the camera's (x right, y down, z forward):
            `p_camera = T @ p_points`. None: they are in the camera's frame already.
        reflectance: (N,) in 0..1.

    Raises:
        ArgumentError: an argument with a wrong shape, type or unit, a transform that is not rigid, or a cloud with
            less than 1% of its points on the image.
    """
    image = image_of(rgb)
    camera = camera_of(intrinsics, image.shape, distortion)
    T = transform_of(T_camera_points)
    points, rows = points_of(xyz_m, T)
    seen, px = _on_image(camera, T.apply(points))
    if len(seen) < max(LEAST_SHARE_ON_IMAGE * len(points), 1):
        raise ArgumentError(_why_unseen(camera, points, T, len(seen)))
    cloud = PointCloud(
        T.apply(points)[seen].astype(np.float32),
        rgb=image[px[:, 1], px[:, 0]],
        reflectance=None if reflectance is None else _reflectance(reflectance, np.shape(xyz_m)[0])[rows[seen]],
    )
    return Frame(key, index, camera, image, cloud, None, up_of(up), None, timestamp_ns, T_world_camera=world_pose(T))


def _on_image(camera: Camera, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The indices (k,) of the points that lie on the image, and their pixels (k, 2)."""
    px = project(camera, xyz_m)
    seen = np.flatnonzero(inside_image(camera, px) & (xyz_m[:, 2] > NEAREST_Z_M))
    return seen, np.floor(px[seen] + 0.5).astype(np.int64)


def _why_unseen(camera: Camera, points: np.ndarray, T: RigidTransform, seen: int) -> str:
    in_front = int((T.apply(points)[:, 2] > 0).sum())
    what = f"only {seen} of {len(points)} points lie on the image, {in_front} are in front of the camera"
    if len(_on_image(camera, T.inv().apply(points))[0]) > 10 * max(seen, 1):
        return f"{what}; T_camera_points is inverted: p_camera = T @ p_points"
    return f"{what}; check T_camera_points (camera: x right, y down, z forward; LiDARs have z up) and the intrinsics"


def _reflectance(values: ArrayLike, points: int) -> np.ndarray:
    array = np.asarray(values, np.float32)
    if array.shape != (points,):
        raise ArgumentError(f"reflectance must have shape ({points},), one value per point, not {array.shape}")
    if not (array >= 0).all() or float(array.max(initial=0)) > 1:
        raise ArgumentError("reflectance must be in 0..1; divide it by the largest value of its sensor")
    return array
