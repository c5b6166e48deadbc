"""Pipes, devices and known damage in place of a recording's files are errors; `tests/damage` tries other damage."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from small_recordings import BUILDERS, cloud_folder, kitti_object, kitti_raw, kitti_tracking, rgbd_folder, sunrgbd_scene

from annotator.recordings import open_recording
from annotator.types.errors import FrameError


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, list[Path]]]:
    """One small recording per format, and its files."""
    found = []
    for build in BUILDERS:
        folder = tmp_path_factory.mktemp(f"{build.__name__}_freiburg")
        if build is sunrgbd_scene:
            folder.rmdir()
        build(folder)
        recording = open_recording(folder)
        assert build.__name__.startswith(recording.format) or recording.format.startswith(build.__name__)
        assert len(recording.frame(0).cloud) > 20
        files = [file for file in sorted(folder.rglob("*")) if file.is_file() and "annotation" not in str(file)]
        found.append((folder, files))
    return found


CALIB_LINE = "P2 has a number that is not finite or is too large"
KNOWN_CASES = [
    (kitti_object, "calib/0.txt", lambda old: re.sub(rb"P2: \S+", b"P2: 1e308", old), CALIB_LINE),
    (kitti_object, "calib/0.txt", lambda old: re.sub(rb"P2: \S+", b"P2: 1e-320", old), "P2 is not a pinhole camera"),
    (
        kitti_raw,
        "calib_velo_to_cam.txt",
        lambda old: re.sub(rb"R: \S+", b"R: 0.9", old),
        "the LiDAR's pose is not a rotation",
    ),
    (
        sunrgbd_scene,
        "extrinsics/20160101.txt",
        lambda old: old.replace(b"0.", b"1e200 ", 1),
        "must have 3 x 4|too large",
    ),
    (rgbd_folder, "camera_intrinsic.json", lambda _: b"[" * 200_000, "not a camera file"),
    (rgbd_folder, "camera_intrinsic.json", lambda old: old.replace(b"500.0", b"1e-320"), "depth_scale"),
    (rgbd_folder, "gravity.json", lambda _: b'{"up": [1e308, 1e308, 0]}', "not a gravity file"),
    (
        cloud_folder,
        "camera_intrinsic.json",
        lambda old: re.sub(rb'(width|height)": [0-9]+', rb'\1": 60000', old),
        "pixels",
    ),
    (kitti_tracking, "velodyne/0.bin", lambda _: struct.pack("<4f", 3e38, 0, 0, 1) * 3, "every point is NaN"),
]


@pytest.mark.parametrize(("build", "name", "change", "complaint"), KNOWN_CASES)
def test_known_cases_are_errors(
    tmp_path: Path, build: Callable[[Path], None], name: str, change: Callable[[bytes], bytes], complaint: str
):
    """Overflowing numbers and images that exhaust memory; each of these was once accepted."""
    folder = tmp_path / "take"
    if build is not sunrgbd_scene:
        folder.mkdir()
    build(folder)
    file = folder / name
    assert change(file.read_bytes()) != file.read_bytes()
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(FrameError, match=complaint) as caught:
        open_recording(folder).frame(0)
    assert str(caught.value).startswith(f"{file}: ")
