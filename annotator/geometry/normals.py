"""Surface normals of a depth image or of unordered points, towards the sensor."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree

from annotator.geometry.projection import CameraKey, camera_key, pixel_rays, require_image_size
from annotator.types import Camera
from annotator.types.errors import GeometryError

# The window of the plane fit: 5 x 5 samples at every second pixel, 9 x 9 pixels in total. It is wide enough to average
# a depth camera's millimetre steps, and narrow enough for a finger at half a metre.
OFFSETS_PX = (-4, -2, 0, 2, 4)
REACH_PX = max(OFFSETS_PX)

# A neighbour belongs to another surface if its depth differs by more than MAX_SLOPE (68 degrees off the image plane)
# times its lateral distance, plus NOISE (for the sensor) times the depth.
MAX_SLOPE = 2.5
NOISE = 0.003

# A fit is used if its neighbours spread in both directions: minimum determinant of their second moments, as a share of
# that of an isotropic cloud.
SPREAD = 0.1

# Rows per pass, so that the arrays fit into the processor's cache.
ROWS = 32


def normals_from_depth(camera: Camera, depth_m: Float[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
    """Unit normals of a depth image, in the camera frame, towards the camera, from a plane fitted around each pixel.

    On a plane, the inverse depth is linear in the image coordinates. So the least-squares slope of 1/z over a window
    gives the plane. Neighbours across a depth step are left out, which keeps edges sharp. Zero without depth, or with
    too few neighbours on the same surface.

    Args:
        camera: the camera to which the depth is registered; distortion is taken into account.
        depth_m: z in the camera frame, metres; zero, negative, NaN and infinite values mean no measurement.
    """
    require_image_size(camera, depth_m)
    height_px, width_px = depth_m.shape
    usable = np.isfinite(depth_m) & (depth_m > 0)
    inverse = np.zeros((height_px + 2 * REACH_PX, width_px + 2 * REACH_PX), np.float32)
    inside = inverse[REACH_PX:-REACH_PX, REACH_PX:-REACH_PX]
    np.divide(1.0, depth_m, out=inside, where=usable, casting="same_kind")
    rays = pixel_rays(camera)
    per_px = np.broadcast_to(px_per_ray(camera), (height_px, width_px, 2, 2))
    normals = np.empty((height_px, width_px, 3), np.float32)
    for top in range(0, height_px, ROWS):
        rows = slice(top, min(top + ROWS, height_px))
        slope_u, slope_v = _slopes(inverse[top : rows.stop + 2 * REACH_PX], MAX_SLOPE / min(camera.fx, camera.fy))
        normals[rows] = _plane_normals(inside[rows], slope_u, slope_v, rays[rows], per_px[rows])
    return normals


def normals_knn(xyz_m: Float[np.ndarray, "n 3"], k: int = 16) -> Float32[np.ndarray, "n 3"]:
    """Normals of unordered points: the direction of least spread of the `k` points nearest to each, itself included.

    Returns:
        unit normals, towards the sensor at the origin; zero if the neighbours lie on a line or at one point, and for
        fewer than three points.

    Raises:
        GeometryError: a coordinate is not finite, or `k` is below 3.
    """
    if k < 3:
        raise GeometryError(f"a normal needs at least 3 neighbours, not k = {k}")
    if not np.isfinite(xyz_m).all():
        raise GeometryError("normals need finite points; drop the invalid ones first")
    if len(xyz_m) < 3:
        return np.zeros(xyz_m.shape, np.float32)
    xyz = np.asarray(xyz_m, np.float64)
    _, neighbours = cKDTree(xyz, balanced_tree=False).query(xyz, k=min(k, len(xyz)))
    around = xyz[neighbours]
    around -= around.mean(axis=1, keepdims=True)
    spread, directions = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)
    normals = directions[:, :, 0]
    normals *= -np.sign(np.einsum("ni,ni->n", normals, xyz) + 1e-300)[:, None]
    # eigenvalues are squared lengths; below this limit, the second direction is rounding error
    known = spread[:, 1] > 1e-12 * spread[:, 2] + 1e-24
    return np.where(known[:, None], normals, 0.0).astype(np.float32)


def _slopes(
    padded: Float32[np.ndarray, "_a _b"], step_per_px: float
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Least-squares slopes along u and v, per pixel, of an inverse depth with a margin of REACH_PX; NaN if unknown.

    `step_per_px` is the allowed difference in depth to a neighbour, share of the depth per pixel of distance.
    """
    rows, columns = padded.shape[0] - 2 * REACH_PX, padded.shape[1] - 2 * REACH_PX
    center = padded[REACH_PX : REACH_PX + rows, REACH_PX : REACH_PX + columns]
    squares = {du * du + dv * dv for du in OFFSETS_PX for dv in OFFSETS_PX}
    # below 1, so that missing neighbours, with an inverse depth of 0, are always excluded
    shares = {square: min(step_per_px * square**0.5 + NOISE, 0.5) for square in squares}
    limits = {square: np.float32(share) * center for square, share in shares.items()}
    uu, uv, vv, ud, vd = (np.zeros((rows, columns), np.float32) for _ in range(5))
    for dv in OFFSETS_PX:
        for du in OFFSETS_PX:
            if du == dv == 0:
                continue
            shifted = padded[REACH_PX + dv : REACH_PX + dv + rows, REACH_PX + du : REACH_PX + du + columns]
            difference = shifted - center
            same = (np.abs(difference) <= limits[du * du + dv * dv]).astype(np.float32)
            difference *= same
            if du:
                uu += np.float32(du * du) * same
                ud += np.float32(du) * difference
            if dv:
                vv += np.float32(dv * dv) * same
                vd += np.float32(dv) * difference
            if du and dv:
                uv += np.float32(du * dv) * same
    determinant = uu * vv - uv * uv
    trusted = determinant > SPREAD * 0.25 * (uu + vv) ** 2
    safe = np.where(trusted & (center > 0), determinant, np.float32(np.nan))
    return (vv * ud - uv * vd) / safe, (uu * vd - uv * ud) / safe


