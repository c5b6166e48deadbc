"""Projection from metres to pixels and back, with OpenCV's camera model; depth images, frustums and thinning of clouds.

Pixels are continuous and the centre of the first pixel is (0, 0), as in `cv2.projectPoints`.

Lens distortion is OpenCV's, on normalised image coordinates (documentation of calib3d, "Detailed Description"; the
tests compare the results). From Python, `cv2.projectPoints` always fills a Jacobian of 36 doubles per point (0.7 s for
a 640 x 480 image), and `cv2.undistortPoints` stops after five steps of a fixed-point iteration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Inexact, Int32, Int64, Shaped, UInt8
from scipy.spatial.transform import Rotation

from annotator.types import Box2D, Camera
from annotator.types.errors import GeometryError

Coefficients = tuple[float, ...]
Plane = Float[np.ndarray, "n"]
Complex = Inexact[np.ndarray, "n"]

NEWTON_STEPS = 20
CONVERGED = 1e-10
STEP = 1e-30j


def distort(coefficients: Coefficients, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """The distorted image coordinates of ideal coordinates (x/z, y/z).

    They have the dtype of `xy`, and are NaN outside the radius up to which the radial model is monotonic. Further out,
    the polynomials decrease again, so points far outside the image would project into it.
    """
    return np.stack(distort_planes(coefficients, xy[:, 0], xy[:, 1]), axis=1)


def distort_planes(coefficients: Coefficients, x: Plane, y: Plane) -> tuple[Plane, Plane]:
    """`distort` on separate coordinates, which is faster for many points."""
    x_out, y_out = _lens(_padded(coefficients), x, y)
    outside = ~(x * x + y * y <= radius_limit_squared(coefficients))
    if outside.any():
        x_out[outside] = y_out[outside] = np.nan
    return x_out, y_out


def undistort(coefficients: Coefficients, xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    """Ideal coordinates (x/z, y/z) of distorted coordinates, by Newton's method; NaN if the model has no inverse."""
    full, limit = _padded(coefficients), radius_limit_squared(coefficients)
    x, y = xy[:, 0].copy(), xy[:, 1].copy()
    error = np.full(len(x), np.inf)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(NEWTON_STEPS):
            _keep_within(x, y, limit)
            # the model is analytic: a tiny imaginary step gives exact derivatives (Squire and Trapp, 1998)
            along_x, along_y = _lens(full, x + STEP, y), _lens(full, x, y + STEP)
            x_error, y_error = along_x[0].real - xy[:, 0], along_x[1].real - xy[:, 1]
            error = np.abs(x_error) + np.abs(y_error)
            if np.nanmax(error, initial=0.0) < CONVERGED:
                break
            (xx, yx), (xy_, yy) = ([part.imag / STEP.imag for part in along] for along in (along_x, along_y))
            determinant = xx * yy - xy_ * yx
            x -= (yy * x_error - xy_ * y_error) / determinant
            y -= (xx * y_error - yx * x_error) / determinant
        lost = ~(error < CONVERGED)
    return np.stack([np.where(lost, np.nan, x), np.where(lost, np.nan, y)], axis=1)


@lru_cache(maxsize=32)
def radius_limit_squared(coefficients: Coefficients) -> float:
    """The squared radius up to which the radial part of the model is monotonic; infinite if there is no limit."""
    k1, k2, _, _, k3, k4, k5, k6 = _padded(coefficients)[:8]
    above = np.polynomial.Polynomial([1.0, k1, k2, k3])
    below = np.polynomial.Polynomial([1.0, k4, k5, k6])
    # d/dr of r * above(r^2) / below(r^2), times below^2, as a polynomial in q = r^2
    growth = above * below + np.polynomial.Polynomial([0.0, 2.0]) * (above.deriv() * below - above * below.deriv())
    # trimmed, because tiny leading coefficients overflow; their roots are far outside the field of view of any lens
    roots = np.concatenate([polynomial.trim(1e-12).roots() for polynomial in (growth, below)])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1.0)) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


def _keep_within(x: Plane, y: Plane, limit: float) -> None:
    """Moves points beyond the radius up to which the model is invertible back inside, in place."""
    radius = x * x + y * y
    outside = radius > limit
    if outside.any():
        shrink = 0.999 * np.sqrt(limit / radius[outside])
        x[outside] *= shrink
        y[outside] *= shrink


def _padded(coefficients: Coefficients) -> Coefficients:
    return coefficients + (0.0,) * (14 - len(coefficients))


