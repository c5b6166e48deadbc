"""Frames of real recordings, written as bags and read back; and RealSense's own recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_writer import BagWriter, structured
from scipy.spatial.transform import Rotation

from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.image_file import read_depth, read_rgb
from annotator.recordings.ros.messages import cloud_of
from annotator.recordings.ros.recording import RosBag, message
from annotator.recordings.ros.topics import list_topics
from annotator.types import Camera

START_NS = 1_317_000_000 * 10**9


@pytest.mark.shared
def test_kitti_frames_come_back_from_a_bag(shared: Path, tmp_path: Path):
    folder = shared / "data" / "kitti_drive_0005"
    original = open_recording(folder)
    frames = 3
    first = original.frame(0)
    T_camera_lidar = original.calibration("000000").T_camera_lidar
    # the image is 20 ms later than the scan
    late_ns = 20_000_000
    with BagWriter(tmp_path, "ros1", "lz4") as bag:
        bag.transform("/tf_static", START_NS, "camera", "velodyne", T_camera_lidar)
        for i in range(frames):
            time_ns = START_NS + i * 100_000_000
            scan = read_scan(folder / "velodyne" / f"{i:06d}.bin")
            columns = dict(zip(("x", "y", "z", "intensity"), scan.T, strict=True))
            columns["ring"] = np.arange(len(scan), dtype=np.uint16)
            bag.cloud("/velodyne_points", time_ns, structured(columns, padding=2), "velodyne")
            rgb = read_rgb(folder / "image_02" / f"{i:06d}.png")
            bag.image("/cam/image_raw", time_ns + late_ns, rgb[:, :, ::-1], "bgr8", padding=5)
            size = (rgb.shape[1], rgb.shape[0])
            bag.info("/cam/camera_info", time_ns + late_ns, size, first.camera.matrix)
    recording = open_recording(bag.path)
    assert isinstance(recording, RosBag)
    assert (recording.format, recording.keys) == ("ros_bag", ("000000", "000001", "000002"))
    assert not recording.notes
    for i in range(frames):
        frame, expected = recording.frame(i), original.frame(i)
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        assert_same_camera(frame.camera, expected.camera)
        assert frame.timestamp_ns == START_NS + i * 100_000_000 + late_ns
        # the message's points bit for bit
        raw = cloud_of(message(recording.chosen.partner, int(recording.pairs.cloud[i])))
        scan = read_scan(folder / "velodyne" / f"{i:06d}.bin")
        np.testing.assert_array_equal(raw.xyz_m.astype(np.float32), scan[:, :3])
        np.testing.assert_array_equal(raw.reflectance, scan[:, 3])
        # KITTI's matrices are rotations only to seven digits
        assert abs(len(frame.cloud) - len(expected.cloud)) <= 2
        if len(frame.cloud) == len(expected.cloud):
            np.testing.assert_allclose(frame.cloud.xyz_m, expected.cloud.xyz_m, atol=2e-5)
            np.testing.assert_array_equal(frame.cloud.reflectance, expected.cloud.reflectance)


@pytest.mark.shared
def test_rgbd_frames_come_back_from_a_bag(shared: Path, tmp_path: Path):
    folder = shared / "data" / "human_turn"
    original = open_recording(folder)
    camera = original.frame(0).camera
    with BagWriter(tmp_path, "mcap") as bag:
        for i, key in enumerate(original.keys[:3]):
            time_ns = START_NS + i * 33_000_000
            rgb = read_rgb(next((folder / "color").glob(f"{key}.*")))
            size = (rgb.shape[1], rgb.shape[0])
            bag.info("/camera/color/camera_info", time_ns, size, camera.matrix, camera.distortion)
            bag.image("/camera/color/image_raw", time_ns, rgb, "rgb8")
            depth = read_depth(folder / "depth" / f"{key}.png")
            bag.image("/camera/aligned_depth_to_color/image_raw", time_ns + 1000, depth, "16UC1")
            bag.info("/camera/aligned_depth_to_color/camera_info", time_ns, size, camera.matrix, camera.distortion)
    recording = open_recording(bag.path)
    assert not recording.notes
    assert len(recording) == 3
    for i in range(3):
        frame, expected = recording.frame(i), original.frame(i)
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        np.testing.assert_array_equal(frame.depth_m, expected.depth_m)
        np.testing.assert_array_equal(frame.cloud.xyz_m, expected.cloud.xyz_m)
        np.testing.assert_array_equal(frame.cloud.rgb, expected.cloud.rgb)
        np.testing.assert_array_equal(frame.cloud.pixel_index, expected.cloud.pixel_index)
        assert_same_camera(frame.camera, expected.camera)


@pytest.mark.shared
def test_a_real_realsense_recording(shared: Path):
    """The numbers are those of its messages."""
    recording = open_recording(shared / "data" / "realsense" / "single_depth_color_640x480.bag")
    assert isinstance(recording, RosBag)
    assert recording.realsense is not None and recording.chosen.depth is not None
    assert recording.keys == ("000000",)
    frame = recording.frame(0)
    matrix = [[613.2036743164062, 0, 319.9388427734375], [0, 613.4193115234375, 239.18299865722656], [0, 0, 1]]
    np.testing.assert_allclose(frame.camera.matrix, matrix, rtol=1e-12)
    T = recording.realsense.T_color_depth
    np.testing.assert_allclose(T.translation, [0.01431131362915039, 0.000602306448854506, 0.000610804301686585])
    turn = [-5.319880231421298e-05, 0.0064634308469817235, 0.005154853722821664, 0.9999658465385437]
    assert (T.rotation.inv() * Rotation.from_quat(turn)).magnitude() < 1e-7
    content = message(recording.chosen.depth.topic, 0)
    units = np.frombuffer(content.data.tobytes(), "<u2").reshape(480, 640)
    # each point is a pixel of the depth image at its depth, in the colour camera
    matrix = np.array(message(recording.chosen.depth_info, 0).K).reshape(3, 3)
    back = T.inv().apply(frame.cloud.xyz_m.astype(np.float64))
    column, row = ((back[:, axis] / back[:, 2] * matrix[axis, axis] + matrix[axis, 2]) for axis in (0, 1))
    assert max(np.abs(column - np.rint(column)).max(), np.abs(row - np.rint(row)).max()) < 1e-3
    expected_m = units[np.rint(row).astype(int), np.rint(column).astype(int)] * np.float32(0.001)
    np.testing.assert_allclose(back[:, 2], expected_m, atol=1e-6)
    assert len(frame.cloud) > 100_000
    assert frame.depth_m is not None and frame.timestamp_ns == 360_713_523_000
    listed = list_topics(recording.path, ReaderOptions()) or ()
    used = {topic.name.removeprefix("/device_0/"): topic.use for topic in listed if topic.use}
    assert used == {
        "sensor_0/Depth_0/image/data": "depth",
        "sensor_0/Depth_0/info": "rate of the depth",
        "sensor_0/Depth_0/info/camera_info": "camera of the depth",
        "sensor_0/Depth_0/tf/0": "transforms",
        "sensor_0/option/Depth Units/value": "unit of the depth",
        "sensor_1/Color_0/image/data": "image",
        "sensor_1/Color_0/info/camera_info": "camera",
        "sensor_1/Color_0/tf/0": "transforms",
    }


def read_scan(path: Path) -> np.ndarray:
    """The x y z reflectance of a KITTI scan."""
    return np.fromfile(path, "<f4").reshape(-1, 4)


def assert_same_camera(camera: Camera, expected: Camera) -> None:
    assert (camera.width_px, camera.height_px) == (expected.width_px, expected.height_px)
    np.testing.assert_array_equal(camera.matrix, expected.matrix)
    assert camera.distortion == expected.distortion or not (any(camera.distortion) or any(expected.distortion))
