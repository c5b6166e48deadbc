"""Poses of recordings: a point on a wall has one place in the world in all frames, with numbers by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import phone_samples as phone
import pytest
from argoverse_samples import write_log
from bag_writer import IMAGE, MS, SIZE, START_NS, BagWriter, K, write_camera, write_mount, write_scan
from cloud_samples import CAMERAS, LIDAR, OBJECT_CALIB, SCAN, TRACKING_CALIB, put_image, row
from nuscenes_samples import small
from rgbd_samples import wall, write_rgbd
from scipy.spatial.transform import RigidTransform, Rotation
from small_recordings import POSE, put, write_tum

from annotator.recordings import ReaderOptions, Recording, open_recording
from annotator.recordings.poses import HOLDS_NS, LONGEST_GAP_NS, Poses, survey_poses
from annotator.types.errors import RecordingError

NO_TURN = (0.0, 0.0, 0.0, 1.0)
HALF = float(np.sqrt(0.5))
HEADER = "key,x,y,z,qw,qx,qy,qz\n"


def place(pose: RigidTransform | None, *point_m: float) -> np.ndarray:
    assert pose is not None
    return np.asarray(pose.apply(np.array(point_m)))


def same(found: np.ndarray, *expected: float, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(found, expected, atol=atol)


def require_said(recording: Recording) -> None:
    """The frame and the recording say the same of its camera, and each kind of virtual camera, too."""
    for i in range(len(recording)):
        pose, frame = recording.pose(i), recording.frame(i)
        assert pose is not None and frame.T_world_camera is not None
        assert frame.in_map == (recording.pose_source is None)
        np.testing.assert_allclose(frame.T_world_camera.as_matrix(), pose.as_matrix(), atol=1e-9)


def test_poses_between_rows_are_interpolated_and_gaps_have_none():
    table = np.array([[0, 0, 0, *NO_TURN], [1, 2, 3, 0, 0, HALF, HALF], [9, 9, 9, *NO_TURN]])
    times_ns = np.array([0, 100 * MS, 100 * MS + LONGEST_GAP_NS + 1])
    poses = Poses("made", table[:, :3], table[:, 3:], times_ns)
    quarter = poses.at(0, 25 * MS)
    same(place(quarter, 0, 0, 0), 0.25, 0.5, 0.75)
    same(quarter.rotation.as_rotvec(degrees=True), 0, 0, 22.5)  # type: ignore[union-attr]
    assert poses.at(0, 200 * MS) is None and poses.at(0, None) is None
    assert poses.at(0, -HOLDS_NS - 1) is None and poses.at(0, int(times_ns[-1]) + HOLDS_NS + 1) is None
    same(place(poses.at(0, -HOLDS_NS), 0, 0, 0), 0, 0, 0)
    same(place(poses.at(0, 100 * MS + HOLDS_NS), 0, 0, 0), 1, 2, 3)


def advancing(count: int = 3) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Images of a wall 2 m ahead of a camera that comes 0.25 m nearer from frame to frame."""
    return {
        f"{n}": (np.full((6, 8, 3), 128, np.uint8), np.full((6, 8), 2000 - 250 * n, np.uint16)) for n in range(count)
    }


# The camera looks along x of the world (its y is the world's -z), from (10, 20, 1.5).
LOOKS_X = "0.5,-0.5,0.5,-0.5"
BY_KEY = HEADER + "".join(f"{n},{10 + 0.25 * n},20,1.5,{LOOKS_X}\n" for n in range(3))
BY_TIME = "qx,qy,qz,qw,timestamp_ns,z,y,x\n" + "".join(
    f"-0.5,0.5,-0.5,0.5,{START_NS + n * 50 * MS},1.5,20,{9.75 + 0.125 * n}\n" for n in range(7)
)
MATRIX = "0 0 1 {}\n-1 0 0 20\n0 -1 0 1.5\n0 0 0 1\n"
LOG = "".join(f"{n} {n} {n + 1}\n" + MATRIX.format(10 + 0.25 * n) for n in range(3))


