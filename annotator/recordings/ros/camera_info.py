"""Cameras from `sensor_msgs/CameraInfo` and `foxglove.CameraCalibration`.

K, D, R, P, binning and region of interest have the meaning of the comments in `sensor_msgs/CameraInfo.msg`, and image
and region are related as in `image_geometry::PinholeCameraModel`: K and P are of the full sensor, of which the image is
a region, binned. A rectified image (by its topic's name) has the camera P, without distortion, turned by R. The right
camera of a stereo pair that names the tf frame of the left one is moved by the baseline in P.

Fisheye images (`equidistant`) are undistorted, because a `Camera` is a pinhole camera. RealSense's inverse
Brown-Conrady model maps distorted to undistorted points; it is replaced by the nearest model of OpenCV's form.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.frame_limits import require_pixels
from annotator.recordings.plausible import are_plausible, is_pinhole, is_rotation
from annotator.types import Camera
from annotator.types.frame import DISTORTION_LENGTHS

RECTIFIED = re.compile(r"rect(?!angle)", re.IGNORECASE)
FISHEYE = ("equidistant", "fisheye", "kannala_brandt4")
MOST_OFF_ROTATION = 1e-3
# Points per side of the grid on which the inverse distortion is fitted.
GRID = 25


@dataclass(frozen=True, eq=False)
class BagCamera:
    """A calibrated camera of a bag.

    Attributes:
        camera: of the images as they are given to annotator.
        T_camera_frame: from the tf frame that the calibration names to the camera (rectification and baseline).
        fisheye: K and D of the images in the bag, if they must be undistorted.
    """

    camera: Camera
    T_camera_frame: RigidTransform
    fisheye: tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "4"]] | None = None

    def picture(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Returns an image of the bag as this camera sees it.

        Raises:
            ValueError: it has another size.
        """
        import cv2

        self.require_size(rgb.shape)
        if self.fisheye is None:
            return rgb
        K, D = self.fisheye
        size = (self.camera.width_px, self.camera.height_px)
        maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), self.camera.matrix, size, cv2.CV_32FC1)
        return np.asarray(cv2.remap(rgb, *maps, cv2.INTER_LINEAR))

    def require_size(self, shape: tuple[int, ...]) -> None:
        """
        Raises:
            ValueError: an image of this shape is not of this camera.
        """
        size = (self.camera.width_px, self.camera.height_px)
        if shape[1::-1] != size:
            raise ValueError(
                f"has {shape[1]} x {shape[0]} pixels, but its camera has {size[0]} x {size[1]}; "
                "name its calibration with --camera-info (of depth images: --depth-info)"
            )


def read_camera_info(content: Any, is_rectified: bool, first: Any = None) -> BagCamera:
    """Returns the camera of a decoded message.

    Args:
        is_rectified: its images are.
        first: calibration of the first camera of a stereo pair, if the second one, this, names its tf frame.

    Raises:
        ValueError: it is not calibrated, or its numbers contradict each other; the message says which.
    """
    K, D, R, P = (_field(content, name) for name in "KDRP")
    if not K.any():
        raise ValueError(
            "is not calibrated: K is zero; name another topic with --camera-info (of depth images: --depth-info)"
        )
    if len(K) != 9 or not are_plausible(K):
        raise ValueError("has a K that is not nine plausible numbers")
    is_rectified = is_rectified and len(P) == 12 and bool(P.any())
    full = P.reshape(3, 4)[:, :3] if is_rectified else K.reshape(3, 3)
    matrix, width, height = _region(content, full)
    if not is_pinhole(matrix):
        raise ValueError("is not a pinhole camera: K must be fx 0 cx 0 fy cy 0 0 1")
    require_pixels(width, height)
    T = RigidTransform.identity()
    # P of the second camera is relative to the rectified first one
    R = R if first is None else _field(first, "R")
    if is_rectified and R.any():
        if len(R) != 9 or not is_rotation(R.reshape(3, 3), MOST_OFF_ROTATION):
            raise ValueError("has an R that is not a rotation")
        T = RigidTransform.from_rotation(Rotation.from_matrix(R.reshape(3, 3)))
    if is_rectified and first is not None:
        T = RigidTransform.from_translation(baseline_m(content)) * T
    model = str(content.distortion_model).lower()
    if is_rectified or not D.any():
        return BagCamera(_camera(width, height, matrix), T)
    if not are_plausible(D):
        raise ValueError("has a D with implausible numbers")
    if model in FISHEYE:
        return _undistorted(width, height, matrix, D)
    if "inverse" in model:
        return BagCamera(_camera(width, height, matrix, _inverted(width, height, matrix, D)), T)
    # longer lists may end with zeros
    length = next((length for length in DISTORTION_LENGTHS if length >= len(D)), None)
    if length is None or model in ("ftheta", "omni", "cata"):
        raise ValueError(
            f"has the distortion {model or 'without a name'} with {len(D)} numbers; known are plumb_bob, "
            "rational_polynomial and equidistant"
        )
    return BagCamera(_camera(width, height, matrix, (*D.tolist(), *[0.0] * (length - len(D)))), T)


