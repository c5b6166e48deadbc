"""What an Azure Kinect's colour camera sees of a depth image.

Points inside the colour image, each with the colour of its nearest pixel. The two cameras stand 32 mm apart, so that
some points that the depth camera sees hide behind others; they would get the colour of what hides them, and are left
out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt16

from annotator.geometry.distortion import distort_planes
from annotator.recordings.kinect_calibration import KinectCalibration
from annotator.types import Camera

# A point is hidden where another one at the same place in the colour image is nearer by more than this.
HIDDEN_BEHIND_M, HIDDEN_BEHIND_SHARE = 0.01, 0.03
CELL_DEPTH_PX = 1.5
POINTS_AT_ONCE = 16384


def seen_points(
    calibration: KinectCalibration, depth_mm: UInt16[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "n"]]:
    """The points of a depth image that the colour camera sees, in its frame, metres; and the pixel of each.

    A pixel is `v * width + u` of the colour image. Its colours are looked up last, so that it can be decoded meanwhile.
    """
    # some rows at a time: what is computed on the way then stays in the processor's cache, three times as fast
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
    """The points inside the image, coordinate by coordinate, and the column and row of the pixel that each falls on."""
    # in single precision, unlike `project`: a ten-thousandth of a pixel decides no colour, and it takes half the time
    x, y, z = xyz_m.T
    u, v = distort_planes(camera.distortion, x / z, y / z)
    u *= np.float32(camera.fx)
    u += np.float32(camera.cx + 0.5)
    v *= np.float32(camera.fy)
    v += np.float32(camera.cy + 0.5)
    kept = np.flatnonzero((z > 0) & (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px))
    return xyz_m.T.take(kept, axis=1), u.take(kept).astype(np.int32), v.take(kept).astype(np.int32)


def _hidden(
    calibration: KinectCalibration,
    u: Int32[np.ndarray, "n"],
    v: Int32[np.ndarray, "n"],
    z_m: Float32[np.ndarray, "n"],
) -> Bool[np.ndarray, "n"]:
    """Which points, at these pixels of the colour image, lie behind others.

    The image is parted into cells so large that a surface seen face on has a point in nearly every one.
    """
    camera = calibration.color
    cell_px = max(round(CELL_DEPTH_PX * camera.fx / calibration.depth.fx), 1)
    across = camera.width_px // cell_px + 1
    cell = v // cell_px * across + u // cell_px
    nearest = np.full(across * (camera.height_px // cell_px + 1), np.inf, np.float32)
    np.minimum.at(nearest, cell, z_m)
    limit = nearest * np.float32(1 + HIDDEN_BEHIND_SHARE) + np.float32(HIDDEN_BEHIND_M)
    return np.asarray(z_m > limit.take(cell))