def trajectory() -> str:
    """World to camera, column by column."""
    extrinsic = [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 20, 1.5]
    return json.dumps({
        "class_name": "PinholeCameraTrajectory",
        "parameters": [{"extrinsic": [*extrinsic, -10 - 0.25 * n, 1], "intrinsic": {"intrinsic_matrix": [1]}}
                       for n in range(3)],
    })  # fmt: skip


@pytest.mark.parametrize(
    ("name", "text"),
    [("poses.csv", BY_KEY), ("poses.csv", BY_TIME), ("trajectory.log", LOG), ("camera_trajectory.json", trajectory())],
    ids=["by key", "by time", "log", "json"],
)
def test_a_wall_before_a_depth_camera_stands_still(tmp_path: Path, name: str, text: str):
    write_rgbd(tmp_path, advancing())
    put(tmp_path / name, text)
    times = [f"{n},{START_NS + (100 * n + 100) * MS}\n" for n in range(3)]
    put(tmp_path / "timestamps.csv", "key,timestamp_ns\n" + "".join(times))
    recording = open_recording(tmp_path)
    require_said(recording)
    assert recording.pose_source == name
    for i in range(3):
        cloud = recording.frame(i).cloud.xyz_m
        first, last = cloud[0], cloud[-1]
        same(place(recording.pose(i), 0, 0, first[2]), 12, 20, 1.5, atol=1e-6)
        # the image's top left is the world's left (+y) and up (+z)
        top_left, bottom_right = place(recording.pose(i), *first), place(recording.pose(i), *last)
        assert top_left[1] > 20 > bottom_right[1] and top_left[2] > 1.5 > bottom_right[2]
    report = survey_poses(recording)
    assert report is not None
    assert (report.posed, report.gaps, report.jumps, round(report.way_m, 9)) == (3, (), (), 0.5)


def test_map_coordinates_are_exact(tmp_path: Path):
    """UTM: a point a metre ahead is there to the micrometre."""
    write_rgbd(tmp_path, wall(2))
    put(
        tmp_path / "poses.csv",
        HEADER + "000000,512345.678901,5412345.678901,1,1,0,0,0\n000001,512345.678902,5412345.678901,1,1,0,0,0\n",
    )
    recording = open_recording(tmp_path)
    step = recording.pose(0).inv() * recording.pose(1)  # type: ignore[union-attr, operator]
    same(step.translation, 1e-6, 0, 0, atol=2e-9)


ODD: list[tuple[str, str, str]] = [
    ("poses.csv", "key,x,y,z,qw,qx,qy\n", r"poses\.csv:1: the header must name key or timestamp_ns, and x"),
    ("poses.csv", "", "is not a table"),
    ("poses.csv", "x,y,z,qw,qx,qy,qz\n", r"poses\.csv:1: the header"),
    ("poses.csv", HEADER + "000000,0,0,nan,1,0,0,0\n", r":2: must be a place and a quaternion, of finite numbers"),
    ("poses.csv", HEADER + "000000,0,0,1e30,1,0,0,0\n", r":2: must be a place and a quaternion"),
    ("poses.csv", HEADER + "000000,0,0,0,1,1,0,0\n", r":2: must be a unit quaternion, but its length is 1\.414"),
    ("poses.csv", HEADER + "000000,0,0,0,1,0,0\n", ":2: must have 8 values, not 7"),
    ("poses.csv", HEADER + "000000,0,0,x,1,0,0,0\n", "line 2: 'x' is"),
    ("poses.csv", HEADER + "000000,0,0,0,1,0,0,0\n" * 2, ":3: key 000000 already has a line"),
    ("poses.csv", HEADER.replace("key", "timestamp_ns") + "5,0,0,0,1,0,0,0\n", "the frames have none"),
    ("trajectory.log", "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n", r"log:1: must be three numbers, and four lines"),
    ("trajectory.log", "0 0 1\n1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n", "line 1: is not a rotation and a place"),
    ("trajectory.log", "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 nan\n0 0 0 1\n", "line 1: is not a rotation"),
    ("camera_trajectory.json", '{"parameters": [{"extrinsic": [1, 2]}]}', "not a trajectory"),
    ("camera_trajectory.json", json.dumps({"parameters": [{"extrinsic": list(range(16))}]}), "pose 0: is not a rotat"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "text", "says"), ODD)
