"""OpenCV's lens distortion and its inverse, on normalised image coordinates.

`cv2.projectPoints` computes the same, but from Python it always fills a Jacobian of 36 doubles per point (0.7 s for a
640 x 480 image), and `cv2.undistortPoints` stops after five steps of a fixed-point iteration. The model is described in
OpenCV's documentation of the calib3d module ("Detailed Description"); the tests compare the results.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64

Coefficients = tuple[float, ...]
Plane = Float[np.ndarray, "n"]

NEWTON_STEPS = 20
CONVERGED = 1e-10


def distort(coefficients: Coefficients, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """The distorted image coordinates of ideal coordinates (x/z, y/z).

    Returns:
        distorted normalised coordinates, with the dtype of `xy`; NaN outside the radius up to which the radial model is
        monotonic. Further out, the polynomials decrease again, so points far outside the image would project into it.
    """
    return np.stack(distort_planes(coefficients, xy[:, 0], xy[:, 1]), axis=1)


def distort_planes(coefficients: Coefficients, x: Plane, y: Plane) -> tuple[Plane, Plane]:
    """`distort` on separate coordinates, which is faster for many points."""
    full = _padded(coefficients)
    x_out, y_out = _lens(full, x, y)
    if full[12] or full[13]:
        x_out, y_out = _apply(_tilt_matrix(full[12], full[13]), x_out, y_out)
    outside = ~(x * x + y * y <= radius_limit_squared(coefficients))
    if outside.any():
        x_out[outside] = y_out[outside] = np.nan
    return x_out, y_out


def undistort(coefficients: Coefficients, xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    """Ideal coordinates (x/z, y/z) of distorted coordinates, by Newton's method; NaN if the model has no inverse."""
    full = _padded(coefficients)
    x_goal, y_goal = xy[:, 0], xy[:, 1]
    if full[12] or full[13]:
        x_goal, y_goal = _apply(np.linalg.inv(_tilt_matrix(full[12], full[13])), x_goal, y_goal)
    x, y = x_goal.copy(), y_goal.copy()
    error = np.full(len(x), np.inf)
    limit = radius_limit_squared(coefficients)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(NEWTON_STEPS):
            _keep_within(x, y, limit)
            x_now, y_now = _lens(full, x, y)
            x_error, y_error = x_now - x_goal, y_now - y_goal
            error = np.abs(x_error) + np.abs(y_error)
            if np.nanmax(error, initial=0.0) < CONVERGED:
                break
            xx, xy_, yx, yy = _lens_jacobian(full, x, y)
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


def _radial(full: Coefficients, q: Plane) -> Plane:
    """The radial factor at q = r^2."""
    k1, k2, _, _, k3, k4, k5, k6 = full[:8]
    above = 1.0 + q * (k1 + q * (k2 + q * k3))
    return above / (1.0 + q * (k4 + q * (k5 + q * k6))) if k4 or k5 or k6 else above


def _radial_slope(full: Coefficients, q: Plane, factor: Plane) -> Plane:
    """The derivative of the radial factor with respect to q."""
    k1, k2, _, _, k3, k4, k5, k6 = full[:8]
    slope = k1 + q * (2.0 * k2 + q * 3.0 * k3)
    if not (k4 or k5 or k6):
        return slope
    return (slope - factor * (k4 + q * (2.0 * k5 + q * 3.0 * k6))) / (1.0 + q * (k4 + q * (k5 + q * k6)))


def _lens(full: Coefficients, x: Plane, y: Plane) -> tuple[Plane, Plane]:
    """Radial, tangential and thin-prism distortion."""
    p1, p2 = full[2:4]
    s1, s2, s3, s4 = full[8:12]
    q = x * x + y * y
    factor, doubled = _radial(full, q), 2.0 * x * y
    x_out = x * factor + p1 * doubled + p2 * (q + 2.0 * x * x)
    y_out = y * factor + p1 * (q + 2.0 * y * y) + p2 * doubled
    if any(full[8:12]):
        x_out, y_out = x_out + q * (s1 + q * s2), y_out + q * (s3 + q * s4)
    return x_out, y_out


def _lens_jacobian(full: Coefficients, x: Plane, y: Plane) -> tuple[Plane, Plane, Plane, Plane]:
    """Derivatives of `_lens`: dx/dx, dx/dy, dy/dx, dy/dy."""
    p1, p2 = full[2:4]
    s1, s2, s3, s4 = full[8:12]
    q = x * x + y * y
    factor = _radial(full, q)
    slope = _radial_slope(full, q, factor)
    prism_x, prism_y = 2.0 * (s1 + 2.0 * q * s2), 2.0 * (s3 + 2.0 * q * s4)
    mixed = 2.0 * (x * y * slope + p1 * x + p2 * y)
    xx = factor + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + x * prism_x
    yy = factor + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x + y * prism_y
    return xx, mixed + y * prism_x, mixed + x * prism_y, yy


def _tilt_matrix(tilt_x_rad: float, tilt_y_rad: float) -> Float64[np.ndarray, "3 3"]:
    """The homography of a sensor tilted about x and y."""
    cx, sx = np.cos(tilt_x_rad), np.sin(tilt_x_rad)
    cy, sy = np.cos(tilt_y_rad), np.sin(tilt_y_rad)
    turn = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]]
    )
    onto_plane = np.array([[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]], [0.0, 0.0, 1.0]])
    return onto_plane @ turn


def _apply(homography: Float64[np.ndarray, "3 3"], x: Plane, y: Plane) -> tuple[Plane, Plane]:
    w = homography[2, 0] * x + homography[2, 1] * y + homography[2, 2]
    x_out = (homography[0, 0] * x + homography[0, 1] * y + homography[0, 2]) / w
    y_out = (homography[1, 0] * x + homography[1, 1] * y + homography[1, 2]) / w
    return x_out, y_out
