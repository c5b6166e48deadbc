"""Numbers of recordings' files that overflow or exhaust memory are errors; `tests/damage` tries other damage."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from small_recordings import cloud_folder, kitti_object, kitti_raw, kitti_tracking, rgbd_folder

from annotator.recordings import open_recording
from annotator.types.errors import FrameError

KNOWN_CASES = [
    (kitti_object, "calib/0.txt", lambda old: re.sub(rb"P2: \S+", b"P2: 1e308", old), "not finite or is too large"),
    (kitti_object, "calib/0.txt", lambda old: re.sub(rb"P2: \S+", b"P2: 1e-320", old), "P2 is not a pinhole camera"),
    (kitti_raw, "calib_velo_to_cam.txt", lambda old: re.sub(rb"R: \S+", b"R: 0.9", old), "pose is not a rotation"),
    (rgbd_folder, "camera_intrinsic.json", lambda _: b"[" * 200_000, "not a camera file"),
    (rgbd_folder, "camera_intrinsic.json", lambda old: old.replace(b"500.0", b"1e-320"), "depth_scale"),
    (rgbd_folder, "gravity.json", lambda _: b'{"up": [1e308, 1e308, 0]}', "not a gravity file"),
    (cloud_folder, "camera_intrinsic.json", lambda old: re.sub(rb'(th|ht)": [0-9]+', rb'\1": 60000', old), "pixels"),
    (kitti_tracking, "velodyne/0.bin", lambda _: struct.pack("<4f", 3e38, 0, 0, 1) * 3, "every point is NaN"),
]


@pytest.mark.parametrize(("build", "name", "change", "complaint"), KNOWN_CASES)
def test_known_cases_are_errors(
    tmp_path: Path, build: Callable[[Path], None], name: str, change: Callable[[bytes], bytes], complaint: str
):
    """Each of these was once accepted."""
    build(tmp_path)
    file = tmp_path / name
    assert change(file.read_bytes()) != file.read_bytes()
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(FrameError, match=complaint) as caught:
        open_recording(tmp_path).frame(0)
    assert str(caught.value).startswith(f"{file}: ")