def test_odd_poses_are_refused(tmp_path: Path, name: str, text: str, says: str):
    write_rgbd(tmp_path, wall(2))
    put(tmp_path / name, text)
    with pytest.raises(RecordingError, match=says):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("times", "says"),
    [
        ((5 * 10**9, 4 * 10**9), ":3: its time is before that of line 2: two clocks, or two runs"),
        ((1.5, 2), ":2: '1.5' must be a time in whole nanoseconds"),
        ((10**19, 2), ":2: the time 10000000000000000000 ns is beyond"),
        ((0, 30), "are 30 ns apart"),
    ],
)
def test_odd_times_of_poses_are_refused(tmp_path: Path, times: tuple[float, float], says: str):
    write_rgbd(tmp_path, wall(2))
    put(tmp_path / "timestamps.csv", f"key,timestamp_ns\n000000,{START_NS}\n000001,{START_NS + 100 * MS}\n")
    text = HEADER.replace("key", "timestamp_ns") + "".join(f"{time},0,0,0,1,0,0,0\n" for time in times)
    put(tmp_path / "poses.csv", text)
    with pytest.raises(RecordingError, match=says):
        open_recording(tmp_path)


@pytest.mark.parametrize("name", ["poses.csv", "trajectory.log", "camera_trajectory.json"])
def test_files_of_a_gigabyte_are_not_read(tmp_path: Path, name: str):
    write_rgbd(tmp_path, wall(1))
    with (tmp_path / name).open("wb") as file:
        file.truncate(10**9)
    with pytest.raises(RecordingError, match=f"{name}: .*larger than 64 MiB"):
        open_recording(tmp_path)


def test_a_trajectory_of_other_frames_is_not_used_and_told(tmp_path: Path):
    write_rgbd(tmp_path, wall(2))
    put(tmp_path / "trajectory.log", LOG)
    recording = open_recording(tmp_path)
    assert recording.pose(0) is None and survey_poses(recording) is None
    assert recording.notes == (
        "trajectory.log has 3 poses for 2 frames, so it is not used; poses.csv says which pose belongs to which frame.",
    )


def test_files_of_other_programs_with_the_name_of_a_trajectory_are_told(tmp_path: Path):
    write_rgbd(tmp_path, advancing())
    put(tmp_path / "odometry.log", "[INFO] the odometry has started\n")
    put(tmp_path / "trajectory.json", '{"points": []}')
    assert open_recording(tmp_path).pose_source is None
    put(tmp_path / "camera_trajectory.json", trajectory())
    recording = open_recording(tmp_path)
    assert recording.pose_source == "camera_trajectory.json"
    assert recording.notes == ("odometry.log is not a trajectory of Open3D, so it is not used.",)


def test_gaps_jumps_other_clocks_and_other_units_are_told(tmp_path: Path):
    write_rgbd(tmp_path, wall(12))
    times = [f"{n:06d},{START_NS + n * 100 * MS}\n" for n in range(12)]
    put(tmp_path / "timestamps.csv", "key,timestamp_ns\n" + "".join(times))
    x = [0.01 * n + (2 if n > 6 else 0) for n in range(12)]
    rows = [f"{n:06d},{x[n]},0,0,{1 if n < 9 else 0},0,0,{0 if n < 9 else 1}\n" for n in range(12) if n != 3]
    put(tmp_path / "poses.csv", HEADER + "".join(rows))
    report = survey_poses(open_recording(tmp_path))
    assert report is not None
    assert (report.posed, report.gaps) == (11, ("1 frame without a pose: 000003",))
    assert report.jumps == (
        "a jump by 2.01 m between the frames 000006 and 000007",
        "a jump by 180 degrees between the frames 000008 and 000009",
    )
    put(tmp_path / "poses.csv", HEADER + "".join(f"{n:06d},{100 * n},0,0,1,0,0,0\n" for n in range(12)))
    report = survey_poses(open_recording(tmp_path))
    assert report is not None and report.jumps == ("the camera moves at 1,000 m/s: are the places in metres?",)
    by_time = "".join(f"{n * 100 * MS},0,0,0,1,0,0,0\n" for n in range(12))
    put(tmp_path / "poses.csv", HEADER.replace("key", "timestamp_ns") + by_time)
    report = survey_poses(open_recording(tmp_path))
    assert report is not None and (report.posed, report.way_m) == (0, 0)
    assert report.gaps == (
        "poses.csv has a pose for no frame: are its times of the frames' clock, and is its sensor calibrated?",
    )


