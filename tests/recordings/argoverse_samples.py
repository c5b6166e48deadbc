"""A small log of Argoverse 2 with known numbers, with or without images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow
from nuscenes_samples import HEIGHT, START_US, WIDTH, K, ego_pose, mount, scan_points
from pyarrow import feather
from scipy.spatial.transform import RigidTransform

CAMERAS = {"ring_front_center": "CAM_FRONT", "ring_rear_left": "CAM_BACK"}
DELAYS_US = {"ring_front_center": 12_000, "ring_rear_left": -8_000}
PERIOD_US = 100_000
# Of the boxes, in the ego frame: ahead, and behind.
PLACES = {"REGULAR_VEHICLE": (10.0, 0.5, 1.0), "PEDESTRIAN": (-8.0, 0.0, 0.9)}


def put(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pyarrow.table(columns), str(path))


def poses(names: dict[str, Any], transforms: Sequence[RigidTransform]) -> dict[str, Any]:
    quaternions = np.array([T.rotation.as_quat(scalar_first=True) for T in transforms])
    positions = np.array([T.translation for T in transforms])
    return (
        names
        | dict(zip(("qw", "qx", "qy", "qz"), quaternions.T, strict=True))
        | dict(zip(("tx_m", "ty_m", "tz_m"), positions.T, strict=True))
    )


def write_log(folder: Path, sweeps: int = 3, images: bool = True) -> Path:
    """Writes sweeps every 0.1 s; each camera has its image a few milliseconds before or after."""
    times_us = [START_US + number * PERIOD_US for number in range(sweeps)]
    posed = {time_us * 1000: ego_pose(time_us) for time_us in times_us}
    image = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    for number, time_us in enumerate(times_us):
        points = scan_points(number)
        columns = {name: points[:, axis].astype(np.float16) for axis, name in enumerate("xyz")}
        more = {"intensity": points[:, 3].astype(np.uint8), "offset_ns": np.zeros(len(points), np.int32)}
        put(folder / "sensors" / "lidar" / f"{time_us * 1000}.feather", columns | more)
        for camera in CAMERAS if images else ():
            at_us = time_us + DELAYS_US[camera]
            file = folder / "sensors" / "cameras" / camera / f"{at_us * 1000}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), image)
            posed[at_us * 1000] = ego_pose(at_us)
    put(folder / "city_SE3_egovehicle.feather", poses({"timestamp_ns": list(posed)}, list(posed.values())))
    mounts = {camera: mount(channel) for camera, channel in CAMERAS.items()} | {"up_lidar": mount("LIDAR_TOP")}
    put(
        folder / "calibration" / "egovehicle_SE3_sensor.feather",
        poses({"sensor_name": list(mounts)}, list(mounts.values())),
    )
    numbers = {"fx_px": K[0][0], "fy_px": K[1][1], "cx_px": K[0][2], "cy_px": K[1][2], "k1": -0.2}
    numbers |= {"width_px": WIDTH, "height_px": HEIGHT}
    intrinsics = {name: [value] * len(CAMERAS) for name, value in numbers.items()}
    put(folder / "calibration" / "intrinsics.feather", {"sensor_name": list(CAMERAS)} | intrinsics)
    rows = [(time_us * 1000, label, place) for time_us in times_us for label, place in PLACES.items()]
    boxes = {
        "timestamp_ns": [row[0] for row in rows],
        "track_uuid": [f"of {row[1]}" for row in rows],
        "category": [row[1] for row in rows],
        **{name: [value] * len(rows) for name, value in (("length_m", 4.0), ("width_m", 2.0), ("height_m", 1.5))},
        "num_interior_pts": [3] * len(rows),
    }
    put(
        folder / "annotations.feather",
        poses(boxes, [RigidTransform.from_translation(np.array(place)) for _, _, place in rows]),
    )
    return folder
