"""KITTI, nuScenes and Argoverse 2: frames agree with the data sets' formulas, and damage gives clear errors."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from argoverse_samples import DELAYS_US, PERIOD_US, put, write_log
from cloud_samples import P2, R0, SCAN, TR, TRACKING_CALIB, by_formula, image
from nuscenes_samples import CAMERAS, HEIGHT, START_US, WIDTH, K, ego_pose, mount, real, scan_points, small
from pyarrow import feather
from small_recordings import kitti_object, kitti_raw, kitti_tracking
from test_kitti_formats import document, pose, tracklet

from annotator.fenced_files import read_feather
from annotator.formats.argoverse import read_argoverse
from annotator.formats.nuscenes import read_sample_boxes
from annotator.geometry.oriented_box import contains
from annotator.geometry.projection import project
from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.argoverse import ArgoverseLog
from annotator.recordings.nuscenes import SCANS, NuScenes
from annotator.types.errors import ConfigError, FormatError, FrameError, MissingExtraError, RecordingError
from annotator.workflows.recorded.reading import has_truth, is_labelled, load_truth


def opened(path: Path, **options: Any) -> NuScenes:
    recording = open_recording(path, ReaderOptions(**options))
    assert isinstance(recording, NuScenes)
    return recording


@pytest.mark.shared
def test_the_real_boxes_hold_the_points_that_nuscenes_counted(shared: Path, tmp_path: Path):
    real(shared / "data" / "nuscenes_frame", tmp_path)
    recording = opened(tmp_path)
    _, scan = recording.moments[0]
    xyz_m = SCANS.read_alone(tmp_path / scan.file).xyz_m
    assert len(xyz_m) == 34_688
    (boxes,) = read_sample_boxes(recording.tables, recording.samples).values()
    counted = [row["num_lidar_pts"] for row in json.loads((recording.tables / "sample_annotation.json").read_text())]
    T_lidar_global = scan.T_global_sensor().inv()
    assert [int(contains(each.box.transformed(T_lidar_global), xyz_m).sum()) for each in boxes] == counted
    assert len(counted) == 69 and sum(counted) > 1000


def turn_rows(tables: Path, *names: str) -> None:
    """Writes the quaternions of tables as x y z w."""
    for name in names:
        rows = json.loads((tables / f"{name}.json").read_text())
        for row in rows:
            row["rotation"] = [*row["rotation"][1:], row["rotation"][0]]
        (tables / f"{name}.json").write_text(json.dumps(rows))


@pytest.mark.parametrize(
    ("yaws_deg", "w_last", "refused"),
    [((0, 0), False, False), ((180, 180), False, False), ((30, 40), True, True), ((0, 45), True, True)],
)
def test_vehicles_stand_upright(tmp_path: Path, yaws_deg: tuple[float, float], w_last: bool, refused: bool):
    tables = small(tmp_path, scenes=1) / "v1.0-mini"
    rows = json.loads((tables / "ego_pose.json").read_text())
    for row, yaw in zip(rows, np.radians(np.linspace(*yaws_deg, len(rows))) / 2, strict=True):
        row["rotation"] = [np.cos(yaw), 0, 0, np.sin(yaw)]
    (tables / "ego_pose.json").write_text(json.dumps(rows))
    if w_last:
        turn_rows(tables, "ego_pose")
    if refused:
        with pytest.raises(RecordingError, match=rf"of {len(rows)} poses of the vehicle are tilted"):
            opened(tmp_path)
    else:
        turn = opened(tmp_path).moments[0][1].ego.rotation
        np.testing.assert_allclose(turn, rows[2]["rotation"])


def test_a_frame_is_an_image_with_the_scan_moved_to_its_time(tmp_path: Path):
    recording = opened(small(tmp_path), scene="scene-0000", camera="CAM_BACK")
    assert (recording.name, recording.format, len(recording)) == ("scene-0000@CAM_BACK", "nuscenes", 6)
    assert recording.notes == ()
    for index in (0, 4):
        frame = recording.frame(index)
        at_us = START_US + index * 500_000 // 3
        assert (frame.key, frame.timestamp_ns) == (f"n0__CAM_BACK__{at_us + 20_000}", (at_us + 20_000) * 1000)
        T_camera_global = (ego_pose(at_us + 20_000) * mount("CAM_BACK")).inv()
        T_camera_lidar = T_camera_global * ego_pose(at_us) * mount("LIDAR_TOP")
        points = scan_points(index)
        xyz_m = T_camera_lidar.apply(points[:, :3].astype(np.float64))
        px = project(frame.camera, xyz_m)
        kept = (xyz_m[:, 2] > 0.1) & ((px >= -0.5) & (px < [63.5, 47.5])).all(axis=1)
        np.testing.assert_allclose(frame.cloud.xyz_m, xyz_m[kept], atol=1e-5)
        np.testing.assert_allclose(frame.cloud.reflectance, points[kept, 3] / 255, atol=1e-6)
        assert kept.sum() > 100
        np.testing.assert_allclose(frame.camera.matrix, K)
        np.testing.assert_allclose(frame.up, T_camera_global.rotation.apply([0, 0, 1]), atol=1e-12)


def test_samples_have_labels_and_tracks_and_sweeps_have_none(tmp_path: Path):
    small(tmp_path)
    for scene in (0, 1):
        start_us = START_US + scene * 10**7
        for camera, size in zip(CAMERAS, ([3, 1, 2], [4, 2, 1.5]), strict=True):
            recording = opened(tmp_path, scene=f"scene-{scene:04}", camera=camera)
            assert has_truth(recording)
            assert [is_labelled(recording, key) for key in recording.keys] == [True, False, False] * 2
            (truth,) = load_truth(recording, 0, recording.frame(0))
            assert (truth.label, truth.track_id) == ("vehicle.car", 2 * scene + (camera == "CAM_BACK"))
            np.testing.assert_allclose(truth.box.size_m, size)
            delay_us, x_m = (20_000, -8.0) if camera == "CAM_BACK" else (-15_000, 10.0)
            T_camera_ego = (ego_pose(start_us + delay_us) * mount(camera)).inv() * ego_pose(start_us)
            np.testing.assert_allclose(truth.box.center_m, T_camera_ego.apply([x_m, 0.5, 1.0]), atol=1e-6)
            np.testing.assert_allclose(truth.box.rotation, T_camera_ego.rotation.as_matrix(), atol=1e-9)
            assert load_truth(recording, 1, recording.frame(1)) == []


def test_the_first_scene_and_the_front_camera_are_read_unless_others_are_named(tmp_path: Path):
    recording = opened(small(tmp_path))
    assert (recording.scene, recording.camera) == ("scene-0000", "CAM_FRONT")
    assert recording.notes == (
        "2 scenes: scene-0000, scene-0001; this is scene-0000 (--scene names another, or all)",
        "2 cameras: CAM_BACK, CAM_FRONT; this is CAM_FRONT (--camera names another, or all)",
    )
    assert opened(tmp_path / "v1.0-mini").keys == recording.keys
    with pytest.raises(ConfigError, match="has no scene x; it has scene-0000, scene-0001"):
        opened(tmp_path, scene="x")
    with pytest.raises(ConfigError, match="scene-0000: has no camera left; it has CAM_BACK, CAM_FRONT"):
        opened(tmp_path, camera="left")
    (tmp_path / "v1.0-trainval").symlink_to(tmp_path / "v1.0-mini")
    with pytest.raises(RecordingError, match=r"several folders of tables \(v1\.0-mini, v1\.0-trainval\)"):
        opened(tmp_path)


def test_without_the_sweeps_only_samples_are_read(tmp_path: Path):
    small(tmp_path, scenes=1)
    (tmp_path / "sweeps").rename(tmp_path / "elsewhere")
    recording = opened(tmp_path, camera="CAM_FRONT")
    assert len(recording) == 2 and all(is_labelled(recording, key) for key in recording.keys)
    assert recording.notes == (
        "left out, because these folders are missing: sweeps/CAM_BACK, sweeps/CAM_FRONT, sweeps/LIDAR_TOP",
    )
    (tmp_path / "elsewhere").rename(tmp_path / "sweeps")
    near = opened(tmp_path, camera="CAM_FRONT", tolerance_s=0.001)
    assert len(near) == 2
    assert near.notes == ("left out: 4 images without a scan within 0.001 s (--tolerance changes it)",)


def test_a_scene_without_images_is_seen_by_virtual_cameras(tmp_path: Path):
    small(tmp_path, scenes=1)
    for place in ("samples", "sweeps"):
        for channel in CAMERAS:
            shutil.rmtree(tmp_path / place / channel)
    recording = opened(tmp_path)
    assert recording.notes[-1] == "has no images; a virtual camera looks ahead"
    assert (recording.name, len(recording), recording.keys[0]) == ("scene-0000", 6, f"n0__LIDAR_TOP__{START_US}")
    assert [is_labelled(recording, key) for key in recording.keys] == [True, False, False] * 2
    around = open_recording(tmp_path, ReaderOptions(look_around=4, camera="around-180"))
    for one, place_m in ((recording, 10.0), (around, 8.0)):
        frame = one.frame(0)
        assert len(frame.cloud) == 4000 and frame.timestamp_ns == START_US * 1000
        (truth,) = load_truth(one, 0, frame)
        # level, ahead of the vehicle or behind it; the LiDAR is 0.9 m before the vehicle's origin, on a slope
        np.testing.assert_allclose(truth.box.center_m[2], place_m + (0.9 if one is around else -0.9), atol=0.15)
        np.testing.assert_allclose(frame.up, [0, -1, 0], atol=1e-9)
    with pytest.raises(ConfigError, match="scene-0000: has no camera CAM_FRONT; it has none"):
        opened(tmp_path, camera="CAM_FRONT")


def test_the_test_split_has_no_labels(tmp_path: Path):
    small(tmp_path, scenes=1)
    assert has_truth(opened(tmp_path))
    (tmp_path / "v1.0-mini" / "sample_annotation.json").write_text("[\n]\n")
    assert not has_truth(opened(tmp_path))


def edit(folder: Path, table: str, change: Callable[[list[dict[str, Any]]], Any]) -> None:
    path = folder / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    change(rows)
    path.write_text(json.dumps(rows))


BROKEN: list[tuple[str, Callable[[list[dict[str, Any]]], Any], str]] = [
    ("sample_data", lambda rows: rows[-1].pop("filename"), r"the row at byte \d+: filename: Field required"),
    ("sample_data", lambda rows: rows[-1].update(filename="/dev/zero"), "filename: .*must be a path in the dataset"),
    ("ego_pose", lambda rows: rows.pop(), r"refers to LIDAR_TOP1-5, which is not in ego_pose\.json"),
    ("scene", lambda rows: rows[1].update(name="scene-0000"), r"scene\.json: two scenes are called scene-0000"),
    ("ego_pose", lambda rows: rows[-2].update(rotation=[0, 0, 0, 0]), "is not a unit quaternion"),
    ("ego_pose", lambda rows: rows[-2].update(translation=[0, 0, 1e6]), "lies in the image"),
]


@pytest.mark.parametrize(("table", "change", "problem"), BROKEN)
def test_errors_of_broken_tables_name_the_place(
    tmp_path: Path, table: str, change: Callable[[list[dict[str, Any]]], Any], problem: str
):
    edit(small(tmp_path), table, change)
    with pytest.raises(RecordingError, match=problem) as caught:
        opened(tmp_path, scene="scene-0001" if table != "scene" else None, camera="CAM_FRONT").frame(5)
    assert str(caught.value).startswith(str(tmp_path))


def test_errors_of_scans_and_labels_name_the_file(tmp_path: Path):
    recording = opened(small(tmp_path))
    scan = tmp_path / recording.moments[0][1].file
    scan.write_bytes(scan.read_bytes()[:-4])
    with pytest.raises(FrameError, match=r"pcd\.bin: the scan is truncated: 79996 bytes are not a multiple of 20"):
        recording.frame(0)
    edit(tmp_path, "instance", lambda rows: rows.clear())
    with pytest.raises(FormatError, match=r"sample_annotation\.json: row ap0-0ahead: refers to the token i0ahead"):
        load_truth(recording, 0, recording.frame(1))


IMAGE = image(1)


@pytest.fixture(params=["training", "."])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Frames 000003 and 000005 of either format."""
    build = kitti_tracking if request.param == "." else kitti_object
    build(tmp_path / request.param, ("000003", "000005"))
    return tmp_path