def tum_wall(folder: Path, lines: str) -> Recording:
    write_tum(
        folder, [0, 50, 100], [0, 50, 100], lambda _: np.full((48, 64, 3), 90, np.uint8),
        lambda n: np.full((48, 64), 10_000 - 1250 * n, np.uint16),
    )  # fmt: skip
    (folder / "groundtruth.txt").write_text(lines)
    (folder / "camera_intrinsic.json").write_text(
        json.dumps({"width": 64, "height": 48, "intrinsic_matrix": [50, 0, 0, 0, 50, 0, 31.5, 23.5, 1]})
    )
    return open_recording(folder)


def test_a_wall_before_tums_camera_stands_still(tmp_path: Path):
    """At 2 m, 1.75 m and 1.5 m, with rows that are not at the images' times; it looks along x, as above."""
    rows = [f"{1305031101.99 + n * 0.04:.2f} {9.95 + n * 0.2:.2f} 20 1.5 -0.5 0.5 -0.5 0.5\n" for n in range(5)]
    recording = tum_wall(tmp_path / "other", "".join(rows))
    require_said(recording)
    for i in range(3):
        same(place(recording.pose(i), 0, 0, 2 - 0.25 * i), 12, 20, 1.5, atol=1e-6)
        assert recording.frame(i).up is None
    # of TUM's own worlds z is known to be up
    same(tum_wall(tmp_path / "freiburg", "".join(rows)).frame(0).up, 0, -1, 0, atol=1e-9)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (f"5 {POSE}\n4 {POSE}\n5 0 0 0 0 0 0 1\n", r"groundtruth\.txt:3: its time is that of another pose in line 1"),
        ("5 0 0 0 0 0 1\n", ":1: must be a time, a place and a unit quaternion"),
        ("5 nan 0 0 0 0 0 1\n", ":1: must be a place and a quaternion, of finite"),
    ],
)
def test_odd_ground_truth_is_refused(tmp_path: Path, lines: str, says: str):
    with pytest.raises(RecordingError, match=says):
        tum_wall(tmp_path / "take", lines)
    in_any_order = f"1305031103 {POSE}\n" + f"1305031102 {POSE}\n" * 2
    same(place(tum_wall(tmp_path / "twice", in_any_order).pose(0), 0, 0, 0), 1.3563, 0.6305, 1.6380)


def test_record3d_has_opengls_axes_and_a_world_with_y_up(tmp_path: Path):
    """The phone looks along ARKit's -z; it stands at (1, 2, 3), then 0.5 m nearer to the wall."""
    poses = [[0, 0, 0, 1, 1, 2, 3.0], [0, 0, 0, 1, 1, 2, 2.5]]
    # turned a little, since poses that begin with no turn are relative to the first image
    turn = Rotation.from_euler("y", 90, degrees=True).as_quat().tolist()
    images = [(each[0], np.full((60, 80), 2 - 0.5 * n, np.float32), None) for n, each in enumerate(phone.frames(2))]
    recording = open_recording(phone.write_record3d(tmp_path / "a", images, poses=poses))
    require_said(recording)
    # its x stays, its up is z: ahead is y
    same(place(recording.pose(0), 0, 0, 2), 1, -3 + 2, 2)
    same(place(recording.pose(1), 0, 0, 1.5), 1, -1, 2)
    same(place(recording.pose(0), 0, -1, 0), 1, -3, 3)
    assert recording.frame(0).up is None
    turned = open_recording(phone.write_record3d(tmp_path / "b", images, poses=[[*turn, 1, 2, 3]] * 2))
    # a quarter to the left: along ARKit's -x
    same(place(turned.pose(0), 0, 0, 2), -1, -3, 2)
    same(turned.frame(0).up, 0, -1, 0)  # type: ignore[arg-type]


