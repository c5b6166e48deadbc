"""Azure Kinect recordings of a synthetic scene, written by PyAV, independently of our code."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 1280, 720
DEPTH_WIDTH, DEPTH_HEIGHT = 320, 288
PERIOD_US = 33_333
PIXEL_FORMATS = {"MJPG": "yuvj420p", "NV12": "nv12", "YUY2": "yuyv422", "BGRA": "bgra"}
# Slight barrel distortion; fx, fy, cx, cy are fractions of the sensor's size.
LENS = [0.5, 0.5, 0.49, 0.49, 0.3, -0.02, 0.001, 0.6, 0.02, -0.001, 0, 0, -1e-4, 2e-4]
BASELINE_M = 0.032
# From the device's axes to the accelerometer's, approximately as in the real device: x backwards, z down.
ACCELEROMETER = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]) @ Rotation.from_euler("x", 6, degrees=True).as_matrix()
START_NS = 5_000_000


def calibration(**changes: object) -> dict[str, object]:
    """The attachment's content; `changes` replace keys of both cameras."""

    def camera(purpose: str, shift_m: float) -> dict[str, object]:
        return {
            "Purpose": purpose,
            "Intrinsics": {"ModelType": "CALIBRATION_LensDistortionModelBrownConrady", "ModelParameters": LENS},
            "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [shift_m, 0, 0]},
            "MetricRadius": 1.74,
            **changes,
        }

    cameras = [
        camera("CALIBRATION_CameraPurposeDepth", 0.0),
        camera("CALIBRATION_CameraPurposePhotoVideo", -BASELINE_M),
    ]
    pose = {"Rotation": ACCELEROMETER.ravel().tolist(), "Translation": [-0.05, 0.003, 0.001]}
    sensor = {"SensorType": "CALIBRATION_InertialSensorType_Accelerometer", "Rt": pose}
    return {"CalibrationInformation": {"Cameras": cameras, "InertialSensors": [sensor]}}


def picture(number: int) -> np.ndarray:
    """RGB: four quarters of one colour each, so that chroma subsampling matters only at their edges."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[: HEIGHT // 2, : WIDTH // 2] = (200, 30 + 5 * number, 40)
    image[: HEIGHT // 2, WIDTH // 2 :] = (40, 180, 60)
    image[HEIGHT // 2 :, : WIDTH // 2] = (50, 60, 210)
    image[HEIGHT // 2 :, WIDTH // 2 :] = (220, 220, 90)
    return image


def depth_mm(number: int) -> np.ndarray:
    """A wall at 2 m, 10 mm nearer in each frame, with a post at 1 m in front of it; no depth at the left edge."""
    depth = np.full((DEPTH_HEIGHT, DEPTH_WIDTH), 2000 - 10 * number, np.uint16)
    depth[:, 150:170] = 1000
    depth[:, :20] = 0
    return depth


def write_recording(
    path: Path,
    fourcc: str = "NV12",
    frames: int = 3,
    *,
    attached: bytes | None = None,
    titles: Sequence[str] = ("COLOR", "DEPTH", "IR"),
    depth_delay_us: int = 0,
    without_depth: Sequence[int] = (),
    felt: Sequence[tuple[int, Sequence[float]]] = (),
) -> Path:
    """Writes `frames` captures at 30 per second, infrared = depth + 1, and accelerations (microseconds, m/s^2)."""
    with av.open(str(path), "w", format="matroska", options={"allow_raw_vfw": "1"}) as out:
        out.metadata["K4A_START_OFFSET_NS"] = str(START_NS)
        out.metadata["K4A_DEPTH_DELAY_NS"] = str(depth_delay_us * 1000)
        color = out.add_stream("mjpeg" if fourcc == "MJPG" else "rawvideo", rate=30)
        color.width, color.height, color.pix_fmt = WIDTH, HEIGHT, PIXEL_FORMATS[fourcc]
        if fourcc == "MJPG":
            color.codec_context.color_range = 2
            color.options = {"qmin": "1", "qmax": "2"}
        raw = [out.add_stream("rawvideo", rate=30) for _ in range(2)]
        for stream in raw:
            stream.width, stream.height, stream.pix_fmt = DEPTH_WIDTH, DEPTH_HEIGHT, "gray16be"
        for stream, title in zip((color, *raw), titles, strict=True):
            stream.metadata["title"] = title
            stream.codec_context.time_base = Fraction(1, 1_000_000)
        # the stream's type does not matter
        inertial = out.add_stream("rawvideo", rate=1000) if felt else None
        if inertial is not None:
            inertial.width, inertial.height, inertial.pix_fmt = 20, 1, "gray16be"
            inertial.metadata["title"] = "IMU"
            inertial.codec_context.time_base = Fraction(1, 1_000_000)
        content = json.dumps(calibration()).encode() + b"\0" if attached is None else attached
        out.add_attachment("calibration.json", "application/octet-stream", content)
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(picture(number), format="rgb24").reformat(format=PIXEL_FORMATS[fourcc])
            _put(out, color, frame, number * PERIOD_US)
            if number in without_depth:
                continue
            for stream, plus in zip(raw, (0, 1), strict=True):
                image = (depth_mm(number) + plus).astype(np.uint16)
                frame = av.VideoFrame.from_ndarray(image, format="gray16be")
                _put(out, stream, frame, number * PERIOD_US + depth_delay_us)
        for time_us, acceleration in felt:
            packet = av.Packet(imu_sample(time_us, acceleration))
            packet.stream, packet.pts, packet.dts = inertial, time_us, time_us
            packet.time_base = Fraction(1, 1_000_000)
            out.mux(packet)
    if fourcc == "BGRA":
        # PyAV writes the same pixels without the FourCC
        unnamed = struct.pack("<IiiHHI", 40, WIDTH, -HEIGHT, 1, 32, 0)
        path.write_bytes(path.read_bytes().replace(unnamed, unnamed[:16] + b"BGRA", 1))
    return path


def imu_sample(time_us: int, acceleration: Sequence[float]) -> bytes:
    """One sample as the device's recorder writes it."""
    time_ns = START_NS + 1000 * time_us
    return struct.pack("<Q3fQ3f", time_ns, *acceleration, time_ns, 0.01, 0, 0)


def _put(out: av.container.OutputContainer, stream: av.VideoStream, frame: av.VideoFrame, time_us: int) -> None:
    frame.pts, frame.time_base = time_us, Fraction(1, 1_000_000)
    for packet in stream.encode(frame):
        out.mux(packet)