def test_the_cloud_contains_the_points_on_the_image_with_their_colours(folder: Path):
    frame = open_recording(folder).frame(0)
    px, inside = by_formula(SCAN)
    assert 10 < inside.sum() < len(SCAN) / 2
    np.testing.assert_array_equal(frame.cloud.reflectance, SCAN[inside, 3])
    np.testing.assert_allclose(project(frame.camera, frame.cloud.xyz_m), px[inside], atol=2e-3)  # float32 points
    u, v = np.rint(px[inside]).astype(int).T
    np.testing.assert_array_equal(frame.cloud.rgb, IMAGE[v, u])
    np.testing.assert_array_equal(frame.rgb, IMAGE)
    assert frame.cloud.pixel_index is None
    assert frame.depth_m is None
    np.testing.assert_array_equal(frame.up, [0, -1, 0])


def test_tracking_frames_have_timestamps(folder: Path):
    recording = open_recording(folder)
    times = [recording.frame(i).timestamp_ns for i in range(len(recording))]
    expected = [300_000_000, 500_000_000] if recording.is_sequence else [None, None]
    assert times == expected


def root_of(folder: Path) -> Path:
    return open_recording(folder).root


def scan_path(folder: Path) -> Path:
    return root_of(folder) / "velodyne" / "000003.bin"


