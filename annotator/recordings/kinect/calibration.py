"""The Azure Kinect's calibration from a recording's attachment, for the recorded camera modes.

The attachment describes both cameras at full sensor size, in fractions of it. Each mode bins or scales the sensor and
crops a window; tables and rules as in the Azure Kinect Sensor SDK (`mode_specific_calibration.c`, MIT):
`c_px = c * width - window - 0.5`, `f_px = f * width`, where -0.5 makes the centre of the first pixel (0, 0). The lens
model is Brown-Conrady with six radial coefficients, as in OpenCV.

The accelerometer's samples, in its own axes, are corrected by the device (`src/record/internal`,
`matroska_imu_sample_t`). At rest they give the direction of gravity.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt16
from pydantic import AliasPath, Field, FiniteFloat, ValidationError
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.projection import in_metres
from annotator.recordings.kinect.matroska import Block
from annotator.recordings.two_cameras import seen_points
from annotator.types import Camera
from annotator.types.bases import FileRecord
from annotator.types.messages import first_problem

MM_PER_M = 1000.0
LENS_MODEL = "CALIBRATION_LensDistortionModelBrownConrady"
ACCELEROMETER = "CALIBRATION_InertialSensorType_Accelerometer"
DEPTH_PURPOSE, COLOUR_PURPOSE = "CALIBRATION_CameraPurposeDepth", "CALIBRATION_CameraPurposePhotoVideo"
Size = tuple[int, int]
# Fractions of a sensor, polynomial coefficients, metres between cameras: all are small and stored in single precision.
Small = Annotated[FiniteFloat, Field(ge=-1e4, le=1e4)]
# Image size of a mode -> size of the whole sensor in the mode's pixels, and left and upper edge of the window.
DEPTH_MODES: dict[Size, tuple[Size, Size]] = {
    (320, 288): ((512, 512), (96, 90)),
    (640, 576): ((1024, 1024), (192, 180)),
    (512, 512): ((512, 512), (0, 0)),
    (1024, 1024): ((1024, 1024), (0, 0)),
}
# All of the sensor's width, and the middle of its height.
COLOUR_MODES: dict[Size, tuple[Size, Size]] = {
    (width, height): ((width, width * 3 // 4), (0, (width * 3 // 4 - height) // 2))
    for width, height in ((1280, 720), (1920, 1080), (2560, 1440), (2048, 1536), (3840, 2160), (4096, 3072))
}


class _Pose(FileRecord):
    Rotation: Annotated[tuple[Small, ...], Field(min_length=9, max_length=9)]
    Translation: Annotated[tuple[Small, ...], Field(min_length=3, max_length=3)]

    def transform(self) -> RigidTransform:
        """Returns the transform from the device's frame (the depth camera's) to this sensor's, metres."""
        rotation = Rotation.from_matrix(np.array(self.Rotation).reshape(3, 3))
        return RigidTransform.from_components(np.array(self.Translation), rotation)


class _CameraPart(FileRecord):
    Purpose: str
    ModelType: str = Field(validation_alias=AliasPath("Intrinsics", "ModelType"))
    ModelParameters: tuple[Small, ...] = Field(
        min_length=14, validation_alias=AliasPath("Intrinsics", "ModelParameters")
    )
    Rt: _Pose
    MetricRadius: FiniteFloat = 0.0

    def camera(self, size: Size, modes: dict[Size, tuple[Size, Size]]) -> Camera:
        """Returns this camera in the mode with images of `size`; raises ValueError if there is no such mode."""
        if size not in modes:
            known = ", ".join(f"{width} x {height}" for width, height in modes)
            raise ValueError(f"images of {size[0]} x {size[1]} pixels belong to no mode of this camera ({known})")
        if self.ModelType != LENS_MODEL:
            raise ValueError(f"the lens model {self.ModelType} is unknown; only {LENS_MODEL} is supported")
        (width, height), (left, top) = modes[size]
        cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, cod_x, cod_y, p2, p1 = self.ModelParameters[:14]
        if cod_x or cod_y:
            raise ValueError("the centre of distortion differs from the principal point, which is not supported")
        return Camera(
            *size,
            fx=fx * width,
            fy=fy * height,
            cx=cx * width - left - 0.5,
            cy=cy * height - top - 0.5,
            distortion=(k1, k2, p1, p2, k3, k4, k5, k6),
        )


class _InertialPart(FileRecord):
    SensorType: str
    Rt: _Pose


class _File(FileRecord):
    Cameras: tuple[_CameraPart, ...] = Field(validation_alias=AliasPath("CalibrationInformation", "Cameras"))
    InertialSensors: tuple[_InertialPart, ...] = Field(
        (), validation_alias=AliasPath("CalibrationInformation", "InertialSensors")
    )