def _lens(full: Coefficients, x: Complex, y: Complex) -> tuple[Complex, Complex]:
    """Radial, tangential and thin-prism distortion, and that of a tilted sensor; of real or complex coordinates."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tilt_x_rad, tilt_y_rad = full
    q = x * x + y * y
    factor, doubled = 1.0 + q * (k1 + q * (k2 + q * k3)), 2.0 * x * y
    if k4 or k5 or k6:
        factor = factor / (1.0 + q * (k4 + q * (k5 + q * k6)))
    x_out = x * factor + p1 * doubled + p2 * (q + 2.0 * x * x)
    y_out = y * factor + p1 * (q + 2.0 * y * y) + p2 * doubled
    if s1 or s2 or s3 or s4:
        x_out, y_out = x_out + q * (s1 + q * s2), y_out + q * (s3 + q * s4)
    if tilt_x_rad or tilt_y_rad:
        turn = Rotation.from_euler("xy", [-tilt_x_rad, -tilt_y_rad]).as_matrix()
        onto_plane = np.array([[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]], [0.0, 0.0, 1.0]])
        x_out, y_out, w = onto_plane @ turn @ np.stack([x_out, y_out, np.ones_like(x_out)])
        x_out, y_out = x_out / w, y_out / w
    return x_out, y_out


# width, height, fx, fy, cx, cy, distortion.
CameraKey = tuple[int, int, float, float, float, float, tuple[float, ...]]


def project(camera: Camera, xyz_m: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """The pixels u, v of points (camera frame, metres), not clipped to the image.

    NaN for z <= 0, for NaN coordinates, and for points outside the range of the distortion model.
    """
    z = np.asarray(xyz_m[:, 2], np.float64)
    z = np.where(z > 0, z, np.nan)
    # column by column, which is faster than with rows of two or three numbers
    xy = np.stack([xyz_m[:, 0] / z, xyz_m[:, 1] / z]).T
    if not camera.is_ideal:
        xy = distort(camera.distortion, xy)
    xy *= (camera.fx, camera.fy)
    xy += (camera.cx, camera.cy)
    return xy


def inside_image(camera: Camera, px: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
    """Which pixels (n, 2) lie on the image, which extends half a pixel beyond the centres of its border pixels."""
    return np.asarray((px >= -0.5).all(axis=1) & (px < np.array([camera.width_px, camera.height_px]) - 0.5).all(axis=1))


def undistort_px(camera: Camera, px: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    """The ideal normalised image coordinates (x/z, y/z) of pixels: the ray of a pixel is (x, y, 1).

    NaN if the distortion model has no inverse there (far outside the image).
    """
    xy = (np.asarray(px, np.float64) - np.array([camera.cx, camera.cy])) / np.array([camera.fx, camera.fy])
    return xy if camera.is_ideal else undistort(camera.distortion, xy)


def pixel_rays(camera: Camera) -> Float32[np.ndarray, "h w 2"]:
    """x/z and y/z of the ray through every pixel's centre; read-only, cached per camera.

    NaN for pixels outside the range of the distortion model.
    """
    return _pixel_rays(camera_key(camera))


def resized(camera: Camera, width_px: int, height_px: int) -> Camera:
    """The same camera with images of another size, which show the same part of the scene."""
    # pixel (0, 0) is half a pixel from the image's corner, at any size
    x, y = width_px / camera.width_px, height_px / camera.height_px
    cx, cy = (camera.cx + 0.5) * x - 0.5, (camera.cy + 0.5) * y - 0.5
    return Camera(width_px, height_px, camera.fx * x, camera.fy * y, cx, cy, camera.distortion)


def camera_key(camera: Camera) -> CameraKey:
    """A hashable key of a camera, for caches; equal cameras have equal keys."""
    return (camera.width_px, camera.height_px, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)


def unproject_depth(
    camera: Camera, depth_m: Float[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "n"]]:
    """The points of a depth image, (h, w) z in the frame of the camera to which it is registered, metres.

    Zero, negative, NaN and infinite values mean no measurement.

    Returns:
        Points (n, 3) in the camera frame, metres, in row-major order of their pixels; and the pixel of each,
        `v * width + u`.
    """
    from annotator.geometry.kernels import depth_points

    require_image_size(camera, depth_m)
    depth = np.ascontiguousarray(depth_m, np.float32).reshape(-1)
    return depth_points(depth, *_ray_columns(camera_key(camera)))


def pixel_colors(rgb: UInt8[np.ndarray, "h w 3"], pixel: Int32[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    """The colours of an image at pixels, which are given by `v * width + u`."""
    # several times as fast as by an index in brackets
    return np.ascontiguousarray(rgb).reshape(-1, 3).take(pixel, axis=0)


def straightened(camera: Camera, rgb: UInt8[np.ndarray, "h w 3"]) -> tuple[Camera, UInt8[np.ndarray, "h w 3"]]:
    """The ideal camera with the same matrix and size, and the image resampled for this camera (bilinear).

    Pixels whose rays lie outside the original image, or outside the range of its distortion model, are black. Without
    distortion, the arguments are returned unchanged.
    """
    if camera.is_ideal:
        return camera, rgb
    import cv2

    ideal = replace(camera, distortion=())
    plane = pixel_rays(ideal).reshape(-1, 2)
    px = project(camera, np.column_stack([plane, np.ones(len(plane), np.float32)]))
    # NaN outside the distortion model; cv2.remap does not accept NaN
    where = np.nan_to_num(px, nan=-1e6).reshape(*rgb.shape[:2], 2).astype(np.float32)
    straight = cv2.remap(np.ascontiguousarray(rgb), where[..., 0], where[..., 1], cv2.INTER_LINEAR)
    return ideal, np.asarray(straight, np.uint8)


def require_image_size(camera: Camera, depth_m: Float[np.ndarray, "h w"]) -> None:
    """Raises GeometryError if a depth image does not have the camera's size."""
    if depth_m.shape != (camera.height_px, camera.width_px):
        height_px, width_px = depth_m.shape
        raise GeometryError(
            f"the depth image has {width_px} x {height_px} px, the camera {camera.width_px} x {camera.height_px}; "
            "register the depth to the colour camera, or use a calibration for its size"
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
def _ray_columns(key: CameraKey) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    rays = _pixel_rays(key).reshape(-1, 2)
    return rays[:, 0].copy(), rays[:, 1].copy()


# The highest numbers of 16 bits and of half precision: saturated, or "no data". Other types hold converted ones.
SATURATED = (65504, 65535)


def measured(values: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """True where raw depths of any type are measurements: positive, finite, and not the highest of a type."""
    if values.dtype.kind == "f":
        values = values.astype(np.float32, copy=False)
    found = (values > 0) & (values != SATURATED[0]) & (values != SATURATED[1])
    if values.dtype.kind == "f":
        return np.asarray(found & (values < np.inf))
    return np.asarray(found & (values != np.iinfo(values.dtype).max))


def in_metres(values: np.ndarray, units_per_m: float) -> Float32[np.ndarray, "h w"]:
    """Returns raw depths, of any integer or float type, in metres, 0 where there is no measurement (`measured`)."""
    with np.errstate(all="ignore"):
        depth_m = np.divide(values, np.float32(units_per_m), dtype=np.float32, casting="unsafe")
    depth_m[~measured(values)] = 0
    return np.asarray(depth_m)


def in_frustum(camera: Camera, xyz_m: Float[np.ndarray, "n 3"], box: Box2D) -> Bool[np.ndarray, "n"]:
    """Which points (camera frame, metres) project into a 2D box, edges included; it may extend beyond the image.

    Points behind the camera (z <= 0) and NaN points are outside.
    """
    return in_frustums(camera, xyz_m, [box])[0]


def in_frustums(camera: Camera, xyz_m: Float[np.ndarray, "n 3"], boxes: Sequence[Box2D]) -> list[Bool[np.ndarray, "n"]]:
    """As `in_frustum`, for several boxes on one image; the points are projected once."""
    if not boxes:
        return []
    u, v = project(camera, xyz_m).T
    # comparisons with NaN are false, so points that cannot be projected are outside
    return [(u >= box.x_min) & (u <= box.x_max) & (v >= box.y_min) & (v <= box.y_max) for box in boxes]


# Arbitrary, but fixed, so that a frame is always drawn with the same points.
SEED = 20231


def thin(n_points: int, most: int) -> Int64[np.ndarray, "m"] | None:
    """Indices of the points to keep, ascending; None = all.

    The cloud is divided into `most` runs of equal length, and one random point of each is kept. Consecutive points of a
    scan or an image are neighbours, so the cloud is thinned evenly. The time does not depend on the cloud's size.
    """
    if n_points <= most:
        return None
    edges = np.arange(most + 1, dtype=np.int64) * n_points // most
    return edges[:-1] + (_positions(most) * np.diff(edges)).astype(np.int64)


def every_nth(values: Shaped[np.ndarray, "n *rest"], most: int) -> Shaped[np.ndarray, "k *rest"]:
    return values if len(values) <= most else values[np.linspace(0, len(values) - 1, most).astype(np.intp)]


@lru_cache(maxsize=8)
def _positions(most: int) -> Float64[np.ndarray, "m"]:
    """The position of each kept point within its run, 0..1."""
    return np.random.default_rng(SEED).random(most)
