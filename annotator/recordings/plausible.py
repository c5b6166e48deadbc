"""Plausibility limits for points and calibrations; larger numbers are not physical, and their products overflow."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Num

from annotator.types import Camera

# Limit for all numbers, metres or pixels.
LARGEST = 1e9
SMALLEST_FOCAL_PX = 1e-3
# Range of the median distance of a cloud's points from their camera, metres.
DISTANCES_M = (0.05, 300.0)
# No camera's image has a longer side.
LARGEST_SIDE_PX = 1 << 16


def are_plausible(values: np.ndarray) -> bool:
    """True if all numbers are finite and within `LARGEST`."""
    return bool((np.abs(values) <= LARGEST).all())


def are_returns(xyz: Num[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """True for points that were measured.

    Drivers write NaN, or exactly (0, 0, 0), where a beam did not return: in a sensor's own coordinates, that is the
    sensor itself, and in those of a map, it is far from all points.
    """
    # comparisons with NaN are false
    return (np.abs(xyz) < LARGEST).all(axis=1) & xyz.any(axis=1)


def is_pinhole(K: np.ndarray) -> bool:
    """True for `fx 0 cx / 0 fy cy / 0 0 1`, (3, 3), with plausible focal lengths."""
    zeros = (K[0, 1], K[1, 0], K[2, 0], K[2, 1])
    return are_plausible(K) and not any(zeros) and bool(K[2, 2] == 1 and min(K[0, 0], K[1, 1]) >= SMALLEST_FOCAL_PX)


def pinhole(K: np.ndarray, width_px: int, height_px: int, distortion: tuple[float, ...] = ()) -> Camera:
    """Returns the camera with matrix K, (3, 3)."""
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(width_px, height_px, fx, fy, cx, cy, distortion)


def is_rotation(R: np.ndarray, most_off: float) -> bool:
    """True for a rotation matrix (3, 3): `R R^T` differs from the identity by at most `most_off` per element."""
    return are_plausible(R) and bool(np.abs(R @ R.T - np.eye(3)).max() <= most_off and np.linalg.det(R) > 0)
