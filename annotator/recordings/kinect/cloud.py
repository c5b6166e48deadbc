"""The points of a depth image that an Azure Kinect's colour camera sees.

These are the points inside the colour image, each with the colour of its nearest pixel. The two cameras are 32 mm
apart, so some points are hidden from the colour camera by others. They would get the wrong colour and are left out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt16

from annotator.geometry.distortion import distort_planes
from annotator.recordings.kinect.calibration import KinectCalibration
from annotator.types import Camera

# A point is hidden if another one in the same cell of the colour image is nearer by more than this.
HIDDEN_BEHIND_M, HIDDEN_BEHIND_SHARE = 0.01, 0.03
CELL_DEPTH_PX = 1.5
POINTS_AT_ONCE = 16384


def seen_points(
    calibration: KinectCalibration, depth_mm: UInt16[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "n"]]:
    """Returns the points of a depth image that the colour camera sees, in its frame, metres, and each one's pixel.

    A pixel is the index `v * width + u` in the colour image. Colours are not needed here, so the image can be decoded
    in parallel.
    """
    # some rows at a time, so that intermediate results stay in the processor's cache: three times as fast
    rows = max(POINTS_AT_ONCE // depth_mm.shape[1], 1)
    parts = [
        _inside(calibration.color, calibration.color_points(depth_mm[first : first + rows], first))
        for first in range(0, len(depth_mm), rows)
    ]
    xyz_m, u, v = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    visible = np.flatnonzero(~_hidden(calibration, u, v, xyz_m[2]))
    nearest = v.take(visible) * calibration.color.width_px + u.take(visible)
    return np.stack([each.take(visible) for each in xyz_m], axis=1), nearest


def _inside(
    camera: Camera, xyz_m: Float32[np.ndarray, "n 3"]
) -> tuple[Float32[np.ndarray, "3 m"], Int32[np.ndarray, "m"], Int32[np.ndarray, "m"]]:
    """Returns the points inside the image as three coordinate arrays, and the column and row of each one's pixel."""
    # single precision, unlike `project`: an error of 1e-4 px does not matter for colours, and it takes half the time
    x, y, z = xyz_m.T
    u, v = distort_planes(camera.distortion, x / z, y / z)
    u *= np.float32(camera.fx)
    u += np.float32(camera.cx + 0.5)
    v *= np.float32(camera.fy)
    v += np.float32(camera.cy + 0.5)
    inside = np.flatnonzero((z > 0) & (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px))
    return xyz_m.T.take(inside, axis=1), u.take(inside).astype(np.int32), v.take(inside).astype(np.int32)


def _hidden(
    calibration: KinectCalibration,
    u: Int32[np.ndarray, "n"],
    v: Int32[np.ndarray, "n"],
    z_m: Float32[np.ndarray, "n"],
) -> Bool[np.ndarray, "n"]:
    """True for each point that is hidden by others; `u` and `v` are its pixel in the colour image.

    The image is divided into cells that are so large that a frontal surface has a point in nearly every one.
    """
    camera = calibration.color
    cell_px = max(round(CELL_DEPTH_PX * camera.fx / calibration.depth.fx), 1)
    across = camera.width_px // cell_px + 1
    cell = v // cell_px * across + u // cell_px
    nearest = np.full(across * (camera.height_px // cell_px + 1), np.inf, np.float32)
    np.minimum.at(nearest, cell, z_m)
    limit = nearest * np.float32(1 + HIDDEN_BEHIND_SHARE) + np.float32(HIDDEN_BEHIND_M)
    return np.asarray(z_m > limit.take(cell))
