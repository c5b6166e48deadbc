"""Frames of real recordings, written as bags and read back; and RealSense's own recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.ros.recording import RosBag, message
from annotator.recordings.ros.topics import list_topics


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
