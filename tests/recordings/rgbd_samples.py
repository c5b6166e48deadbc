"""One writer of RGB-D folders, for tests that need pictures of their own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

Pictures = tuple[np.ndarray, np.ndarray]


def png(image: np.ndarray) -> bytes:
    """A PNG file of an image in OpenCV's order, or of one channel."""
    return cv2.imencode(".png", image)[1].tobytes()


def write_rgbd(folder: Path, frames: Mapping[str, Pictures], **camera: object) -> Path:
    """Writes images (RGB or grey) and depths (millimetres) by key, and a camera with some fields changed."""
    for key, (rgb, depth) in frames.items():
        for name, pixels in (("color", rgb[..., ::-1] if rgb.ndim == 3 else rgb), ("depth", depth)):
            (folder / name).mkdir(parents=True, exist_ok=True)
            (folder / name / f"{key}.png").write_bytes(png(pixels))
    height, width = rgb.shape[:2]
    K = [10.0, 0, 0, 0, 10.0, 0, (width - 1) / 2, (height - 1) / 2, 1]
    content = {"width": width, "height": height, "intrinsic_matrix": K} | camera
    (folder / "camera_intrinsic.json").write_text(json.dumps(content))
    return folder


def wall(
    frames: int, height: int = 6, width: int = 8, depth_mm: int = 1000
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Frames 000000, 000001, ... of a grey wall in front of the camera."""
    image, depth = np.full((height, width, 3), 128, np.uint8), np.full((height, width), depth_mm, np.uint16)
    return {f"{number:06d}": (image, depth) for number in range(frames)}