@pytest.mark.parametrize("rolled", [0.0, 90.0, 180.0, -90.0])
def test_stray_scanners_poses_are_those_of_the_images_as_they_are_shown(tmp_path: Path, rolled: float):
    recording = open_recording(phone.write_stray_scanner(tmp_path / "a", phone.frames(2), rolled=rolled))
    require_said(recording)
    pose = recording.pose(0)
    same(place(pose, 0, 0, 0), 0.1, -0.3, 0.2)
    # 30 degrees to the left of ARKit's -z, 20 degrees down, however the phone is held
    ahead = [-np.sin(np.radians(30)) * np.cos(np.radians(20)), np.cos(np.radians(30)) * np.cos(np.radians(20))]
    same(place(pose, 0, 0, 1) - place(pose, 0, 0, 0), *ahead, -np.sin(np.radians(20)), atol=1e-6)
    same(place(pose, 1, 0, 0) - place(pose, 0, 0, 0), np.cos(np.radians(30)), np.sin(np.radians(30)), 0, atol=1e-6)


def oxts(lat: float, yaw: float) -> str:
    return f"{lat:.9f} 8.400000000 112.5 0.0 0.0 {yaw:.9f} " + " ".join(["0"] * 24) + "\n"


IMU = "\n".join([row("R:", np.eye(3)), row("T:", np.array([-0.81, 0.32, -0.8])), ""])
# 1e-5 degrees of latitude are 1.11319 m of a sphere with the radius 6378137 m.
NORTH_M = 1.113195


def kitti_drive(folder: Path, scans: list[np.ndarray]) -> None:
    for number, scan in enumerate(scans):
        put_image(folder / "image_02" / "data" / f"{number}.png", 1)
        put(folder / "velodyne_points" / "data" / f"{number}.bin", scan.tobytes())
    put(folder / "calib_cam_to_cam.txt", CAMERAS)
    put(folder / "calib_velo_to_cam.txt", LIDAR)
    put(folder / "calib_imu_to_velo.txt", IMU)


def nearer(metres: float) -> np.ndarray:
    """The scan of a car that has driven ahead, with a point on the wall first."""
    rows = np.r_[[[15.0, 1.0, 0.5, 0.1]], SCAN[SCAN[:, 0] > 6]].astype(np.float32)
    return (rows - np.array([metres, 0, 0, 0])).astype(np.float32)


def test_a_wall_before_a_car_with_gps_stands_still(tmp_path: Path):
    """It drives to the north (yaw: a quarter), by 1.113 m, then 2.226 m."""
    kitti_drive(tmp_path, [nearer(NORTH_M * n) for n in range(3)])
    for n in range(2):
        put(tmp_path / "oxts" / "data" / f"{n}.txt", oxts(49 + n * 1e-5, np.pi / 2))
    recording = open_recording(tmp_path)
    assert recording.pose_source == "oxts/data" and recording.pose(2) is None
    assert [recording.frame(i).T_world_camera is None for i in range(3)] == [False, False, True]
    one, other = recording.pose(0), recording.pose(1)
    same(place(other, 0, 0, 0) - place(one, 0, 0, 0), 0, NORTH_M, 0, atol=1e-4)
    # Mercator: cos(49 degrees) of the equator's 146,609.5 m a degree of longitude; the IMU is 0.8 m above the LiDAR
    R_scan = recording.scan(0).T_world_scan  # type: ignore[attr-defined]
    imu = R_scan.apply([-0.81, 0.32, -0.8])
    same(imu[[0, 2]], np.cos(np.radians(49)) * 6378137 * np.radians(8.4), 112.5, atol=1e-3)
    walls = [recording.scan(i).T_world_scan.apply(recording.scan(i).read().xyz_m[0]) for i in range(2)]  # type: ignore[attr-defined]
    same(walls[1] - walls[0], 0, 0, 0, atol=1e-4)
    # 15 m ahead (north) and 1 m to the left (west) of the LiDAR, and 0.5 m above it
    same(walls[0] - imu, -1 + 0.32, 15 + 0.81, 0.5 + 0.8, atol=1e-4)
    around = open_recording(tmp_path, ReaderOptions(look_around=4, camera="around-090"))
    np.testing.assert_allclose(around.pose(0).as_matrix(), around.frame(0).T_world_camera.as_matrix())  # type: ignore[union-attr]
    same(place(around.pose(0), 0, 0, 1) - place(around.pose(0), 0, 0, 0), -1, 0, 0, atol=0.05)
    put(tmp_path / "calib_imu_to_velo.txt", "damaged")
    damaged = open_recording(tmp_path)
    assert len(damaged.frame(0).cloud) and damaged.pose(0) is None, "it only concerns the poses"
    put(tmp_path / "oxts" / "data" / "0.txt", "49 8.4 x")
    with pytest.raises(RecordingError, match=r"0\.txt: line 1: 'x' is"):
        open_recording(tmp_path)


