"""Virtual cameras around a LiDAR see every direction; scans by columns."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_samples import OBJECT_CALIB, SCAN, camera_file
from column_scans import OTHERS, make_set
from hypothesis import given, settings
from hypothesis import strategies as st
from nuscenes_samples import small
from small_recordings import kitti_object, kitti_raw

from annotator.geometry.projection import inside_image, project
from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.look_around import LookAround, camera_names
from annotator.recordings.scan_file import Scans, weigh_columns
from annotator.types.errors import ConfigError, FrameError, UnclearError
from annotator.workflows.recorded.reading import has_truth, load_truth


def around(path: Path, **options: Any) -> LookAround:
    recording = open_recording(path, ReaderOptions(**options))
    assert isinstance(recording, LookAround)
    return recording


def put_scan(folder: Path, **more: Any) -> Path:
    folder.mkdir(exist_ok=True)
    np.save(folder / "0.npy", SCAN)
    if more:
        (folder / "camera_intrinsic.json").write_text(camera_file(**more))
        (folder / "gravity.json").write_text('{"up": [0.1, -1, 0.2]}')
    return folder


@pytest.mark.parametrize("count", [4, 8])
def test_every_direction_is_seen_by_one_or_two_cameras(tmp_path: Path, count: int):
    rng = np.random.default_rng(0)
    yaw, pitch = rng.uniform(-np.pi, np.pi, 3000), rng.uniform(-0.3, 0.3, 3000)
    flat = rng.uniform(3, 60, 3000)
    points = np.column_stack([flat * np.cos(yaw), flat * np.sin(yaw), flat * np.tan(pitch)])
    np.save(tmp_path / "0.npy", points)
    seen = np.zeros(3000, int)
    poses = []
    for camera in camera_names(count):
        recording = around(tmp_path, look_around=count, camera=camera)
        frame = recording.frame(0)
        assert len(frame.cloud) == 3000 and recording.moment(0) == "0"
        np.testing.assert_allclose(frame.up, [0, -1, 0], atol=1e-9)
        px = project(frame.camera, frame.cloud.xyz_m)
        inside = inside_image(frame.camera, px)
        seen += inside
        assert frame.rgb.any()
        # the direction in the name is that of the camera, to the left of ahead
        forward = recording.T_rig_camera(0).rotation.apply([0, 0, 1])
        assert np.degrees(np.arctan2(forward[1], forward[0])) % 360 == pytest.approx(float(camera[-3:]), abs=1e-6)
        poses.append(recording.T_rig_camera(0).apply(frame.cloud.xyz_m.astype(np.float64)))
    assert set(np.unique(seen)) == {1, 2}
    for placed in poses:
        np.testing.assert_allclose(placed, points, atol=1e-4)


def test_the_first_camera_looks_where_a_virtual_camera_looks_today(tmp_path: Path):
    put_scan(tmp_path)
    today, ahead = open_recording(tmp_path).frame(0), around(tmp_path, look_around=4).frame(0)
    np.testing.assert_allclose(ahead.cloud.xyz_m, today.cloud.xyz_m, atol=1e-6)
    assert around(tmp_path, look_around=4).notes == (
        "4 cameras: around-000, around-090, around-180, around-270; this is around-000 "
        "(--camera names another, or all)",
    )
    with pytest.raises(ConfigError, match="has no virtual camera left; it has around-000, around-090"):
        around(tmp_path, look_around=4, camera="left")


@pytest.mark.parametrize("build", [kitti_object, kitti_raw])
def test_kitti_is_seen_all_around_its_lidar(tmp_path: Path, build: Any):
    build(tmp_path)
    base = open_recording(tmp_path)
    recording = around(tmp_path, look_around=6, camera="around-180")
    frame = recording.frame(0)
    assert (recording.format, recording.keys) == ("look_around", base.keys)
    assert recording.name == f"{tmp_path.name}@around-180"
    assert len(frame.cloud) == len(SCAN) > len(base.frame(0).cloud)
    assert frame.timestamp_ns == base.frame(0).timestamp_ns
    # labels of the recording lie at the same points, seen from either camera
    seen = base.frame(0)
    assert seen.T_camera_label is not None and frame.T_camera_label is not None
    there = frame.T_camera_label.apply(seen.T_camera_label.inv().apply(seen.cloud.xyz_m.astype(np.float64)))
    distance = np.linalg.norm(frame.cloud.xyz_m[:, None] - there[None, :50], axis=2)
    assert distance.min(axis=0).max() < 1e-2
    # level, and backwards: what was ahead of the camera is behind this one
    ahead = around(tmp_path, look_around=6).frame(0)
    np.testing.assert_allclose(ahead.cloud.xyz_m * [-1, 1, -1], frame.cloud.xyz_m, atol=1e-4)
    seen = base.frame(0).cloud.xyz_m
    assert (ahead.cloud.xyz_m[:, 2] > 0).sum() >= len(seen)
    # frames would be taken as labelled where nobody looked
    assert not has_truth(recording)


def test_a_cloud_in_another_frame_is_turned_level(tmp_path: Path):
    pose = [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]
    frame = around(put_scan(tmp_path / "tilted", cloud_to_camera=pose), look_around=4).frame(0)
    camera_frame = open_recording(tmp_path / "tilted").frame(0)
    # heights above the LiDAR are along the stored direction of gravity
    up = camera_frame.up
    assert up is not None
    heights = (camera_frame.cloud.xyz_m - np.array([0.1, 0.2, -0.3])) @ up
    np.testing.assert_allclose(-frame.cloud.xyz_m[:, 1], heights, atol=1e-4)
    (tmp_path / "kitti").mkdir()
    put_scan(tmp_path / "kitti")
    (tmp_path / "kitti" / "calib.txt").write_text(OBJECT_CALIB)
    assert len(around(tmp_path / "kitti", look_around=8, camera="around-315").frame(0).cloud) == len(SCAN)


def test_labels_all_around_belong_to_the_cameras_that_see_them(tmp_path: Path):
    small(tmp_path)
    labels = {
        camera: load_truth(recording, 0, recording.frame(0))
        for camera in camera_names(4)
        for recording in [around(tmp_path, scene="scene-0000", look_around=4, camera=camera)]
    }
    assert [len(labels[camera]) for camera in camera_names(4)] == [1, 0, 1, 0]
    assert labels["around-000"][0].track_id == 0 and labels["around-180"][0].track_id == 1


RANDOM = np.random.default_rng(3)
COUNT = len(SCAN)
# Like SCAN: x y z, then intensity, ring, time, and more.
WIDE = np.column_stack(
    [SCAN, RANDOM.integers(0, 64, COUNT), np.linspace(0, 0.1, COUNT), RANDOM.normal(0, 3, COUNT), np.ones(COUNT)]
).astype(np.float32)


def put(folder: Path, name: str, columns: int, count: int = COUNT) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(WIDE[:count, :columns].tobytes())
    return path


@given(st.integers(100_000, 200_000))
@settings(max_examples=20, deadline=None)
def test_made_up_scans_are_never_taken_for_others(seed: int):
    scans, columns = make_set(seed)
    for scan in scans:
        assert weigh_columns(scan) in (columns, None)


def test_most_made_up_scans_are_recognised():
    sets = [make_set(seed) for seed in range(300, 320)]
    assert {columns for _, columns in sets} == set(range(3, 9))
    assert sum(weigh_columns(scans[0]) == columns for scans, columns in sets) >= 18


@pytest.mark.parametrize("name", OTHERS)
def test_other_files_are_refused(tmp_path: Path, name: str):
    for seed in range(3):
        path = tmp_path / f"{seed}.bin"
        path.write_bytes(OTHERS[name](np.random.default_rng(seed)))
        with pytest.raises(FrameError):
            Scans().read(path)


@pytest.mark.parametrize("columns", [3, 4, 7])
def test_a_folder_of_scans_is_read_by_its_values(tmp_path: Path, columns: int):
    for number in range(3):
        put(tmp_path, f"{number}.bin", columns, COUNT - number)
    recording = open_recording(tmp_path)
    cloud = recording.frame(1).cloud
    assert f"have {columns} values each, which only their values say" in recording.notes[0]
    assert len(cloud) == COUNT - 1
    np.testing.assert_allclose(cloud.xyz_m[:, 2], SCAN[: COUNT - 1, 0], atol=1e-6)
    assert (cloud.reflectance is None) == (columns == 3)


def test_values_that_contradict_name_or_place_are_refused(tmp_path: Path):
    for columns, place in ((6, "velodyne/1.bin"), (8, "velodyne/2.bin"), (4, "points/1.pcd.bin")):
        with pytest.raises(UnclearError, match=f"its (place|name) .* but its values look like rows of {columns}; give"):
            Scans().read(put(tmp_path, place, columns))
        assert len(Scans(columns).read(tmp_path / place).xyz_m) == COUNT


@pytest.mark.parametrize(("columns", "reason"), [(3, ""), (8, ": rows of 8 fit")])
def test_in_doubt_the_option_is_asked_for(tmp_path: Path, columns: int, reason: str):
    """Values without a pattern; and rows that could be two points of half as many values."""
    rows = np.random.default_rng(0).uniform(-1, 1, (600, 3)).astype(np.float32) if columns == 3 else WIDE[:, :8]
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    with pytest.raises(UnclearError, match=f"is not certain{reason}; give --columns N"):
        open_recording(tmp_path).frame(0)
    frame = open_recording(tmp_path, ReaderOptions(columns=columns)).frame(0)
    np.testing.assert_allclose(frame.cloud.xyz_m[:, 2], rows[:, 0], atol=1e-6)


def test_only_reflectances_are_read_as_reflectance(tmp_path: Path):
    for name, fourth, expected in (
        ("a", SCAN[:, 3] * 255, SCAN[:, 3]),
        ("b", SCAN[:, 3] - 0.5, None),
        ("c", np.full(COUNT, 1.5e9), None),
    ):
        path = tmp_path / f"{name}.bin"
        path.write_bytes(np.column_stack([SCAN[:, :3], fourth]).astype(np.float32).tobytes())
        scan = Scans(4).read(path)
        assert len(scan.xyz_m) == COUNT
        assert (scan.reflectance is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(scan.reflectance, expected, atol=1e-6)


def test_a_dark_scan_has_the_reflectance_scale_of_the_first_ones(tmp_path: Path):
    """Alone, its values up to 1 would be read as fractions."""
    for number, most in enumerate((200, 1, 255, 1, 60_000)):
        points = np.column_stack([SCAN[:, :3], np.linspace(0, most, COUNT)]).astype(np.float32)
        (tmp_path / f"{number}.bin").write_bytes(points.tobytes())
    options = ReaderOptions(columns=4)
    for order in ((1, 3, 0, 4), (4, 3, 1, 0)):
        recording = open_recording(tmp_path, options)
        assert isinstance(recording, CloudFolder)
        for number in order:
            reflectance = recording.scan(number).read().reflectance
            assert reflectance is not None
            # the last one is beyond the scale of the others
            expected = {0: 200 / 255, 1: 1 / 255, 3: 1 / 255, 4: 60_000 / 65_535}[number]
            assert reflectance.max() == pytest.approx(expected, rel=1e-5)


@pytest.mark.shared
def test_real_scans_are_read_by_name_and_by_their_values(shared: Path, tmp_path: Path):
    files = [*sorted((shared / "data").glob("kitti*/**/*.bin")), *(shared / "data").glob("nuscenes*/*.bin")]
    assert len(files) == 31
    for file in files[::3]:
        columns = 5 if "nuscenes" in str(file) else 4
        expected = np.fromfile(file, "<f4").reshape(-1, columns)[:, :3]
        np.testing.assert_array_equal(Scans().read(file).xyz_m, expected)
        alone = shutil.copy(file, tmp_path / "scan.bin")
        np.testing.assert_array_equal(Scans().read(alone).xyz_m, expected)