def calib_path(folder: Path) -> Path:
    flat = root_of(folder) / "calib.txt"
    return flat if flat.is_file() else root_of(folder) / "calib" / "000003.txt"


def test_invalid_points_are_left_out(folder: Path):
    broken = SCAN.copy()
    broken[::7, 1] = np.nan
    scan_path(folder).write_bytes(broken.tobytes())
    inside = by_formula(SCAN)[1] & np.isfinite(broken).all(axis=1)
    assert len(open_recording(folder).frame(0).cloud) == inside.sum()


def test_a_missing_calibration_is_an_error_of_its_frame_or_of_the_recording(folder: Path):
    path = calib_path(folder)
    path.unlink()
    missing = "calib.txt"
    if path.name != missing:
        with pytest.raises(FrameError, match="the calibration is missing"):
            open_recording(folder).frame(0)
        assert open_recording(folder).frame(1).key == "000005"
        shutil.rmtree(path.parent)
        missing = "calib/"
    with pytest.raises(RecordingError, match=f"looks like a KITTI .* folder: {missing} is missing; copy it"):
        open_recording(folder)


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Frames 0, 2 and 3 of a drive; frame 1 was dropped by the recorder. The day's calibration is above its drives."""
    path = tmp_path / "2011_09_26" / "2011_09_26_drive_0005_sync"
    kitti_raw(path, [f"{number:010d}" for number in (0, 2, 3)])
    for file in path.glob("calib_*.txt"):
        file.rename(path.parent / file.name)
    return path


