"""One small recording of each format."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import phone_samples as made
from argoverse_samples import write_log
from cloud_samples import CAMERAS, LIDAR, OBJECT_CALIB, SCAN, TIMES, TRACKING_CALIB, camera_file, put_image
from dataset_samples import write
from nuscenes_samples import small
from rgbd_samples import png
from scipy.io import savemat
from sunrgbd_samples import IMAGE as SUN_IMAGE
from sunrgbd_samples import RTILT, K, upright_points, write_scene

from annotator.formats.dataset_writing import DatasetItem
from annotator.recordings import open_recording
from annotator.types import Label, OrientedBox, ReviewState, Source


def put(path: Path, content: bytes | str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)


def kitti_object(folder: Path, keys: Sequence[str] = ("0",)) -> None:
    for key in keys:
        put_image(folder / "image_2" / f"{key}.png", 1)
        put(folder / "velodyne" / f"{key}.bin", SCAN.tobytes())
        put(folder / "calib" / f"{key}.txt", OBJECT_CALIB)


def kitti_tracking(folder: Path, keys: Sequence[str] = ("0",)) -> None:
    for key in keys:
        put_image(folder / "image_02" / f"{key}.png", 1)
        put(folder / "velodyne" / f"{key}.bin", SCAN.tobytes())
    put(folder / "calib.txt", TRACKING_CALIB)


def kitti_raw(folder: Path, keys: Sequence[str] = ("0",)) -> None:
    for key in keys:
        put_image(folder / "image_02" / "data" / f"{key}.png", 1)
        put(folder / "velodyne_points" / "data" / f"{key}.bin", SCAN.tobytes())
    put(folder / "calib_cam_to_cam.txt", CAMERAS)
    put(folder / "calib_velo_to_cam.txt", LIDAR)
    put(folder / "image_02" / "timestamps.txt", TIMES)


def sunrgbd_extracted(folder: Path, keys: Sequence[str] = ("0",), clouds: str = "depth") -> None:
    """Clouds as `depth/KEY.mat` or `points/KEY.npz`."""
    xyz, rgb = upright_points()
    text = "\n".join(" ".join(f"{value:.9g}" for value in matrix.T.ravel()) for matrix in (RTILT, K))
    (folder / clouds).mkdir()
    for key in keys:
        put(folder / "image" / f"{key}.png", png(SUN_IMAGE[:, :, ::-1]))
        put(folder / "calib" / f"{key}.txt", text + "\n")
        if clouds == "depth":
            savemat(folder / "depth" / f"{key}.mat", {"instance": np.c_[xyz, rgb / 255]}, do_compression=True)
        else:
            np.savez(folder / "points" / f"{key}.npz", points=xyz, colors=rgb)


def sunrgbd_scene(folder: Path) -> None:
    write_scene(folder)


def rgbd_folder(folder: Path) -> None:
    put_image(folder / "color" / "0.png", 1)
    height, width = cv2.imread(str(folder / "color" / "0.png")).shape[:2]
    put(folder / "depth" / "0.png", png(np.full((height, width), 1500, np.uint16)))
    put(folder / "camera_intrinsic.json", camera_file(depth_scale=500.0, distortion=[0.1, 0.01, 0, 0]))
    put(folder / "gravity.json", '{"up": [0.1, -1, 0.2]}')


def rgbd_folder_of_two_cameras(folder: Path) -> None:
    rgbd_folder(folder)
    put(folder / "depth" / "0.png", png(np.full((30, 50), 1500, np.uint16)))
    K = [40.0, 0, 0, 0, 40.0, 0, 25.0, 15.0, 1]
    pose = [[1, 0, 0, 0.05], [0, 1, 0, 0.01], [0, 0, 1, -0.02], [0, 0, 0, 1]]
    camera = {"width": 50, "height": 30, "intrinsic_matrix": K, "depth_scale": 500.0, "depth_to_color": pose}
    put(folder / "depth_intrinsic.json", json.dumps(camera))


def nuscenes(folder: Path) -> None:
    small(folder, scenes=1, samples=1, sweeps=0)


def argoverse2(folder: Path) -> None:
    write_log(folder, sweeps=1)


def cloud_folder(folder: Path) -> None:
    put(folder / "0.bin", SCAN.tobytes())
    pose = [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]
    put(folder / "camera_intrinsic.json", camera_file(cloud_to_camera=pose))
    put(folder / "gravity.json", '{"up": [0.1, -1, 0.2]}')


def exported_items(folder: Path) -> list[DatasetItem]:
    """One frame of an RGB-D folder, with a box."""
    with TemporaryDirectory() as place:
        rgbd_folder(Path(place))
        frame = open_recording(Path(place)).frame(0)
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 1.5]), np.eye(3), np.array([0.5, 0.4, 0.3]))
    label = Label("cup", box, uid="a", source=Source.MANUAL, state=ReviewState.ACCEPTED, author="me", time_ns=0)
    return [DatasetItem("take", replace(frame, timestamp_ns=1_500_000_001), [label])]


def rcv(folder: Path) -> None:
    folder.rmdir()
    write("rcv", folder, exported_items(folder), classes=("cup",))


def openlabel(folder: Path) -> None:
    folder.rmdir()
    write("openlabel", folder, exported_items(folder))


def record3d(folder: Path) -> None:
    folder.rmdir()
    made.write_record3d(folder, made.frames(2))


def stray_scanner(folder: Path) -> None:
    made.write_stray_scanner(folder, made.frames(3))


START_S = 1305031102
# The first pose of TUM's fr1/xyz, whose camera looks down on a desk.
POSE = "1.3563 0.6305 1.6380 0.6132 0.5962 -0.3311 -0.3986"
Draw = Callable[[int], np.ndarray]


def write_tum(folder: Path, rgb_ms: Sequence[int], depth_ms: Sequence[int], images: Draw, depths: Draw) -> Path:
    """Writes images (RGB) and depths of these times (ms after the start), numbered in this order."""
    for name, times, draw in (("rgb", rgb_ms, images), ("depth", depth_ms, depths)):
        lines = [f"# {name} images", "# file: 'made.bag'", "# timestamp filename"]
        for number, time_ms in enumerate(times):
            text, content = f"{START_S + time_ms / 1000:.6f}", draw(number)
            put(folder / name / f"{text}.png", png(content[..., ::-1] if name == "rgb" else content))
            lines.append(f"{text} {name}/{text}.png")
        put(folder / f"{name}.txt", "\n".join(lines) + "\n")
    poses = [f"{START_S + time_ms / 1000:.4f} {POSE}" for time_ms in range(-5, 200, 10)]
    put(folder / "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(poses) + "\n")
    return folder


def tum_rgbd(folder: Path) -> None:
    write_tum(
        folder, [0], [10], lambda _: np.full((48, 64, 3), 90, np.uint8), lambda _: np.full((48, 64), 7500, np.uint16)
    )
    matrix = [50.0, 0, 0, 0, 50.0, 0, 32.0, 24.0, 1]
    put(folder / "camera_intrinsic.json", json.dumps({"width": 64, "height": 48, "intrinsic_matrix": matrix}))


BUILDERS: list[Callable[[Path], None]] = [
    kitti_object, kitti_tracking, kitti_raw, sunrgbd_extracted, sunrgbd_scene, rgbd_folder, rgbd_folder_of_two_cameras,
    nuscenes, argoverse2, cloud_folder, rcv, openlabel, tum_rgbd, record3d, stray_scanner,
]  # fmt: skip