def baseline_m(content: Any) -> Float64[np.ndarray, "3"]:
    """Returns the place of the first camera of a stereo pair in the rectified camera of a message; zero without one.

    Raises:
        ValueError: P is damaged.
    """
    P = _field(content, "P")
    if len(P) != 12 or not P.any():
        return np.zeros(3)
    P = P.reshape(3, 4)
    if not are_plausible(P) or not is_pinhole(P[:, :3]):
        raise ValueError("has a P that is not that of a pinhole camera")
    return np.linalg.solve(P[:, :3], P[:, 3])


def _region(content: Any, full: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Returns K, width and height of the region of interest after binning, as `image_geometry` does."""
    width, height, matrix = int(content.width), int(content.height), full.copy()
    roi = getattr(content, "roi", None)
    if roi is not None and int(roi.width) and int(roi.height):
        width, height = int(roi.width), int(roi.height)
        matrix[:2, 2] -= (int(roi.x_offset), int(roi.y_offset))
    x, y = (max(int(getattr(content, f"binning_{axis}", 1)), 1) for axis in "xy")
    matrix[0] /= x
    matrix[1] /= y
    return matrix, width // x, height // y


def _field(content: Any, name: str) -> Float64[np.ndarray, "n"]:
    """Returns a field of numbers; ROS 2 writes its name in lower case."""
    values: Sequence[float] = getattr(content, name if hasattr(content, name) else name.lower())
    return np.array(list(values), np.float64).reshape(-1)


def _camera(width: int, height: int, K: np.ndarray, distortion: tuple[float, ...] = ()) -> Camera:
    fx, fy, cx, cy = (float(K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(width, height, fx, fy, cx, cy, distortion)


def _undistorted(width: int, height: int, K: np.ndarray, D: np.ndarray) -> BagCamera:
    import cv2

    if len(D) < 4:
        raise ValueError(f"has {len(D)} numbers of distortion; equidistant has four")
    D = D[:4]
    size = (width, height)
    ideal = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, D, size, np.eye(3), balance=0.0)
    if not is_pinhole(ideal):
        raise ValueError("has a distortion that cannot be undone")
    return BagCamera(_camera(width, height, ideal), RigidTransform.identity(), (K, D))


def _inverted(width: int, height: int, K: np.ndarray, D: np.ndarray) -> tuple[float, ...]:
    """Returns k1 k2 p1 p2 k3 that map the undistorted points of an inverse Brown-Conrady model to the distorted ones.

    Both models are linear in their coefficients, so that these are a least-squares solution.
    """
    columns, rows = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    seen = np.stack([(columns.ravel() - K[0, 2]) / K[0, 0], (rows.ravel() - K[1, 2]) / K[1, 1]], axis=1)
    coefficients = np.concatenate([D, np.zeros(5)])[:5]
    ideal = seen + (_brown_conrady(seen) @ coefficients)
    solution, *_ = np.linalg.lstsq(_brown_conrady(ideal).reshape(-1, 5), (seen - ideal).reshape(-1), rcond=None)
    return tuple(solution.tolist())


def _brown_conrady(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2 5"]:
    """Returns by how much each coefficient (k1 k2 p1 p2 k3) moves normalised points."""
    x, y = xy.T
    r2 = (xy**2).sum(axis=1)[:, None]
    tangential = [
        np.stack([2 * x * y, r2[:, 0] + 2 * y * y], axis=1),
        np.stack([r2[:, 0] + 2 * x * x, 2 * x * y], axis=1),
    ]
    return np.stack([xy * r2, xy * r2**2, *tangential, xy * r2**3], axis=2)
