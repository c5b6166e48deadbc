"""Small recordings of all formats: the files of a frame, which `add` looks at; known damage is an error; times."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
import small_recordings as made
from small_recordings import cloud_folder, kitti_object, kitti_raw, kitti_tracking, rgbd_folder

from annotator.recordings import open_recording
from annotator.recordings.frame_times import has_times, known_times, read_times, recorded_times
from annotator.recordings.recording import Recording
from annotator.types.errors import FrameError, RecordingError
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
    assert isinstance(recording, Recording)
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


EPOCH, STEP = 1_700_000_000_000_000_000, 100_000_000
TABLE = [
    pytest.param((0, STEP, 2 * STEP), (0, STEP, 2 * STEP), id="start"),
    pytest.param((0, 0, 0), (None, None, None), id="all"),
    pytest.param((0,), (None,), id="only"),
    pytest.param((EPOCH, 0, EPOCH + STEP), (EPOCH, None, EPOCH + STEP), id="one"),
    pytest.param((0, EPOCH, EPOCH + STEP), (None, EPOCH, EPOCH + STEP), id="first"),
    pytest.param((0, None, STEP), (None, None, STEP), id="before a gap"),
]


@pytest.mark.parametrize(("written", "known"), TABLE)
def test_times_of_0_are_unknown(tmp_path: Path, written: tuple[int | None, ...], known: tuple[int | None, ...]):
    assert known_times(written) == known
    lines = [f"{key},{time}\n" for key, time in enumerate(written) if time is not None]
    (tmp_path / "timestamps.csv").write_text("key,timestamp_ns\n" + "".join(lines))
    for key in range(len(written)):
        np.save(tmp_path / f"{key}.npy", np.random.default_rng(key).uniform(2, 9, (20, 3)))
    recording = open_recording(tmp_path)
    assert tuple((recorded_times(recording) or {}).values()) == known
    assert tuple(recording.frame(i).timestamp_ns for i in range(len(written))) == known
    assert has_times(recording) == (sum(time is not None for time in known) > 1)
    told = [note for note in recording.notes if "which is taken as unknown" in note]
    assert len(told) == (written != known)


# Unit in nanoseconds, frames per second, start in seconds, and the step that is told; None: they are read.
UNITS = [
    *((unit, rate, start, 1e9 / rate / unit) for unit in (10**9, 10**3) for rate, start in ((1, 1.7e9), (25, 0.5))),
    # nanoseconds, also of a computer that has run for 20 days, and of fast sensors
    *((1, rate, start, None) for rate, start in ((0.1, 0.5), (30, 20 * 86_400), (500, 1.7e9))),
]


@pytest.mark.parametrize(("unit_ns", "rate", "start_s", "step"), UNITS)
def test_times_in_another_unit_are_refused(
    tmp_path: Path, unit_ns: int, rate: float, start_s: float, step: float | None
):
    times = {f"{n:02}": (round(start_s * 1e9) + n * round(1e9 / rate)) // unit_ns for n in range(40)}
    rows = "".join(f"{key},{time}\n" for key, time in times.items())
    (tmp_path / "timestamps.csv").write_text(f"key,timestamp_ns\n{rows}")
    if step is None:
        assert read_times(tmp_path, [*times]) == (tuple(times.values()), ())
        return
    with pytest.raises(
        RecordingError,
        match=rf"timestamps\.csv: the times are {re.escape(f'{max(step, 1):g}')} ns .*so their unit is probably",
    ):
        read_times(tmp_path, [*times])


def test_lists_of_tum_without_times_are_an_error(tmp_path: Path):
    for name in ("rgb", "depth"):
        (tmp_path / f"{name}.txt").write_text(f"0 {name}/1.png\n0.0 {name}/2.png\n1 {name}/3.png\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt: the time of 2 images is 0"):
        open_recording(tmp_path)
