"""Argoverse 2's logs: the real sweeps, logs with images, and errors that name the file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from argoverse_samples import DELAYS_US, PERIOD_US, put, write_log
from nuscenes_samples import HEIGHT, START_US, WIDTH, K, ego_pose, mount, scan_points
from pyarrow import feather

from annotator.fenced_files import read_feather
from annotator.formats.argoverse import read_argoverse
from annotator.geometry.oriented_box import contains
from annotator.geometry.projection import project
from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.argoverse import ArgoverseLog
from annotator.types.errors import ConfigError, FormatError, FrameError, MissingExtraError, RecordingError
from annotator.workflows.recorded.reading import has_truth, load_truth


def opened(path: Path, **options: Any) -> ArgoverseLog:
    recording = open_recording(path, ReaderOptions(**options))
    assert isinstance(recording, ArgoverseLog)
    return recording


@pytest.mark.shared
def test_the_real_boxes_hold_the_points_that_argoverse_counted(shared: Path):
    recording = opened(shared / "data" / "argoverse2_sample")
    assert (recording.format, len(recording)) == ("argoverse2", 2)
    assert recording.notes == ("sensors/cameras/ has no images; a virtual camera looks ahead",)
    boxes = read_argoverse(recording.path / "annotations.feather")
    counts = read_feather(recording.path / "annotations.feather", {"timestamp_ns": "int", "num_interior_pts": "int"})
    for index, key in enumerate(recording.keys):
        scan, rows = recording.scan(index), boxes[int(key)]
        assert len(rows) == 81
        counted = counts["num_interior_pts"][counts["timestamp_ns"] == int(key)].tolist()
        assert [int(contains(row.box, scan.raw.xyz_m).sum()) for row in rows] == counted


def test_a_frame_is_a_sweep_with_the_nearest_image(tmp_path: Path):
    recording = opened(write_log(tmp_path / "log"), camera="ring_rear_left")
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
    recording = opened(tmp_path)
    assert recording.camera == "ring_front_center"
    assert recording.notes == (
        "2 cameras: ring_front_center, ring_rear_left; this is ring_front_center (--camera names another, or all)",
    )
    with pytest.raises(ConfigError, match="has no camera left; it has ring_front_center, ring_rear_left"):
        opened(tmp_path, camera="left")
    near = next((tmp_path / "sensors" / "cameras" / "ring_front_center").glob("*.png"))
    near.unlink()
    assert len(opened(tmp_path, camera="ring_front_center")) == 2
    assert opened(tmp_path, camera="ring_front_center").notes == (
        "left out: 1 sweep without an image within 0.05 s (--tolerance changes it)",
    )
    with pytest.raises(RecordingError, match=r"no image of ring_front_center is within 0\.001 s of a sweep"):
        opened(tmp_path, camera="ring_front_center", tolerance_s=0.001)
    (tmp_path / "annotations.feather").unlink()
    assert not has_truth(recording)
    (tmp_path / "sensors" / "lidar" / f"{2**63}.feather").touch()
    with pytest.raises(
        RecordingError,
        match=r"lidar: the file 9223372036854775808: the time \d+ ns is beyond the year 2262",
    ):
        opened(tmp_path)


def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    columns = feather.read_table(str(path)).to_pydict()
    change(columns)
    path.unlink()
    put(path, columns)


MOUNTS, INTRINSICS = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
POSES = "city_SE3_egovehicle.feather"
BROKEN: list[tuple[str, Callable[[dict[str, Any]], Any], str]] = [
    (POSES, lambda columns: [values.pop(0) for values in columns.values()], r"has no row for \d+ \(it has"),
    (POSES, lambda columns: columns.pop("qx"), r"has no column qx \(its columns: timestamp_ns, qw, qy"),
    (MOUNTS, lambda columns: columns.update(sensor_name=["a", "b", "c"]), "has no row for ring_front_center"),
]


@pytest.mark.parametrize(("name", "change", "problem"), BROKEN)
def test_errors_of_broken_files_name_them(
    tmp_path: Path, name: str, change: Callable[[dict[str, Any]], Any], problem: str
):
    edit(write_log(tmp_path) / name, change)
    with pytest.raises(FrameError, match=problem) as caught:
        opened(tmp_path, camera="ring_front_center").frame(0)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")


def test_errors_of_labels_and_of_a_missing_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write_log(tmp_path) / "annotations.feather"
    edit(path, lambda columns: columns.update(width_m=[2.0, -1.0] * 3))
    with pytest.raises(FormatError, match=r"annotations\.feather: row 1: box sizes must be positive"):
        read_argoverse(path)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(FormatError, match="is not a Feather file of version 2, or damaged"):
        read_argoverse(path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r'pip install "rcv-annotator\[argoverse\]"'):
        open_recording(tmp_path)
