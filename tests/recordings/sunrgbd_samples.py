"""Synthetic SUN RGB-D folders with points and labels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from rgbd_samples import png
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 60, 40
K = np.array([[50.0, 0, 31], [0, 52.0, 19], [0, 0, 1]])
E = Rotation.from_euler("xz", [12, 3], degrees=True).as_matrix()
A = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
RTILT = A @ E @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
DEPTH_MM = (2000 + 20 * np.arange(WIDTH) + 10 * np.arange(HEIGHT)[:, None]).astype(np.uint16)
DEPTH_MM[5:9, 7:30] = 0
IMAGE = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def upright_points() -> tuple[np.ndarray, np.ndarray]:
    """The cloud, computed as in the data set's code (pixels count from 1), and its colours."""
    v, u = np.nonzero(DEPTH_MM)
    Z = DEPTH_MM[v, u] / 1000
    X, Y = (u + 1 - K[0, 2]) / K[0, 0] * Z, (v + 1 - K[1, 2]) / K[1, 1] * Z
    return np.stack([X, Z, -Y], axis=1) @ RTILT.T, IMAGE[v, u]


def write_scene(path: Path) -> None:
    for name in ("image", "depth", "extrinsics", "annotation3Dfinal"):
        (path / name).mkdir(parents=True)
    (path / "image" / "0000048.png").write_bytes(png(IMAGE[:, :, ::-1]))
    (path / "depth" / "0000048.png").write_bytes(png(DEPTH_MM << 3 | DEPTH_MM >> 13))
    (path / "intrinsics.txt").write_text("\n".join(" ".join(map(str, row)) for row in K))
    for date, matrix in (("20150101", np.eye(3)), ("20160101", E)):
        rows = [" ".join(f"{value:.9g}" for value in [*row, 0]) for row in matrix]
        (path / "extrinsics" / f"{date}.txt").write_text("\n".join(rows) + "\n")
    polygon = {"X": [0.0, 1.0, 1.0, 0.0], "Z": [2.0, 2.0, 4.0, 4.0], "Ymin": -0.5, "Ymax": 1.0, "rectangle": 1}
    objects = [{"name": "night  stand", "polygon": [polygon]}, None, {"polygon": []}, {"name": "wall", "polygon": []}]
    (path / "annotation3Dfinal" / "index.json").write_text(json.dumps({"date": "today", "objects": objects}))