@dataclass(frozen=True, eq=False)
class KinectCalibration:
    """Both cameras of an Azure Kinect, in the modes of one recording.

    Attributes:
        T_color_depth: from the depth camera's frame to the colour camera's, metres.
        depth_reach: calibrated radius of the depth lens, as distance of (x/z, y/z) from the axis; infinite if unknown.
        color_from_accelerometer: rotation from the accelerometer's axes to the colour camera's; None if unknown.
    """

    depth: Camera
    color: Camera
    T_color_depth: RigidTransform
    depth_reach: float
    color_from_accelerometer: Rotation | None = None

    def seen_points(
        self, depth_mm: UInt16[np.ndarray, "h w"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "n"]]:
        """Returns the points of a depth image (0 = no depth) that the colour camera sees, as `two_cameras` does."""
        return seen_points(in_metres(depth_mm, MM_PER_M), self.depth, self.T_color_depth, self.color, self.depth_reach)


def parse_calibration(content: bytes, depth_size: Size, color_size: Size) -> KinectCalibration:
    """Parses the calibration of an attachment, for depth and colour images of these sizes (width, height)."""
    try:
        file = _File.model_validate_json(content.rstrip(b"\0 \r\n\t"))
    except ValidationError as error:
        raise ValueError(first_problem(error)) from error
    cameras = {camera.Purpose: camera for camera in file.Cameras}
    if not cameras.keys() >= {DEPTH_PURPOSE, COLOUR_PURPOSE}:
        raise ValueError(f"there is no camera {DEPTH_PURPOSE} or no camera {COLOUR_PURPOSE}")
    depth, color = cameras[DEPTH_PURPOSE], cameras[COLOUR_PURPOSE]
    T_color_device = color.Rt.transform()
    felt = {sensor.SensorType: sensor.Rt for sensor in file.InertialSensors}.get(ACCELEROMETER)
    return KinectCalibration(
        depth=depth.camera(depth_size, DEPTH_MODES),
        color=color.camera(color_size, COLOUR_MODES),
        T_color_depth=T_color_device * depth.Rt.transform().inv(),
        depth_reach=depth.MetricRadius if depth.MetricRadius > 0 else np.inf,
        color_from_accelerometer=None if felt is None else (T_color_device * felt.transform().inv()).rotation,
    )


# Little-endian; nanoseconds on the device's clock, m/s^2, rad/s.
SAMPLE = np.dtype(
    [("time_ns", "<u8"), ("acceleration_mps2", "<f4", 3), ("turn_time_ns", "<u8"), ("turn_rad_s", "<f4", 3)]
)
STANDARD_GRAVITY_MPS2 = 9.80665
# Limit for a device at rest; the sensor's bias is a few hundredths.
MOST_OFF_MPS2 = 0.3
WITHIN_NS = 500_000_000
MOST_SAMPLES = 100


def blocks_near(blocks: Sequence[Block], time_ns: int) -> list[Block]:
    """Returns those of `blocks` (sorted by time) that may hold the samples nearest to a time, within `WITHIN_NS`."""
    middle = bisect_left(blocks, time_ns, key=lambda block: block.time_ns)
    around = blocks[max(middle - MOST_SAMPLES, 0) : middle + MOST_SAMPLES]
    near = sorted(around, key=lambda block: abs(block.time_ns - time_ns))[:MOST_SAMPLES]
    return [block for block in near if abs(block.time_ns - time_ns) <= WITHIN_NS]


def parse_samples(data: bytes, is_laced: bool) -> Float64[np.ndarray, "n 4"]:
    """Returns the samples in a block's content: time, ns, and acceleration, m/s^2; none if its size does not fit.

    Laced samples are at the end, after their number minus one and, in two of the three kinds of lacing, their sizes.
    """
    size = (data[0] + 1 if is_laced and data else 1) * SAMPLE.itemsize
    fits = len(data) >= size if is_laced else len(data) == size
    samples = np.frombuffer(data[len(data) - size :] if fits else b"", SAMPLE)
    return np.c_[samples["time_ns"], samples["acceleration_mps2"]].astype(np.float64)


def up_at_rest(samples: Float64[np.ndarray, "n 4"], time_ns: int) -> Float64[np.ndarray, "3"] | None:
    """Returns the unit vector against gravity in the sensor's axes; None if the device moves or no sample is near.

    At rest, the sensor measures only the force that supports the device. Samples are time, ns, and acceleration, m/s^2.
    """
    away = np.abs(samples[:, 0] - time_ns)
    nearest = np.argsort(away, kind="stable")[:MOST_SAMPLES]
    near = samples[nearest[away[nearest] <= WITHIN_NS], 1:]
    if len(near) == 0 or not np.isfinite(near).all():
        return None
    mean = near.mean(axis=0)
    length = float(np.linalg.norm(mean))
    is_still = float(np.linalg.norm(near - mean, axis=1).max()) <= MOST_OFF_MPS2
    if not is_still or abs(length - STANDARD_GRAVITY_MPS2) > MOST_OFF_MPS2:
        return None
    return np.asarray(mean / length)
