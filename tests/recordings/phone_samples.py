"""Recordings of phones, written by the published descriptions of their formats, independently of our code."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import av
import cv2
import lzfse
import numpy as np
from scipy.spatial.transform import Rotation

FPS = 60
# x right, y down, z forward -> x right, y up, z backward
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])
K = np.array([[300.0, 0, 159.5], [0, 301.0, 119.5], [0, 0, 1]])


def scene(number: int, width: int = 320, height: int = 240) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image (a bar that moves, large areas that survive compression), depth (m) and confidence of a quarter size."""
    rgb = np.full((height, width, 3), (60, 90, 120), np.uint8)
    rgb[:, 16 * number : 16 * number + 48] = (200, 180, 40)
    v, u = np.mgrid[: height // 4, : width // 4]
    depth_m = (1.0 + 0.004 * u + 0.002 * v + 0.01 * number).astype(np.float32)
    depth_m[:2] = np.nan
    return rgb, depth_m, ((u + v + number) % 3).astype(np.uint8)


def orientation(number: int) -> Rotation:
    """A camera (OpenCV's axes) in a world with y up: held upright, tilted down by 20 degrees and more, and turned."""
    upright = Rotation.from_matrix(OPENCV_TO_OPENGL)
    tilted = upright * Rotation.from_euler("x", -20 - number, degrees=True)
    return Rotation.from_euler("y", 30 + 5 * number, degrees=True) * tilted


def frames(count: int = 4) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return [scene(number) for number in range(count)]


def write_record3d(
    path: Path,
    images: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]],
    matrix: np.ndarray = K,
    *,
    compression: int = zipfile.ZIP_STORED,
    without: tuple[str, ...] = (),
    **changes: Any,
) -> Path:
    """Writes a `.r3d` file, or a folder if the path has no suffix; `without` leaves keys of the metadata out."""
    rgb, depth_m, _ = images[0]
    turns = [orientation(number) * Rotation.from_matrix(OPENCV_TO_OPENGL) for number in range(len(images))]
    metadata = {
        "w": rgb.shape[1], "h": rgb.shape[0], "dw": depth_m.shape[1], "dh": depth_m.shape[0], "fps": FPS,
        "K": matrix.T.ravel().tolist(), "poses": [[*turn.as_quat().tolist(), 0.1, 0.2, 0.3] for turn in turns],
        "initPose": [0, 0, 0, 1, 0, 0, 0], "frameTimestamps": [number / 30 for number in range(len(images))],
        "perFrameIntrinsicCoeffs": [
            [matrix[0, 0] + number, matrix[1, 1] + number, matrix[0, 2], matrix[1, 2]] for number in range(len(images))
        ],
        "cameraType": 1,
    } | changes  # fmt: skip
    files = {"metadata": json.dumps({k: v for k, v in metadata.items() if k not in without}).encode(), "icon": b"x"}
    for number, (rgb, depth_m, confidence) in enumerate(images):
        files[f"rgbd/{number}.jpg"] = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        files[f"rgbd/{number}.depth"] = lzfse.compress(depth_m.astype("<f4").tobytes())
        if confidence is not None:
            files[f"rgbd/{number}.conf"] = lzfse.compress(confidence.astype(np.uint8).tobytes())
    if not path.suffix:
        (path / "rgbd").mkdir(parents=True)
        for name, content in files.items():
            (path / name).write_bytes(content)
        return path
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def write_stray_scanner(
    path: Path,
    images: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]],
    matrix: np.ndarray = K,
    *,
    own_intrinsics: bool = True,
    rolled: float = 0.0,
    codec: str = "libx264",
    keyframes: int = 8,
) -> Path:
    """Writes the folder; the newer version of `odometry.csv` has the intrinsics of each image.

    Args:
        rolled: degrees about the camera's axis (z forward) by which the phone was turned.
    """
    for name in ("depth", "confidence"):
        (path / name).mkdir(parents=True)
    write_video(path / "rgb.mp4", [rgb for rgb, _, _ in images], codec, keyframes)
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    lines[0] += ", fx, fy, cx, cy, distortion_center_x, distortion_center_y" if own_intrinsics else ""
    for number, (_, depth_m, confidence) in enumerate(images):
        key = f"{number:06d}"
        depth_mm = np.rint(np.nan_to_num(depth_m) * 1000).astype(np.uint16)
        (path / "depth" / f"{key}.png").write_bytes(cv2.imencode(".png", depth_mm)[1].tobytes())
        if confidence is not None:
            (path / "confidence" / f"{key}.png").write_bytes(cv2.imencode(".png", confidence)[1].tobytes())
        turn = orientation(number) * Rotation.from_euler("z", rolled, degrees=True)
        row = [f"{5000 + number / FPS:.9f}", key, "0.1", "0.2", "0.3", *map(str, turn.as_quat())]
        if own_intrinsics:
            row += [*map(str, (matrix[0, 0] + number, matrix[1, 1] + number, matrix[0, 2], matrix[1, 2])), "", ""]
        lines.append(", ".join(row))
    (path / "odometry.csv").write_text("\n".join(lines) + "\n")
    (path / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in matrix))
    (path / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    return path


def write_video(path: Path, images: list[np.ndarray], codec: str, keyframes: int) -> None:
    """Writes images as a video with B-frames, with at most `keyframes` images between two complete ones."""
    options = {"x265-params": f"keyint={keyframes}:bframes=2:crf=4:log-level=none", "g": str(keyframes), "crf": "4"}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS, options=options)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv444p"
        for rgb in images:
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
