"""KITTI folders and raw drives: the projection agrees with the data set's formula, and damage gives clear errors."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from cloud_samples import SCAN, image
from kitti_samples import P2, R0, TR, TRACKING_CALIB, by_formula
from small_recordings import kitti_object, kitti_raw, kitti_tracking
from test_kitti_formats import document, pose, tracklet

from annotator.geometry.projection import project
from annotator.recordings import open_recording
from annotator.types.errors import FormatError, FrameError, RecordingError
from annotator.workflows.recorded.reading import has_truth, load_truth

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


def test_a_missing_calibration_of_the_day_is_an_error_that_names_it(drive: Path):
    path = drive.parent / "calib_velo_to_cam.txt"
    path.unlink()
    with pytest.raises(FrameError, match="the calibration is missing") as caught:
        open_recording(drive).frame(0)
    assert caught.value.path == path


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