@pytest.mark.parametrize("form", ["odometry", "beside", "clouds", "tracking"])
def test_the_poses_of_kittis_odometry_are_those_of_camera_0(tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch):
    """Camera 0 drives along its z; in a world with z up, that is x."""
    folder = tmp_path / "sequences" / "07"
    calib = TRACKING_CALIB if form == "tracking" else OBJECT_CALIB.replace("Tr_velo_to_cam:", "Tr:")
    calib = calib if form == "tracking" else "".join(line + "\n" for line in calib.splitlines() if "R0" not in line)
    for n in range(3):
        if form != "clouds":
            put_image(folder / ("image_02" if form == "tracking" else "image_2") / f"{n:06d}.png", 1)
        put(folder / "velodyne" / f"{n:06d}.bin", SCAN.tobytes())
    put(folder / "calib.txt", calib)
    put(folder / "times.txt", "0.0\n1.036e-01\n2.07e-01\n")
    place_of = tmp_path / "poses" / "07.txt" if form == "beside" else folder / "poses.txt"
    put(place_of, "".join(f"1 0 0 0 0 1 0 0 0 0 1 {n * 1.25}\n" for n in range(3)))
    recording = open_recording(folder)
    require_said(recording)
    if form != "clouds":
        assert recording.frame(1).timestamp_ns == 103_600_000
    # P2's shift: K^-1 (4.5, 0.2, 0.003) leads from camera 0 to camera 2
    shift = np.array([(4.5 - 61 * 0.003) / 70, (0.2 - 17 * 0.003) / 72, 0.003])
    for n in range(3):
        same(place(recording.pose(n), *shift), 1.25 * n, 0, 0, atol=1e-9)
        same(place(recording.pose(n), *shift[:2], shift[2] + 7), 1.25 * n + 7, 0, 0, atol=1e-9)
    put(place_of, "1 0 0 0 0 1 0 0 0 0 1\n")
    with pytest.raises(RecordingError, match=r":1: must be a 3 x 4 matrix, 12 numbers, not 11"):
        open_recording(folder)
    if form == "beside":
        # a folder that is mounted at the root has nothing beside its parent
        monkeypatch.setattr(Path, "resolve", lambda *_: Path("/kitti"))
        assert open_recording(folder).pose_source is None


@pytest.mark.parametrize("with_image", [False, True])
def test_the_plain_poses_of_a_lidar_are_those_of_its_clouds(tmp_path: Path, with_image: bool):
    put(tmp_path / "velodyne" / "0.bin", nearer(0).tobytes())
    put(tmp_path / "velodyne" / "1.bin", nearer(2).tobytes())
    put(tmp_path / "poses.csv", f"{HEADER}0,5,6,7,{HALF},0,0,{HALF}\n1,5,8,7,{HALF},0,0,{HALF}\n")
    if with_image:
        for n in range(2):
            put_image(tmp_path / "image_02" / f"{n}.png", 1)
        put(tmp_path / "calib.txt", TRACKING_CALIB)
    recording = open_recording(tmp_path)
    assert recording.format == ("kitti_tracking" if with_image else "cloud_folder")
    require_said(recording)
    for i in range(2):
        scan = recording.scan(i)  # type: ignore[attr-defined]
        # turned by a quarter to the left: ahead is y
        same(scan.T_world_scan.apply(scan.read().xyz_m[0]), 5 - 1, 6 + 15, 7.5, atol=1e-5)
    (tmp_path / "velodyne" / "1.bin").write_bytes(b"damaged")
    same(place(recording.pose(1), 0, 0, 1) - place(recording.pose(1), 0, 0, 0), 0, 1, 0, atol=0.05)  # reads no cloud


