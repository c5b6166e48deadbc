"""nuScenes datasets for tests: a small one with known numbers, and the real frame of the shared folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

CAMERAS = ("CAM_BACK", "CAM_FRONT")
K = [[40.0, 0.0, 31.5], [0.0, 40.0, 23.5], [0.0, 0.0, 1.0]]
WIDTH, HEIGHT = 64, 48
START_US = 1_532_402_927_000_000
# Camera axes on a vehicle with x ahead, y left, z up.
AHEAD = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
TURN = Rotation.from_rotvec([0, 0, np.pi])
T_EGO_LIDAR = RigidTransform.from_components([0.9, 0.0, 1.8], Rotation.from_rotvec([0.0, 0.02, np.pi / 2]))


def ego_pose(time_us: int) -> RigidTransform:
    """The vehicle drives at 10 m/s and turns by 0.1 rad/s, on a slope."""
    seconds = (time_us - START_US) / 1e6
    turn = Rotation.from_rotvec([0, 0, 0.3 + 0.1 * seconds]) * Rotation.from_rotvec([0, 0.05, 0])
    return RigidTransform.from_components([400 + 10 * seconds, 1100.0, 2.0], turn)


def mount(channel: str) -> RigidTransform:
    """T_ego_sensor."""
    if channel == "LIDAR_TOP":
        return T_EGO_LIDAR
    is_front = channel == "CAM_FRONT"
    return RigidTransform.from_components([1.5 if is_front else -1.0, 0.0, 1.5], AHEAD if is_front else TURN * AHEAD)


def scan_points(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-20, -20, -2], [20, 20, 2], (4000, 3))
    return np.column_stack([xyz, rng.integers(0, 256, 4000), rng.integers(0, 32, 4000)]).astype("<f4")


def row(token: str, pose: RigidTransform, **more: Any) -> dict[str, Any]:
    quaternion = pose.rotation.as_quat(scalar_first=True).tolist()
    return {"token": token, "translation": pose.translation.tolist(), "rotation": quaternion, **more}


def write_tables(folder: Path, tables: dict[str, list[dict[str, Any]]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))


def small(folder: Path, scenes: int = 2, samples: int = 2, sweeps: int = 2) -> Path:
    """Writes scenes with samples every 0.5 s, sweeps between them, and boxes 10 m ahead and 8 m behind."""
    tables: dict[str, list[dict[str, Any]]] = {
        "sensor": [{"token": c, "channel": c, "modality": "camera"} for c in CAMERAS]
        + [{"token": "LIDAR_TOP", "channel": "LIDAR_TOP", "modality": "lidar"}],
        "calibrated_sensor": [
            row(f"c-{c}", mount(c), sensor_token=c, camera_intrinsic=[] if c == "LIDAR_TOP" else K)
            for c in (*CAMERAS, "LIDAR_TOP")
        ],
        "scene": [], "sample": [], "sample_data": [], "ego_pose": [], "sample_annotation": [],
        "category": [{"token": "k", "name": "vehicle.car"}], "instance": [],
    }  # fmt: skip
    image = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    for scene in range(scenes):
        tables["scene"].append({"token": f"s{scene}", "name": f"scene-{scene:04}", "description": 'a {brace} "'})
        for name in ("ahead", "behind"):
            tables["instance"].append({
                "token": f"i{scene}{name}", "category_token": "k", "nbr_annotations": samples,
                "first_annotation_token": "", "last_annotation_token": "",
            })  # fmt: skip
        for step in range(samples * (sweeps + 1)):
            start_us = START_US + scene * 10**7
            at_us = start_us + step * 500_000 // (sweeps + 1)
            number, is_key = step // (sweeps + 1), step % (sweeps + 1) == 0
            sample = f"p{scene}-{number}"
            if is_key:
                tables["sample"].append({"token": sample, "timestamp": at_us, "scene_token": f"s{scene}"})
                for name, x_m, size in (("ahead", 10.0, [2, 4, 1.5]), ("behind", -8.0, [1, 3, 2])):
                    pose = ego_pose(start_us) * RigidTransform.from_translation([x_m, 0.5, 1.0])
                    annotation = row(f"a{sample}{name}", pose, sample_token=sample, size=size)
                    tables["sample_annotation"].append(annotation | {"instance_token": f"i{scene}{name}"})
            for channel, delay_us in (("CAM_BACK", 20_000), ("CAM_FRONT", -15_000), ("LIDAR_TOP", 0)):
                suffix = "pcd.bin" if channel == "LIDAR_TOP" else "png"
                name = f"{'samples' if is_key else 'sweeps'}/{channel}/n{scene}__{channel}__{at_us + delay_us}.{suffix}"
                file = folder / name
                file.parent.mkdir(parents=True, exist_ok=True)
                if channel == "LIDAR_TOP":
                    file.write_bytes(scan_points(step).tobytes())
                else:
                    cv2.imwrite(str(file), image)
                token = f"{channel}{scene}-{step}"
                tables["ego_pose"].append(row(token, ego_pose(at_us + delay_us), timestamp=at_us + delay_us))
                tables["sample_data"].append({
                    "token": token, "sample_token": sample, "ego_pose_token": token, "is_key_frame": is_key,
                    "calibrated_sensor_token": f"c-{channel}", "timestamp": at_us + delay_us, "filename": name,
                    "width": WIDTH, "height": HEIGHT, "prev": "", "next": "",
                })  # fmt: skip
    write_tables(folder / "v1.0-mini", tables)
    return folder


def real(source: Path, folder: Path) -> dict[str, Any]:
    """Writes the tables of the real frame, with links to its files, and returns its description.

    The description has boxes in the LiDAR frame, with their yaw there; nuScenes' own are upright in the global frame.
    """
    described = json.loads((source / "calibration_and_boxes.json").read_text())
    sample = described["sample"]
    T_global_ego, T_ego_lidar = rigid(sample["ego2global"]), rigid(sample["lidar_points"]["lidar2ego"])
    T_global_lidar = T_global_ego * T_ego_lidar
    names = {number: name for name, number in described["metainfo"]["categories"].items()} | {-1: "other"}
    sensors = [("LIDAR_TOP", T_global_ego, T_ego_lidar, [], sample["lidar_points"]["lidar_path"], sample["timestamp"])]
    for channel, image in sample["images"].items():
        T_ego_camera = rigid(image["cam2ego"])
        T_global_ego_then = T_global_lidar * rigid(image["lidar2cam"]).inv() * T_ego_camera.inv()
        sensors.append(
            (channel, T_global_ego_then, T_ego_camera, image["cam2img"], image["img_path"], image["timestamp"])
        )
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "scene", "name": "scene-0061", "description": "Parked truck, construction"}],
        "sample": [{"token": sample["token"], "timestamp": round(sample["timestamp"] * 1e6), "scene_token": "scene"}],
        "category": [{"token": name, "name": name} for name in names.values()],
        "sensor": [], "calibrated_sensor": [], "ego_pose": [], "sample_data": [], "instance": [],
        "sample_annotation": [],
    }  # fmt: skip
    for channel, ego, on_ego, matrix, file, time_s in sensors:
        place = folder / "samples" / channel / file
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(source / file)
        modality = "lidar" if channel == "LIDAR_TOP" else "camera"
        tables["sensor"].append({"token": channel, "channel": channel, "modality": modality})
        tables["calibrated_sensor"].append(row(channel, on_ego, sensor_token=channel, camera_intrinsic=matrix))
        tables["ego_pose"].append(row(channel, ego))
        tables["sample_data"].append({
            "token": channel, "sample_token": sample["token"], "ego_pose_token": channel, "is_key_frame": True,
            "calibrated_sensor_token": channel, "timestamp": round(time_s * 1e6),
            "filename": str(place.relative_to(folder)), "width": 1600, "height": 900,
        })  # fmt: skip
    for number, each in enumerate(sample["instances"]):
        x, y, z, length, width, height, yaw = each["bbox_3d"]
        pose = RigidTransform.from_components(T_global_lidar.apply([x, y, z]), upright(yaw, T_global_lidar.rotation))
        label = names[each["bbox_label_3d"]]
        annotation = row(f"{number}", pose, sample_token=sample["token"], instance_token=f"{number}")
        annotation["instance_class"] = label
        counts = {key: each[key] for key in ("num_lidar_pts", "num_radar_pts")}
        tables["sample_annotation"].append(annotation | {"size": [width, length, height]} | counts)
        tables["instance"].append({
            "token": f"{number}", "category_token": label, "nbr_annotations": 1,
            "first_annotation_token": f"{number}", "last_annotation_token": f"{number}",
        })  # fmt: skip
    write_tables(folder / "v1.0-mini", tables)
    return described


def upright(yaw: float, R_global_lidar: Rotation) -> Rotation:
    """The turn about the global z axis after which the box's x axis has this yaw in the LiDAR frame."""
    angle = yaw
    for _ in range(50):
        x = R_global_lidar.inv().apply([np.cos(angle), np.sin(angle), 0])
        angle += (yaw - np.arctan2(x[1], x[0]) + np.pi) % (2 * np.pi) - np.pi
    return Rotation.from_rotvec([0, 0, angle])


def rigid(rows: list[list[float]]) -> RigidTransform:
    return RigidTransform.from_matrix(np.array(rows))