def test_a_drive_has_the_same_frames_as_a_tracking_folder(drive: Path, tmp_path: Path):
    same = tmp_path / "tracking"
    same.mkdir()
    (same / "image_02").symlink_to(drive / "image_02" / "data")
    (same / "velodyne").symlink_to(drive / "velodyne_points" / "data")
    (same / "calib.txt").write_text(TRACKING_CALIB)
    raw, tracking = open_recording(drive), open_recording(same)
    assert (raw.format, raw.name, raw.is_sequence) == ("kitti_raw", "2011_09_26_drive_0005_sync", True)
    assert raw.keys == tracking.keys == ("0000000000", "0000000002", "0000000003")
    for i in range(3):
        a, b = raw.frame(i), tracking.frame(i)
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_allclose(a.cloud.xyz_m, b.cloud.xyz_m, atol=1e-5)
        np.testing.assert_array_equal(a.cloud.rgb, b.cloud.rgb)
        np.testing.assert_allclose(a.T_camera_label.as_matrix(), b.T_camera_label.as_matrix())


def test_times_are_read_from_the_drive(drive: Path):
    times = [open_recording(drive).frame(i).timestamp_ns for i in range(3)]
    assert times == [1_317_042_145_964_389_445, 1_317_042_146_000_000_000, 1_317_042_146_500_000_000]
    (drive / "image_02" / "timestamps.txt").unlink()
    assert [open_recording(drive).frame(i).timestamp_ns for i in range(3)] == [0, 200_000_000, 300_000_000]