def test_clouds_in_a_map_need_no_poses(tmp_path: Path):
    rows = SCAN[:, :3].astype(np.float64) + np.array([500_000, 5_400_000, 100])
    np.save(tmp_path / "0.npy", rows)
    recording = open_recording(tmp_path)
    require_said(recording)
    require_said(open_recording(tmp_path, ReaderOptions(look_around=4, camera="around-090")))
    assert recording.pose_source is None and survey_poses(recording) is None


@pytest.mark.parametrize("build", [lambda path: small(path, 1, 2, 2), write_log], ids=["nuscenes", "argoverse2"])
def test_the_cameras_of_a_moment_agree_where_it_was(tmp_path: Path, build: Callable[[Path], object]):
    build(tmp_path)
    first = open_recording(tmp_path)
    where: dict[str, list[np.ndarray]] = {}
    for camera in first.cameras:  # type: ignore[attr-defined]
        recording = open_recording(tmp_path, ReaderOptions(camera=camera))
        require_said(recording)
        for i in range(len(recording)):
            T = recording.pose(i) * recording.T_rig_camera(i).inv()  # type: ignore[attr-defined, operator]
            where.setdefault(recording.moment(i), []).append(T.as_matrix())  # type: ignore[attr-defined]
    assert any(len(each) > 1 for each in where.values())
    for each in where.values():
        np.testing.assert_allclose(each, [each[0]] * len(each), atol=1e-9)
    for around in range(2):
        require_said(
            open_recording(tmp_path, ReaderOptions(look_around=4, camera=("around-000", "around-090")[around]))
        )


def test_a_vehicle_of_nuscenes_may_stand_at_the_origin_of_its_map(tmp_path: Path):
    (tables,) = small(tmp_path, 1, 2, 2).glob("v1.0-*")
    poses = json.loads((tables / "ego_pose.json").read_text())
    start = np.array(open_recording(tmp_path).moments[0][0].ego.translation)  # type: ignore[attr-defined]
    put(tables / "ego_pose.json", json.dumps([p | {"translation": (p["translation"] - start).tolist()} for p in poses]))
    recording = open_recording(tmp_path)
    report = survey_poses(recording)
    assert report is not None and report.gaps == ()
    require_said(recording)


