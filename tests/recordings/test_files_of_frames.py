"""The files of a frame: all readers of folders know them, so that `add` can look at them without reading frames."""

from __future__ import annotations

from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import pytest
import small_recordings as made

from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.recording import KeyedFrames
from annotator.workflows.recorded.condition import broken_frames

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


def test_virtual_cameras_around_a_lidar_have_its_files(tmp_path: Path):
    made.kitti_object(tmp_path)
    base, around = open_recording(tmp_path), open_recording(tmp_path, ReaderOptions(look_around=4))
    assert isinstance(base, KeyedFrames) and isinstance(around, KeyedFrames)
    assert around.files(0) == base.files(0) == (tmp_path / "image_2" / "0.png", tmp_path / "velodyne" / "0.bin")
    (tmp_path / "velodyne" / "0.bin").write_bytes(b"")
    assert list(broken_frames(around, seconds=-1).errors) == ["0"]
