"""A small bag of a camera and a LiDAR, and of a camera with depth, for the tests of bags."""

from __future__ import annotations

import numpy as np
from bag_writer import BagWriter, structured
from scipy.spatial.transform import RigidTransform, Rotation

START_NS = 1_700_000_000 * 10**9
MS = 1_000_000
SIZE = (32, 24)
K = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
IMAGE = np.random.default_rng(5).integers(0, 256, (24, 32, 3), np.uint8)
# x forward, y left, z up
POINTS_M = np.random.default_rng(6).uniform((2, -1, -0.7), (9, 1, 0.7), (200, 3)).astype(np.float32)
T_CAMERA_LIDAR = RigidTransform.from_components(
    [0.1, -0.2, 0.05], Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
)
LIDAR_COLUMNS = dict(zip("xyz", POINTS_M.T, strict=True)) | {"intensity": np.linspace(0, 1, 200, dtype=np.float32)}


def write_camera(bag: BagWriter, name: str, time_ns: int, frame: str = "camera", log_ns: int | None = None) -> None:
    bag.info(f"/{name}/camera_info", time_ns, SIZE, K, frame=frame)
    bag.image(f"/{name}/image_raw", time_ns, IMAGE, "rgb8", frame, log_ns=log_ns)


def write_scan(bag: BagWriter, time_ns: int, log_ns: int | None = None, topic: str = "/points") -> None:
    bag.cloud(topic, time_ns, structured(LIDAR_COLUMNS), log_ns=log_ns)


def write_mount(bag: BagWriter, topic: str = "/tf_static") -> None:
    bag.transform(topic, START_NS, "camera", "lidar", T_CAMERA_LIDAR)


def write_take(bag: BagWriter, frames: int = 3) -> None:
    """A camera and a LiDAR at 10 Hz, 4 ms apart, rigidly mounted."""
    write_mount(bag)
    for i in range(frames):
        write_scan(bag, START_NS + i * 100 * MS)
        write_camera(bag, "cam", START_NS + (i * 100 + 4) * MS)


def seen_points() -> np.ndarray:
    """The points of a scan that the camera sees, in its frame."""
    xyz = T_CAMERA_LIDAR.apply(POINTS_M.astype(np.float64))
    px = xyz @ K.T
    px = px[:, :2] / px[:, 2:]
    return xyz[(xyz[:, 2] > 0.1) & (np.abs(px - (15.5, 11.5)) <= (16, 12)).all(axis=1)].astype(np.float32)