T_RIG_CAMERA = RigidTransform.from_components([0.5, 0, 1], Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


def rig_pose(time_ns: int) -> RigidTransform:
    """It drives to the north (y of the map) by 2 m/s, from (100, 200, 3)."""
    return RigidTransform.from_components(
        [100, 200 + 2 * (time_ns - START_NS) / 1e9, 3], Rotation.from_rotvec([0, 0, np.pi / 2])
    )


def stamped(T: RigidTransform) -> dict[str, object]:
    turn = dict(zip("xyzw", T.rotation.as_quat().tolist(), strict=True))
    return {"position": dict(zip("xyz", T.translation.tolist(), strict=True)), "orientation": turn}


def write_poses(bag: BagWriter, how: str) -> None:
    times = [START_NS + ms * MS for ms in range(0, 501, 50)]
    if how == "nav_msgs/Path":
        poses = [{"header": bag.header(time, "map"), "pose": stamped(rig_pose(time))} for time in times]
        bag.write("/path", times[-1], how, header=bag.header(times[-1], "map"), poses=poses)
    for time in times if how != "nav_msgs/Path" else ():
        head = bag.header(time, "map")
        if how.startswith("tf"):
            # map does not move against odom, and odom is a parent of the rig
            bag.transform(
                "/tf",
                time,
                how[3:],
                "odom" if how == "tf map" else "rig",
                RigidTransform.identity() if how == "tf map" else rig_pose(time),
            )
            if how == "tf map":
                bag.transform("/tf", time, "odom", "rig", rig_pose(time))
        elif how == "nav_msgs/Odometry":
            bag.write("/odom", time, how, header=head, child_frame_id="rig", pose={"pose": stamped(rig_pose(time))})
        elif how == "geometry_msgs/PoseStamped":
            bag.write("/pose", time, how, header=head, pose=stamped(rig_pose(time)))
        else:
            bag.write("/pose", time, how, header=head, pose={"pose": stamped(rig_pose(time))})


SOURCES = {
    "tf map": "tf (map)", "tf odom": "tf (odom)", "tf world": "tf (world)", "nav_msgs/Odometry": "/odom",
    "geometry_msgs/PoseStamped": "/pose", "geometry_msgs/PoseWithCovarianceStamped": "/pose", "nav_msgs/Path": "/path",
}  # fmt: skip


@pytest.mark.parametrize("how", SOURCES)
@pytest.mark.parametrize("with_images", [True, False])
def test_a_bag_says_where_its_rig_was(tmp_path: Path, how: str, with_images: bool):
    with BagWriter(tmp_path, "mcap") as bag:
        bag.transform("/tf_static", START_NS, "rig", "camera", T_RIG_CAMERA)
        bag.transform("/tf_static", START_NS, "rig", "lidar", RigidTransform.from_translation([0, 0, 2]))
        write_poses(bag, how)
        for i in range(2):
            write_scan(bag, START_NS + (110 + i * 100) * MS)
            if with_images:
                write_camera(bag, "cam", START_NS + (110 + i * 100) * MS)
    recording = open_recording(bag.path)
    require_said(recording)
    assert recording.pose_source == SOURCES[how]
    told = any("do not say whose they are, taken as those of rig" in note for note in recording.notes)
    assert told == (how.startswith("geometry") or how == "nav_msgs/Path")
    for i in range(2):
        north = 200 + 2 * (0.11 + 0.1 * i)
        # the camera is 0.5 m ahead (north) and 1 m above the rig, and looks ahead; the LiDAR is 2 m above it
        expected = (100, north + 0.5 + 4, 4) if with_images else (100, north + 4, 5)
        same(place(recording.pose(i), 0, 0, 4), *expected, atol=1e-6)
        scan = recording.scan(i)  # type: ignore[attr-defined]
        same(scan.T_world_scan.apply([1.0, 0, 0]), 100, north + 1, 5, atol=1e-6)


def test_the_poses_of_a_frame_that_tf_does_not_know_are_not_used(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        write_mount(bag)
        write_scan(bag, START_NS)
        write_camera(bag, "cam", START_NS)
        write_poses(bag, "nav_msgs/Odometry")
    recording = open_recording(bag.path)
    assert recording.pose_source is None and recording.frame(0).T_world_camera is None
    assert "the poses of /odom are those of rig, and tf does not say how camera is mounted on it" in recording.notes


def test_damaged_poses_of_a_bag_are_left_out(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        bag.info("/cam/camera_info", START_NS, SIZE, K)
        for i in range(3):
            time = START_NS + i * 100 * MS
            bag.image("/cam/image_raw", time, IMAGE, "rgb8")
            bag.image("/cam/depth/image_raw", time, np.full(SIZE[::-1], 2000 - 500 * i, np.uint16), "16UC1")
            bag.info("/cam/depth/camera_info", time, SIZE, K)
            T = RigidTransform.from_translation([0, 0, 0.5 * i])
            pose = stamped(T) if i != 1 else stamped(T) | {"orientation": dict.fromkeys("xyzw", 0.0)}
            bag.write("/pose", time, "geometry_msgs/PoseStamped", header=bag.header(time, "map"), pose=pose)
    recording = open_recording(bag.path)
    # without tf, the sensor's own; the rows on both sides of the damaged one are 200 ms apart
    assert "poses: /pose, which do not say whose they are, taken as those of camera" in recording.notes
    for i in range(3):
        same(place(recording.pose(i), 0, 0, 2 - 0.5 * i), 0, 0, 2, atol=1e-9)
    require_said(recording)
