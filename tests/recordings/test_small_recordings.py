"""Small recordings of all formats: the files of a frame, which `add` looks at; and known damage is an error."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import pytest
import small_recordings as made
from small_recordings import cloud_folder, kitti_object, kitti_raw, kitti_tracking, rgbd_folder

from annotator.recordings import open_recording
from annotator.recordings.recording import KeyedFrames
from annotator.types.errors import FrameError
from annotator.workflows.recorded.condition import broken_frames

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


FILES: list[tuple[Callable[[Path], None], list[str]]] = [
    (made.rcv, ["labels/take-0.json", "images/take-0.png", "clouds/take-0.ply"]),
    (made.argoverse2, ["sensors/lidar/1532402927000000000.feather", "sensors/cameras/*/1532402927012000000.png"]),
    (made.stray_scanner, ["depth/000000.png", "confidence/000000.png"]),
    (made.sunrgbd_scene, ["intrinsics.txt", "extrinsics/*", "image/*", "depth/*"]),
    (made.cloud_folder, ["0.bin"]),
]


@pytest.mark.parametrize(("build", "names"), FILES)
def test_a_frame_has_these_files_and_an_empty_one_is_seen(
    tmp_path: Path, build: Callable[[Path], None], names: list[str]
):
    folder = tmp_path / "take"
    folder.mkdir()
    build(folder)
    recording = open_recording(folder)
    assert isinstance(recording, KeyedFrames)
    files = recording.files(0)
    found = [file.relative_to(folder).as_posix() for file in files]
    assert len(found) == len(names) and all(map(fnmatch, found, names))
    assert broken_frames(recording, seconds=-1).errors == {}
    for file in files:
        content = file.read_bytes()
        file.write_bytes(b"")
        # not from a cache of what was there before
        assert list(broken_frames(open_recording(folder), seconds=-1).errors) == [recording.keys[0]], file
        file.write_bytes(content)