CAR = tracklet("Car", (1.5, 1.6, 4), 1, pose(9, 1, -1.7, 0.3), pose(10, 1, -1.7, 0.3))


def test_tracklets_are_read_as_labels_in_the_camera_frame(drive: Path):
    assert not has_truth(open_recording(drive))
    (drive / "tracklet_labels.xml").write_text(document(CAR))
    recording = open_recording(drive)
    found = [load_truth(recording, i, recording.frame(i)) for i in range(3)]
    # the poses are for frames 1 and 2; the recording has frames 0, 2 and 3
    assert [len(truths) for truths in found] == [0, 1, 0]
    ((truth,),) = found[1:2]
    assert (truth.label, truth.track_id) == ("Car", 0)
    shift = np.linalg.solve(P2[:, :3], P2[:, 3])
    # the matrices are rotations only to four digits; boxes are rotated by exact ones
    np.testing.assert_allclose(truth.box.center_m, R0 @ TR @ [10, 1, -1.7 + 0.75, 1] + shift, atol=2e-3)
    np.testing.assert_allclose(truth.box.size_m, [4, 1.6, 1.5])
    ahead = R0 @ TR[:, :3] @ [np.cos(0.3), np.sin(0.3), 0]
    assert truth.box.rotation[:, 0] @ ahead / np.linalg.norm(ahead) > 0.99999
    assert -truth.box.rotation[1, 2] > 0.999, "the box is upright in the camera frame"
    images = drive / "image_02" / "data"
    (images / "0000000003.png").rename(images / "last.png")
    with pytest.raises(FormatError, match="numbers its frames, but the key 'last' is not a number"):
        load_truth(open_recording(drive), 3, recording.frame(0))


def opened_log(path: Path, **options: Any) -> ArgoverseLog:
    recording = open_recording(path, ReaderOptions(**options))
    assert isinstance(recording, ArgoverseLog)
    return recording


@pytest.mark.shared
def test_the_real_boxes_hold_the_points_that_argoverse_counted(shared: Path):
    recording = opened_log(shared / "data" / "argoverse2_sample")
    assert (recording.format, len(recording)) == ("argoverse2", 2)
    assert recording.notes == ("sensors/cameras/ has no images; a virtual camera looks ahead",)
    boxes = read_argoverse(recording.path / "annotations.feather")
    counts = read_feather(recording.path / "annotations.feather", {"timestamp_ns": "int", "num_interior_pts": "int"})
    for index, key in enumerate(recording.keys):
        scan, rows = recording.scan(index), boxes[int(key)]
        assert len(rows) == 81
        counted = counts["num_interior_pts"][counts["timestamp_ns"] == int(key)].tolist()
        assert [int(contains(row.box, scan.read().xyz_m).sum()) for row in rows] == counted


