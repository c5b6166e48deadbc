"""KITTI raw drives: the same frames as a tracking folder of the same files, with the drive's timestamps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from kitti_samples import CAMERAS, HEIGHT, LIDAR, P2, R0, TIMES, TR, TRACKING_CALIB, WIDTH

from annotator.recordings import open_recording
from annotator.types.errors import FormatError, FrameError, RecordingError
from annotator.workflows.recorded.reading import has_truth, load_truth


@pytest.fixture(params=["in the drive", "in the day"])
def drive(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Frames 0, 2 and 3 of a drive; frame 1 was dropped by the recorder."""
    path = tmp_path / "2011_09_26" / "2011_09_26_drive_0005_sync"
    images, scans = path / "image_02" / "data", path / "velodyne_points" / "data"
    images.mkdir(parents=True)
    scans.mkdir(parents=True)
    random = np.random.default_rng(0)
    for number in (0, 2, 3):
        image = random.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        (images / f"{number:010d}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
        points = np.c_[random.uniform(-20, 20, (2000, 3)) * [1, 1, 0.2], random.random(2000)].astype(np.float32)
        (scans / f"{number:010d}.bin").write_bytes(points.tobytes())
    place = path if request.param == "in the drive" else path.parent
    (place / "calib_cam_to_cam.txt").write_text(CAMERAS)
    (place / "calib_velo_to_cam.txt").write_text(LIDAR)
    (path / "image_02" / "timestamps.txt").write_text(TIMES)
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


def calibration(name: str) -> Callable[[Path], Path]:
    return lambda drive: next(place / name for place in (drive, drive.parent) if (place / name).is_file())


DAMAGES = [
    (calibration("calib_velo_to_cam.txt"), Path.unlink, "the calibration is missing"),
    (calibration("calib_cam_to_cam.txt"), Path.unlink, "the calibration is missing"),
    (
        calibration("calib_cam_to_cam.txt"),
        lambda p: p.write_text(CAMERAS.replace("P_rect_02", "P")),
        "P_rect_02 is mis",
    ),
    (calibration("calib_velo_to_cam.txt"), lambda p: p.write_text(LIDAR.replace("T: ", "T: 1 ")), "T must have 3 numb"),
    (lambda drive: drive / "image_02" / "timestamps.txt", lambda p: p.write_text("noon\n"), "line 1 must be the time"),
    (lambda drive: drive / "image_02" / "timestamps.txt", lambda p: p.write_bytes(b"\xff"), "cannot be read"),
    (
        lambda drive: drive / "image_02" / "timestamps.txt",
        lambda p: p.write_text("2011-02-31 13:02:25.9\n"),
        "line 1 must be the time",
    ),
]


@pytest.mark.parametrize(("where", "damage", "complaint"), DAMAGES)
def test_errors_name_the_damaged_file(
    drive: Path, where: Callable[[Path], Path], damage: Callable[[Path], object], complaint: str
):
    path = where(drive)
    damage(path)
    with pytest.raises(FrameError, match=complaint) as caught:
        open_recording(drive).frame(0)
    assert caught.value.path == path


def test_the_error_of_a_missing_calibration_says_where_to_put_it(drive: Path):
    for name in ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt"):
        calibration(name)(drive).unlink()
    with pytest.raises(FrameError, match=r"copy calib_cam_to_cam\.txt and calib_velo_to_cam\.txt of the drive's day"):
        open_recording(drive).frame(0)


def test_the_error_of_a_day_names_its_drives_and_an_empty_drive_is_an_error(drive: Path):
    with pytest.raises(RecordingError, match=f"one of them: {drive.name}$"):
        open_recording(drive.parent)
    for path in (*drive.glob("*/data/*.png"), *drive.glob("*/data/*.bin")):
        path.unlink()
    with pytest.raises(RecordingError, match="no frames; expected image_02/data/KEY"):
        open_recording(drive)


TRACKLETS = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization><tracklets><count>1</count><item>
<objectType>Car</objectType><h>1.5</h><w>1.6</w><l>4</l><first_frame>1</first_frame><poses><count>2</count>
<item><tx>9</tx><ty>1</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.3</rz><truncation>0</truncation></item>
<item><tx>10</tx><ty>1</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.3</rz><truncation>0</truncation></item>
</poses></item></tracklets></boost_serialization>
"""


def test_tracklets_are_read_as_labels_in_the_camera_frame(drive: Path):
    assert not has_truth(open_recording(drive))
    (drive / "tracklet_labels.xml").write_text(TRACKLETS)
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