def _plane_normals(
    inverse: Float32[np.ndarray, "h w"],
    slope_u: Float32[np.ndarray, "h w"],
    slope_v: Float32[np.ndarray, "h w"],
    rays: Float32[np.ndarray, "h w 2"],
    per_px: Float32[np.ndarray, "h w 2 2"],
) -> Float32[np.ndarray, "h w 3"]:
    """Unit normals from the slopes of the inverse depth.

    A plane n.p = 1 has 1/z = n.(x, y, 1). So the first two components of n are the slopes of 1/z along x and y, and
    the third is the value at (0, 0). Since n.p > 0, -n points towards the camera.
    """
    along_x = per_px[..., 0, 0] * slope_u + per_px[..., 1, 0] * slope_v
    along_y = per_px[..., 0, 1] * slope_u + per_px[..., 1, 1] * slope_v
    rest = inverse - rays[..., 0] * along_x - rays[..., 1] * along_y
    scale = -1.0 / np.sqrt(along_x * along_x + along_y * along_y + rest * rest)
    normals = np.stack([along_x * scale, along_y * scale, rest * scale], axis=-1)
    return np.nan_to_num(normals, copy=False, nan=0.0)


def px_per_ray(camera: Camera) -> Float32[np.ndarray, "_h _w 2 2"]:
    """Derivatives of the pixel coordinates (u, v; third axis) with respect to the ray's x, y (last axis).

    (1, 1, 2, 2) for an ideal camera, otherwise one matrix per pixel.
    """
    if camera.is_ideal:
        return np.array([[[[camera.fx, 0.0], [0.0, camera.fy]]]], np.float32)
    return _distorted_px_per_ray(camera_key(camera))


@lru_cache(maxsize=4)
def _distorted_px_per_ray(key: CameraKey) -> Float32[np.ndarray, "h w 2 2"]:
    rays = pixel_rays(Camera(*key)).astype(np.float64)
    along_v, along_u = np.gradient(rays, axis=(0, 1))
    ray_per_px = np.stack([along_u, along_v], axis=-1)
    broken = ~np.isfinite(ray_per_px).all(axis=(-1, -2))
    ray_per_px[broken] = np.eye(2)
    per_px = np.linalg.inv(ray_per_px)
    per_px[broken] = np.nan
    return per_px.astype(np.float32)