def test_a_frame_is_a_sweep_with_the_nearest_image(tmp_path: Path):
    recording = opened_log(write_log(tmp_path / "log"), camera="ring_rear_left")
    assert (recording.name, recording.notes) == ("log@ring_rear_left", ())
    for index in (0, 2):
        frame = recording.frame(index)
        sweep_us = START_US + index * PERIOD_US
        image_us = sweep_us + DELAYS_US["ring_rear_left"]
        assert (frame.key, frame.timestamp_ns) == (f"{sweep_us * 1000}", image_us * 1000)
        T_camera_city = (ego_pose(image_us) * mount("CAM_BACK")).inv()
        points = scan_points(index)[:, :4].astype(np.float16).astype(np.float64)
        xyz_m = (T_camera_city * ego_pose(sweep_us)).apply(points[:, :3])
        px = project(frame.camera, xyz_m)
        kept = (xyz_m[:, 2] > 0.1) & ((px >= -0.5) & (px < [WIDTH - 0.5, HEIGHT - 0.5])).all(axis=1)
        np.testing.assert_allclose(frame.cloud.xyz_m, xyz_m[kept], atol=1e-5)
        np.testing.assert_allclose(frame.cloud.reflectance, scan_points(index)[kept, 3] / 255, atol=1e-6)
        np.testing.assert_allclose(frame.camera.matrix, K)
        # the images are undistorted, though the file has coefficients
        assert frame.camera.is_ideal
        np.testing.assert_allclose(frame.up, T_camera_city.rotation.apply([0, 0, 1]), atol=1e-12)
        (truth,) = load_truth(recording, index, frame)
        assert (truth.label, truth.track_id) == ("PEDESTRIAN", 1)
        np.testing.assert_allclose(truth.box.center_m, (T_camera_city * ego_pose(sweep_us)).apply([-8.0, 0, 0.9]))


def test_cameras_and_sweeps_without_images(tmp_path: Path):
    write_log(tmp_path)
    recording = opened_log(tmp_path)
    assert recording.camera == "ring_front_center"
    assert recording.notes == (
        "2 cameras: ring_front_center, ring_rear_left; this is ring_front_center (--camera names another, or all)",
    )
    with pytest.raises(ConfigError, match="has no camera left; it has ring_front_center, ring_rear_left"):
        opened_log(tmp_path, camera="left")
    near = next((tmp_path / "sensors" / "cameras" / "ring_front_center").glob("*.png"))
    near.unlink()
    assert len(opened_log(tmp_path, camera="ring_front_center")) == 2
    assert opened_log(tmp_path, camera="ring_front_center").notes == (
        "left out: 1 sweep without an image within 0.05 s (--tolerance changes it)",
    )
    with pytest.raises(RecordingError, match=r"no image of ring_front_center is within 0\.001 s of a sweep"):
        opened_log(tmp_path, camera="ring_front_center", tolerance_s=0.001)
    (tmp_path / "annotations.feather").unlink()
    assert not has_truth(recording)
    (tmp_path / "sensors" / "lidar" / f"{2**63}.feather").touch()
    with pytest.raises(
        RecordingError,
        match=r"lidar: the file 9223372036854775808: the time \d+ ns is beyond the year 2262",
    ):
        opened_log(tmp_path)


def edited_log(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    columns = feather.read_table(str(path)).to_pydict()
    change(columns)
    path.unlink()
    put(path, columns)


MOUNTS, INTRINSICS = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
POSES = "city_SE3_egovehicle.feather"
BROKEN_LOGS: list[tuple[str, Callable[[dict[str, Any]], Any], str]] = [
    (POSES, lambda columns: [values.pop(0) for values in columns.values()], r"has no row for \d+ \(it has"),
    (POSES, lambda columns: columns.pop("qx"), r"has no column qx \(its columns: timestamp_ns, qw, qy"),
    (MOUNTS, lambda columns: columns.update(sensor_name=["a", "b", "c"]), "has no row for ring_front_center"),
]


@pytest.mark.parametrize(("name", "change", "problem"), BROKEN_LOGS)
def test_errors_of_broken_files_name_them(
    tmp_path: Path, name: str, change: Callable[[dict[str, Any]], Any], problem: str
):
    edited_log(write_log(tmp_path) / name, change)
    with pytest.raises(FrameError, match=problem) as caught:
        opened_log(tmp_path, camera="ring_front_center").frame(0)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")


def test_errors_of_labels_and_of_a_missing_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write_log(tmp_path) / "annotations.feather"
    edited_log(path, lambda columns: columns.update(width_m=[2.0, -1.0] * 3))
    with pytest.raises(FormatError, match=r"annotations\.feather: row 1: box sizes must be positive"):
        read_argoverse(path)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(FormatError, match="is not a Feather file of version 2, or damaged"):
        read_argoverse(path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r'pip install "rcv-annotator\[argoverse\]"'):
        open_recording(tmp_path)
