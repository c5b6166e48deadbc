"""SUN RGB-D's calibrations in both of its layouts: camera matrix and tilt.

The data set counts pixels from 1, so 1 is subtracted from its principal point. Labels and extracted clouds are in the
frame "upright depth": x right, y forward, z up, origin at the camera, tilt removed. A camera's point is mapped there by
`Rtilt * [X, Z, -Y]`. Raw scenes have extrinsics E instead, with `Rtilt = A E B`; A and B only convert between camera
axes and upright axes, so E alone levels the camera (SUNRGBDtoolbox, `readframeSUNRGBD.m`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import read_text_file
from annotator.recordings.plausible import are_plausible, is_pinhole, is_rotation
from annotator.text import to_number
from annotator.types import Camera
from annotator.types.errors import FrameError

REMEDY = "copy the calibration again from the data set"
# From camera axes (x right, y down, z forward) to upright ones (x right, y forward, z up), both without tilt.
UPRIGHT_OF_LEVEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
MOST_OFF_ROTATION = 1e-2


@dataclass(frozen=True, eq=False)
class SunCalibration:
    """The camera of one frame.

    Attributes:
        path: the file, for messages.
        matrix: (3, 3) K, pixels counted from 1.
        T_camera_upright: from upright depth to the camera.
    """

    path: Path
    matrix: Float64[np.ndarray, "3 3"]
    T_camera_upright: RigidTransform

    def camera(self, width_px: int, height_px: int) -> Camera:
        """Returns the camera for an image of this size."""
        K = self.matrix
        return Camera(width_px, height_px, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]) - 1.0, float(K[1, 2]) - 1.0)

    @property
    def up(self) -> Float64[np.ndarray, "3"]:
        """The unit vector against gravity, in the camera frame."""
        return np.asarray(self.T_camera_upright.rotation.apply([0.0, 0.0, 1.0]))


def read_extracted_calibration(path: Path) -> SunCalibration:
    """Reads a `calib/KEY.txt`: a line of Rtilt and a line of K, both column by column.

    Raises:
        FrameError: the file is missing, or its numbers are not a rotation and a pinhole camera.
    """
    lines = [line for line in _text(path).splitlines() if line.strip()]
    if len(lines) < 2:
        raise FrameError(path, f"must have two lines, Rtilt and K, not {len(lines)}", REMEDY)
    Rtilt, K = (_nine(path, line).T for line in lines[:2])
    return _calibration(path, K, Rtilt @ UPRIGHT_OF_LEVEL)


def read_scene_calibration(intrinsics: Path, extrinsics: Path) -> SunCalibration:
    """Reads the calibration of a raw scene: K, and a 3 x 4 matrix whose first three columns are E; row by row.

    Raises:
        FrameError: as `read_extracted_calibration`.
    """
    K = _nine(intrinsics, _text(intrinsics))
    values = _numbers(extrinsics, _text(extrinsics))
    if len(values) not in (9, 12):
        raise FrameError(extrinsics, f"must have 3 x 4 numbers, not {len(values)}", REMEDY)
    E = values.reshape(3, -1)[:, :3]
    calibration = _calibration(extrinsics, np.eye(3), UPRIGHT_OF_LEVEL @ E)
    return SunCalibration(intrinsics, _pinhole(intrinsics, K), calibration.T_camera_upright)


def _calibration(path: Path, K: np.ndarray, upright_of_camera: np.ndarray) -> SunCalibration:
    R = upright_of_camera
    if not is_rotation(R, MOST_OFF_ROTATION):
        raise FrameError(path, "the tilt is not a rotation", REMEDY)
    T = RigidTransform.from_rotation(Rotation.from_matrix(R.T))
    return SunCalibration(path, _pinhole(path, K), T)


def _pinhole(path: Path, K: np.ndarray) -> np.ndarray:
    if not is_pinhole(K):
        raise FrameError(path, "K is not a pinhole camera (fx 0 cx / 0 fy cy / 0 0 1)", REMEDY)
    return K


def _nine(path: Path, text: str) -> np.ndarray:
    values = _numbers(path, text)
    if len(values) != 9:
        raise FrameError(path, f"a matrix must have 9 numbers, not {len(values)}", REMEDY)
    return values.reshape(3, 3)


def _numbers(path: Path, text: str) -> np.ndarray:
    try:
        values = np.array([to_number(word) for word in text.split()])
    except ValueError as error:
        raise FrameError(path, str(error), REMEDY) from error
    if not are_plausible(values):
        raise FrameError(path, "a number is not finite or is too large", REMEDY)
    return values


def _text(path: Path) -> str:
    try:
        return read_text_file(path)
    except FileNotFoundError as error:
        raise FrameError(path, "the calibration is missing", "copy it from the data set") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FrameError(path, f"the calibration cannot be read ({error})", REMEDY) from error
