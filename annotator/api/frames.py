"""Makes frames from arrays that callers pass; ambiguous ones are rejected."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.geometry.projection import inside_image, measured, pixel_colors, project, unproject_depth
from annotator.recordings.clouds.virtual_camera import world_pose
from annotator.recordings.plausible import are_returns
from annotator.types import Box2D, Camera, Frame, PointCloud
from annotator.types.errors import ArgumentError

# Depths with a larger median cannot be metres, since no RGB-D camera reaches so far; they are probably millimetres.
LONGEST_MEDIAN_DEPTH_M = 200.0
# If no integer depth is larger, the values are rejected: they are probably rounded metres, not millimetres.
LARGEST_ROUNDED_M = 100
# Points with a larger median distance cannot be in metres, since no LiDAR reaches so far.
LONGEST_MEDIAN_RANGE_M = 1000.0
MILLIMETRES_PER_METRE = 1000.0
# Minimum focal length as a fraction of the longer side of the image; it gives a field of view of 170 degrees.
LEAST_FOCAL_SHARE = 0.04
# Tolerance for R R^T = identity; calibration files hold rounded matrices.
MOST_OFF_ROTATION = 1e-3


Choice = TypeVar("Choice", bound=StrEnum)


def choice(name: str, given: str, kinds: type[Choice]) -> Choice:
    """The member of an enumeration that a caller gives by its value."""
    try:
        return kinds(given)
    except ValueError as error:
        raise ArgumentError(f"{name} must be one of {', '.join(kinds)}, not {given!r}") from error


def _numbers(name: str, given: Any) -> Float64[np.ndarray, "..."]:
    try:
        return np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} must be numbers: {error}") from error


def image_of(rgb: Any) -> UInt8[np.ndarray, "h w 3"]:
    """An image as (H, W, 3) uint8.

    Raises:
        ArgumentError: a wrong shape or type, or values out of range.
    """
    image = np.asarray(rgb)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4) or 0 in image.shape:
        raise ArgumentError(f"rgb must have shape (H, W, 3), not {image.shape}; for (3, H, W): np.moveaxis(rgb, 0, -1)")
    if np.issubdtype(image.dtype, np.floating) and image.min() >= 0 and image.max() <= 1:
        image = np.rint(image * 255).astype(np.uint8)
    elif image.dtype != np.uint8:
        values = f" and values from {image.min():g} to {image.max():g}" if image.dtype.kind == "f" else ""
        raise ArgumentError(
            f"rgb has the type {image.dtype}{values}; pass uint8 in 0..255 (rgb.astype(np.uint8)), or floats in 0..1, "
            "none of them NaN"
        )
    return np.ascontiguousarray(np.broadcast_to(image[..., :3], (*image.shape[:2], 3)))


def camera_of(intrinsics: Any, image_shape: Sequence[int], distortion: Sequence[float] = ()) -> Camera:
    """The camera of an image, from a `Camera`, (fx, fy, cx, cy) or a matrix K.

    Raises:
        ArgumentError: the values cannot belong to a camera with images of this size.
    """
    height, width = image_shape[:2]
    if isinstance(intrinsics, Camera):
        if (intrinsics.width_px, intrinsics.height_px) != (width, height):
            raise ArgumentError(
                f"the camera has {intrinsics.width_px} x {intrinsics.height_px} px, the image {width} x {height}"
            )
        if len(distortion):
            raise ArgumentError("distortion is given twice; set it only in the Camera")
        return intrinsics
    K = _numbers("intrinsics", intrinsics)
    values = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) if K.shape == (3, 3) else K
    if values.shape != (4,) or not np.isfinite(values).all():
        raise ArgumentError(f"intrinsics must be finite: (fx, fy, cx, cy) or a matrix K (3, 3), not of shape {K.shape}")
    fx, fy, cx, cy = values.tolist()
    if K.shape == (3, 3) and not np.array_equal(K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]):
        raise ArgumentError(
            f"the rows of the intrinsic matrix must be fx 0 cx, 0 fy cy and 0 0 1, not {K.tolist()}: pass K.T if it is "
            "transposed, and an image that is rectified without skew"
        )
    if min(fx, fy) < LEAST_FOCAL_SHARE * max(width, height):
        raise ArgumentError(
            f"focal lengths of {fx:g} and {fy:g} px do not fit an image of {width} x {height} px; pass them in "
            "pixels, not in millimetres, metres or fractions of the image size"
        )
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise ArgumentError(
            f"the principal point ({cx:g}, {cy:g}) lies outside the image of {width} x {height} px; check "
            "the resolution and the order fx, fy, cx, cy; for a cropped image, pass a Camera"
        )
    try:
        return Camera(width, height, fx, fy, cx, cy, tuple(float(value) for value in distortion))
    except ValueError as error:
        raise ArgumentError(str(error)) from error


def depth_of(depth: Any, depth_scale: float | None, image_shape: Sequence[int]) -> Float32[np.ndarray, "h w"]:
    """A depth image in metres, 0 where a pixel has no depth.

    Raises:
        ArgumentError: a size other than the image's, an ambiguous unit, or no pixel with a depth.
    """
    values = np.asarray(depth)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.shape != tuple(image_shape[:2]):
        raise ArgumentError(
            f"depth has shape {values.shape}, the image {tuple(image_shape[:2])}; register the depth to the image"
        )
    if not (np.issubdtype(values.dtype, np.floating) or np.issubdtype(values.dtype, np.integer)):
        raise ArgumentError(f"depth has the type {values.dtype}; pass floats in metres, or whole millimetres")
    if depth_scale is not None and not (np.isfinite(depth_scale) and depth_scale > 0):
        raise ArgumentError(f"depth_scale must be positive (units per metre), not {depth_scale}")
    with np.errstate(invalid="ignore"):
        lowest = values.min(where=np.isfinite(values), initial=0)
    if lowest < 0:
        raise ArgumentError(f"depth has negative values (down to {lowest:g}); z points away from the camera")
    usable = measured(values)
    if not usable.any():
        raise ArgumentError("no pixel has a depth: all are 0, NaN, infinite, or the highest of 16 bits")
    known = values[usable]
    if depth_scale is None:
        depth_scale = _guessed_scale(known)
    metres = np.zeros(values.shape, np.float32)
    metres[usable] = known / depth_scale
    return metres


def _guessed_scale(known: np.ndarray) -> float:
    if np.issubdtype(known.dtype, np.integer):
        if known.max() <= LARGEST_ROUNDED_M:
            raise ArgumentError(
                f"depth holds integers up to {known.max()}, too small for millimetres; pass floats in metres, or "
                "depth_scale, the units per metre"
            )
        return MILLIMETRES_PER_METRE
    median = float(np.median(known))
    if median > LONGEST_MEDIAN_DEPTH_M:
        raise ArgumentError(
            f"depth holds floats with a median of {median:g}, too large for metres; pass metres, or "
            "depth_scale=1000 for millimetres"
        )
    return 1.0


def points_of(xyz_m: Any, T_camera_points: RigidTransform) -> tuple[Float64[np.ndarray, "n 3"], np.ndarray]:
    """The points of an array (N, 3) that are returns (`are_returns`), and the indices of their rows.

    Args:
        T_camera_points: to the camera, since map coordinates are large in metres, too.

    Raises:
        ArgumentError: a wrong shape, no finite point, or points that seem to be in millimetres.
    """
    points = _numbers("xyz_m", xyz_m)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ArgumentError(
            f"xyz_m must have shape (N, 3), not {points.shape}; for (3, N): xyz.T; for rows and columns: "
            "xyz.reshape(-1, 3); for more numbers per point: xyz[:, :3], the fourth as reflectance"
        )
    rows = np.flatnonzero(are_returns(points))
    if not len(rows):
        raise ArgumentError("xyz_m has no finite point other than (0, 0, 0)")
    points = points[rows]
    median_m = float(np.median(np.linalg.norm(T_camera_points.apply(points), axis=1)))
    if median_m > LONGEST_MEDIAN_RANGE_M:
        raise ArgumentError(
            f"xyz_m has a median distance of {median_m:g} from the camera, too large for metres; pass metres, not "
            "millimetres, and for map coordinates the T_camera_points from the map to the camera"
        )
    return points, rows


def transform_of(transform: Any) -> RigidTransform:
    """A rigid transform from a matrix (4, 4); None is the identity.

    Raises:
        ArgumentError: the matrix is not a rigid transform, e.g. because it mirrors, scales or is transposed.
    """
    name = "T_camera_points"
    if transform is None:
        return RigidTransform.identity()
    if isinstance(transform, RigidTransform):
        if not transform.single:
            raise ArgumentError(f"{name} must be one transform, not a stack")
        return transform
    matrix = _numbers(name, transform)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or tuple(matrix[3]) != (0, 0, 0, 1):
        raise ArgumentError(
            f"{name} must be a finite matrix (4, 4) whose last row is 0 0 0 1; if it is transposed, T.T"
        )
    R = matrix[:3, :3]
    if np.linalg.det(R) < 0 or np.abs(R @ R.T - np.eye(3)).max() > MOST_OFF_ROTATION:
        raise ArgumentError(
            f"{name} is not rigid (determinant {np.linalg.det(R):.3g}): pass a rotation and a translation, which "
            "neither mirror (a wrong sign of an axis) nor scale"
        )
    return RigidTransform.from_matrix(matrix)


def up_of(up: Any) -> Float64[np.ndarray, "3"] | None:
    """A direction as a unit vector; None stays None.

    Raises:
        ArgumentError: not three finite numbers, or all of them are 0.
    """
    if up is None:
        return None
    vector = np.asarray(up, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.linalg.norm(vector) > 0:
        raise ArgumentError(f"up must be a direction (x, y, z) against gravity in the camera frame, not {up!r}")
    return np.asarray(vector / np.linalg.norm(vector))


def require_on_image(boxes: Sequence[Any], camera: Camera) -> None:
    """Raises ArgumentError for anything that is not a `Box2D`, and for a box outside the image."""
    for box in boxes:
        if not isinstance(box, Box2D):
            raise ArgumentError(f"image boxes must be Box2D, not {type(box).__name__}")
        if max(map(abs, box.xyxy)) <= 1 and max(camera.width_px, camera.height_px) > 2:
            raise ArgumentError(f"the box {box.xyxy} has edges in 0..1; pass them in pixels")
        if box.x_max < 0 or box.y_max < 0 or box.x_min > camera.width_px or box.y_min > camera.height_px:
            raise ArgumentError(
                f"the box {box.xyxy} lies outside the image of {camera.width_px} x {camera.height_px} px; edges are "
                "x_min, y_min, x_max, y_max in pixels"
            )


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
        in_front = int((T.apply(points)[:, 2] > 0).sum())
        raise ArgumentError(
            f"only {len(seen)} of {len(points)} points lie on the image, {in_front} are in front of the camera; check "
            "T_camera_points (p_camera = T @ p_points, not its inverse; camera: x right, y down, z forward) and "
            "the intrinsics; LiDARs have z up"
        )
    cloud = PointCloud(
        T.apply(points)[seen].astype(np.float32),
        rgb=image[px[:, 1], px[:, 0]],
        reflectance=None if reflectance is None else _reflectance(reflectance, np.shape(xyz_m)[0])[rows[seen]],
    )
    world = world_pose(T)
    ups, in_map = up_of(up), world is not None
    return Frame(key, index, camera, image, cloud, None, ups, None, timestamp_ns, T_world_camera=world, in_map=in_map)


def _on_image(camera: Camera, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The indices (k,) of the points that lie on the image, and their pixels (k, 2)."""
    px = project(camera, xyz_m)
    seen = np.flatnonzero(inside_image(camera, px) & (xyz_m[:, 2] > NEAREST_Z_M))
    return seen, np.floor(px[seen] + 0.5).astype(np.int64)


def _reflectance(values: ArrayLike, points: int) -> np.ndarray:
    array = np.asarray(values, np.float32)
    if array.shape != (points,):
        raise ArgumentError(f"reflectance must have shape ({points},), one value per point, not {array.shape}")
    if not (array >= 0).all() or float(array.max(initial=0)) > 1:
        raise ArgumentError("reflectance must be in 0..1; divide it by the largest value of its sensor")
    return array
