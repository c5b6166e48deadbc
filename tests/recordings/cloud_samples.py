"""Sample point clouds, camera files and images for recordings of point clouds."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from kitti_samples import HEIGHT, WIDTH

SCAN = np.c_[np.random.default_rng(1).uniform(-20, 20, (3000, 3)) * [1, 1, 0.2], np.random.default_rng(2).random(3000)]


SCAN = SCAN.astype(np.float32)


def camera_file(**more: object) -> str:
    K = [70.0, 0, 0, 0, 72.0, 0, 60.0, 20.0, 1]
    return json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": K, **more})


def image(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def put_image(path: Path, number: int) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image(number)[:, :, ::-1])[1].tobytes())
