"""nuScenes as recordings: real boxes and points, samples and sweeps, and errors that name the place."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nuscenes_samples import CAMERAS, START_US, K, ego_pose, mount, real, scan_points, small

from annotator.formats.nuscenes import read_sample_boxes
from annotator.geometry.oriented_box import contains
from annotator.geometry.projection import project
from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.nuscenes import SCANS, NuScenes
from annotator.types.errors import ConfigError, FormatError, FrameError, RecordingError
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
