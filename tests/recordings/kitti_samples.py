"""A small KITTI camera, and pixels by the data set's formula."""

from __future__ import annotations

import numpy as np

WIDTH, HEIGHT = 120, 40
K = np.array([[70.0, 0, 61.0], [0, 72.0, 17.0], [0, 0, 1]])
P2 = np.c_[K, [4.5, 0.2, 0.003]]
R0 = np.array([[0.9999, 0.0098, -0.0074], [-0.0099, 0.9999, -0.0043], [0.0074, 0.0044, 0.9999]])
TR = np.array([[0.0075, -0.9999, -0.0006, -0.004], [0.0148, 0.0007, -0.9999, -0.076], [0.9998, 0.0075, 0.0148, -0.27]])


def row(name: str, matrix: np.ndarray) -> str:
    return f"{name} " + " ".join(f"{value:.12e}" for value in matrix.ravel())


OBJECT_CALIB = "\n".join([row("P2:", P2), row("R0_rect:", R0), row("Tr_velo_to_cam:", TR), ""])
TRACKING_CALIB = "\n".join([row("P2:", P2), row("R_rect", R0), row("Tr_velo_cam", TR), ""])


def by_formula(scan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels by KITTI's formula P2 * R0_rect * Tr_velo_to_cam * X, and a mask of the points on the image."""
    rectified = R0 @ TR @ np.c_[scan[:, :3].astype(np.float64), np.ones(len(scan))].T
    uvw = P2 @ np.vstack([rectified, np.ones(len(scan))])
    px = (uvw[:2] / uvw[2]).T
    inside = (uvw[2] > 0.1) & (px >= -0.5).all(axis=1) & (px < [WIDTH - 0.5, HEIGHT - 0.5]).all(axis=1)
    return px, inside


CAMERAS = "\n".join(["calib_time: 09-Jan-2012 13:57:47", row("R_rect_00:", R0), row("P_rect_02:", P2), ""])


LIDAR = "\n".join(["calib_time: 15-Mar-2012 11:37:16", row("R:", TR[:, :3]), row("T:", TR[:, 3]), ""])


TIMES = "2011-09-26 13:02:25.964389445\n\n2011-09-26 13:02:26\n2011-09-26 13:02:26.5\n"
