"""Bags as recordings: topics, pairs, transforms, gravity; and RealSense's own recording."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from bag_writer import (
    IMAGE,
    MS,
    POINTS_M,
    SIZE,
    START_NS,
    T_CAMERA_LIDAR,
    BagWriter,
    K,
    seen_points,
    structured,
    write_camera,
    write_mount,
    write_scan,
    write_take,
)
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.cli.main import main
from annotator.cli.options import ReadAs
from annotator.recordings import ReaderOptions, detect_format, open_recording
from annotator.recordings.mirror import open_mirror
from annotator.recordings.ros.recording import RosBag, message
from annotator.types.errors import ConfigError, FrameError, InputError, RecordingError

COMPRESSIONS = [("ros1", "lz4"), ("ros1", "bz2"), ("sqlite3", ""), ("sqlite3", "message"), ("mcap", "storage"),
                ("mcap", "message")]  # fmt: skip


@pytest.mark.parametrize(("container", "compression"), COMPRESSIONS)
def test_a_take_is_read_in_every_container(tmp_path: Path, container: str, compression: str):
    with BagWriter(tmp_path, container, compression) as bag:
        write_take(bag)
    assert detect_format(bag.path) == "ros_bag"
    recording = open_recording(bag.path)
    assert (recording.keys, recording.notes) == (("000000", "000001", "000002"), ())
    frame = recording.frame(1)
    np.testing.assert_array_equal(frame.rgb, IMAGE)
    np.testing.assert_allclose(frame.cloud.xyz_m, seen_points(), atol=1e-6)
    assert frame.timestamp_ns == START_NS + 104 * MS
    # a single file of a folder is the same recording
    if container != "ros1" and compression != "message":
        single = next(file for file in bag.path.iterdir() if file.suffix in (".db3", ".mcap"))
        assert open_recording(single).keys == recording.keys
    with pytest.raises(IndexError):
        recording.frame(3)


def test_inspect_lists_the_topics_that_matter_and_counts_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with BagWriter(tmp_path, "mcap") as bag:
        write_take(bag)
        bag.image("/a_left/image_raw", START_NS, IMAGE[:, :, :1], "mono8")
        for number in range(40):
            bag.write(f"/option_{number}", START_NS, "std_msgs/Float32", data=1.0)
    assert main(["inspect", str(bag.path)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("topic")]
    assert [line.rpartition(": ")[2] for line in lines[:-1]] == ["camera", "image", "points", "transforms", "--image"]
    assert lines[-1].endswith("40 others not used (--json lists all): 40 of std_msgs/Float32")
    assert main(["inspect", str(bag.path), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["topics"]) == 45


def timed(folder: Path, *rows: tuple[int | None, int, int | None, int]) -> RosBag:
    """Opens a bag of scans and images with these times, ms: of a scan's header and log, and of an image's."""
    folder.mkdir()

    def ns(ms: int | None) -> int:
        return 0 if ms is None else START_NS + ms * MS

    with BagWriter(folder, "mcap") as bag:
        write_mount(bag)
        for scan, scan_log, image, image_log in rows:
            write_scan(bag, ns(scan), log_ns=ns(scan_log))
            write_camera(bag, "cam", ns(image), log_ns=ns(image_log))
    recording = open_recording(bag.path)
    assert isinstance(recording, RosBag)
    return recording


def test_header_times_are_used_unless_the_clocks_differ(tmp_path: Path):
    """Messages that are logged late have their partners by header; a LiDAR with a clock of its own, by log time."""
    recording = timed(tmp_path / "late", *((100 * i, 100 * i + 80, 100 * i, 100 * i + 10) for i in range(3)))
    assert (recording.times_ns, recording.notes) == (tuple(START_NS + 100 * MS * i for i in range(3)), ())
    recording = timed(tmp_path / "own", *((100 * i - 5000, 100 * i + 8, 100 * i, 100 * i + 10) for i in range(3)))
    assert "are from clocks 5.0 s apart; log times are used" in recording.notes[0]
    assert recording.times_ns == tuple(START_NS + (100 * i + 10) * MS for i in range(3))


def test_times_that_are_not_set_or_run_backward_are_told(tmp_path: Path):
    recording = timed(tmp_path / "back", (0, 0, 0, 0), (200, 100, 200, 100), (100, 200, 100, 200))
    assert recording.keys == ("000000", "000002", "000001")
    assert "the times of /points run backward in 1 place; its messages are sorted" in recording.notes
    recording = timed(tmp_path / "unset", (None, 0, None, 1))
    assert recording.times_ns == (START_NS + MS,)
    assert "1 message of /cam/image_raw without a time in the header; log times are used" in recording.notes
    times = ((100 * i, 100 * i + 80, None if i == 2 else 100 * i, 100 * i + 10) for i in range(4))
    recording = timed(tmp_path / "one", *times)
    assert recording.times_ns == tuple(START_NS + i * 100 * MS for i in range(4))
    told = "1 message of /cam/image_raw without a readable time, which is taken from the log times"
    assert recording.notes == (told,)


def two_cameras(folder: Path) -> Path:
    with BagWriter(folder, "sqlite3") as bag:
        write_mount(bag)
        write_scan(bag, START_NS)
        write_scan(bag, START_NS, topic="/points_rear")
        for name in ("left", "right"):
            write_camera(bag, name, START_NS)
    return bag.path


def test_an_ambiguous_choice_names_the_options(tmp_path: Path):
    path = two_cameras(tmp_path)
    with pytest.raises(RecordingError, match=r"--image: /left/image_raw \(1 message\), /right/image_raw"):
        open_recording(path)
    with pytest.raises(RecordingError, match=r"--points: /points \(1 message\), /points_rear"):
        open_recording(path, ReaderOptions(image="/left/image_raw"))
    assert len(open_recording(path, ReaderOptions(image="/left/image_raw", points="points"))) == 1


WRONG_OPTIONS = [
    ({"image": "/nowhere"}, "--image /nowhere: is not in the bag; possible are: /left/image_raw, /right/image_raw"),
    ({"image": "/points"}, "--image /points: is a sensor_msgs/PointCloud2"),
    ({"image": "/left/image_raw", "points": "/points", "origin": (1, 2, 3)}, "so --origin is not taken"),
]


@pytest.mark.parametrize(("options", "problem"), WRONG_OPTIONS)
def test_options_that_do_not_fit_the_bag_are_errors(tmp_path: Path, options: dict[str, object], problem: str):
    with pytest.raises(ConfigError, match=problem):
        open_recording(two_cameras(tmp_path), ReaderOptions.model_validate(options))


def test_the_raw_image_is_preferred_to_its_compressed_form_and_colour_to_infrared(tmp_path: Path):
    with BagWriter(tmp_path, "ros1") as bag:
        write_take(bag, 1)
        bag.compressed("/cam/image_raw/compressed", START_NS, "jpeg", b"\xff\xd8 not read")
        bag.image("/infra1/image_rect_raw", START_NS, IMAGE[:, :, :1], "mono8")
    np.testing.assert_array_equal(open_recording(bag.path).frame(0).rgb, IMAGE)


def test_partners_are_counted(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        write_mount(bag)
        for i in range(6):
            write_camera(bag, "cam", START_NS + i * 33 * MS)
        for time in (30, 130, 900):
            write_scan(bag, START_NS + time * MS)
    recording = open_recording(bag.path)
    # the images at 33 and 132 ms
    assert recording.keys == ("000001", "000004")
    assert recording.notes == (
        "4 of 6 images of /cam/image_raw without a partner in /points within 0.05 s",
        "1 of 3 messages of /points without an image of its own",
    )
    assert open_recording(bag.path, ReaderOptions(tolerance_s=0.0025)).keys == ("000004",)
    with pytest.raises(RecordingError, match=r"the nearest pair is 0\.002 s apart; give --tolerance"):
        open_recording(bag.path, ReaderOptions(tolerance_s=0.001))


MISSING = [
    ({}, "the transform from lidar to camera is missing: the bag has no tf"),
    ({"camera": "rig"}, r"lidar hangs from lidar, camera from rig, .* \(tf has camera, rig\)"),
    ({"camera": "rig", "lidar": "roof"}, "lidar hangs from roof, camera from rig, and no link joins these two"),
]


@pytest.mark.parametrize(("parents", "problem"), MISSING)
def test_a_missing_link_is_named(tmp_path: Path, parents: dict[str, str], problem: str):
    with BagWriter(tmp_path, "ros1") as bag:
        write_scan(bag, START_NS)
        write_camera(bag, "cam", START_NS)
        for child, parent in parents.items():
            bag.transform("/tf_static", START_NS, parent, child, T_CAMERA_LIDAR)
    with pytest.raises(FrameError, match=problem):
        open_recording(bag.path).frame(0)


def test_an_invalid_link_is_named(tmp_path: Path):
    with BagWriter(tmp_path, "ros1") as bag:
        write_scan(bag, START_NS)
        write_camera(bag, "cam", START_NS)
        link = {"header": bag.header(START_NS, "lidar"), "child_frame_id": "camera"}
        bag.write("/tf_static", START_NS, "tf2_msgs/TFMessage", transforms=[link])
    with pytest.raises(FrameError, match=r"transform from camera to lidar is invalid \(a quaternion of length 0"):
        open_recording(bag.path).frame(0)


def test_the_camera_frame_can_be_named(tmp_path: Path):
    with BagWriter(tmp_path, "sqlite3") as bag:
        write_scan(bag, START_NS)
        write_camera(bag, "cam", START_NS, frame="nonsense")
        write_mount(bag)
    with pytest.raises(FrameError, match="nonsense from nonsense, and no link"):
        open_recording(bag.path).frame(0)
    frame = open_recording(bag.path, ReaderOptions(tf_frame="camera")).frame(0)
    np.testing.assert_allclose(frame.cloud.xyz_m, seen_points(), atol=1e-6)


def pose(time_ns: int) -> RigidTransform:
    """The rig's pose in odom: it drives and turns evenly."""
    seconds = (time_ns - START_NS) / 1e9
    return RigidTransform.from_components([3 * seconds, seconds, 0], Rotation.from_rotvec([0, 0, 0.8 * seconds]))


def test_a_cloud_is_moved_to_the_time_of_the_image(tmp_path: Path):
    scan_ns, image_ns = START_NS + 500 * MS, START_NS + 537 * MS
    T_rig_camera = RigidTransform.from_components(
        [0.5, 0, 1], Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    )
    T_rig_lidar = RigidTransform.from_translation([0, 0, 2])
    with BagWriter(tmp_path, "mcap") as bag:
        bag.transform("/tf_static", START_NS, "rig", "camera", T_rig_camera)
        bag.transform("/tf_static", START_NS, "rig", "lidar", T_rig_lidar)
        for ms in range(0, 1001, 20):
            bag.transform("/tf", START_NS + ms * MS, "odom", "rig", pose(START_NS + ms * MS))
        write_scan(bag, scan_ns)
        write_camera(bag, "cam", image_ns)
    recording = open_recording(bag.path)
    assert recording.notes == (
        "clouds are moved to the images' times by the motion of the rig in odom where tf knows it "
        "(not with --no-motion)",
    )
    assert open_recording(bag.path, ReaderOptions(tf_frame="/camera")).notes == recording.notes
    T = (pose(image_ns) * T_rig_camera).inv() * pose(scan_ns) * T_rig_lidar
    expected = T.apply(POINTS_M.astype(np.float64))
    found = recording.frame(0).cloud.xyz_m
    assert len(found) > 20
    # the path between two poses is an arc, and interpolated as a line
    assert most_apart(found, expected) < 1e-3
    still = (T_rig_camera.inv() * T_rig_lidar).apply(POINTS_M.astype(np.float64))
    assert most_apart(found, still) > 0.05
    unmoved = open_recording(bag.path, ReadAs(no_motion=True).options())
    assert unmoved.notes == ()
    assert most_apart(unmoved.frame(0).cloud.xyz_m, still) < 1e-5


def most_apart(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found[:, None] - expected[None], axis=2).min(axis=1).max())


def test_the_second_camera_of_a_stereo_pair_is_moved_by_the_baseline(tmp_path: Path):
    """Only where it names the tf frame of the first one, whose rectification then holds for both."""
    R = Rotation.from_rotvec([0.02, -0.01, 0.03])
    P, P_right = np.hstack([K, np.zeros((3, 1))]), np.hstack([K, [[-0.12 * 30], [0], [0]]])
    for frame in ("camera", "right"):
        folder = tmp_path / frame
        folder.mkdir()
        with BagWriter(folder, "mcap") as bag:
            write_mount(bag)
            bag.transform("/tf_static", START_NS, "camera", "right", RigidTransform.from_translation([0.12, 0, 0]))
            write_scan(bag, START_NS)
            bag.info("/left/camera_info", START_NS, SIZE, K, R=R.as_matrix(), P=P)
            bag.info("/right/camera_info", START_NS, SIZE, K, P=P_right, frame=frame)
            for name, owner in (("left", "camera"), ("right", frame)):
                bag.image(f"/{name}/image_rect", START_NS, IMAGE, "rgb8", owner)
        left, right = (
            open_recording(bag.path, ReaderOptions(image=f"/{name}/image_rect")).frame(0).cloud
            for name in ("left", "right")
        )
        turned = R.apply(T_CAMERA_LIDAR.apply(POINTS_M.astype(np.float64)))
        expected = (turned if frame == "camera" else R.inv().apply(turned)) - [0.12, 0, 0]
        assert min(len(left), len(right)) > 20
        for cloud, points in ((left, turned), (right, expected)):
            assert most_apart(cloud.xyz_m, points) < 1e-5


def test_a_bag_with_clouds_is_seen_all_around(tmp_path: Path):
    """The LiDAR is tilted, which the IMU on it tells, and the camera looks to its right."""
    tilt = Rotation.from_rotvec([0.1, 0.2, 0.0])
    T_lidar_camera = RigidTransform.from_rotation(Rotation.from_matrix([[-1, 0, 0], [0, 0, -1], [0, -1, 0]]))
    with BagWriter(tmp_path, "mcap") as bag:
        bag.transform("/tf_static", START_NS, "lidar", "camera", T_lidar_camera)
        write_scan(bag, START_NS)
        write_camera(bag, "cam", START_NS)
    without_imu = open_recording(bag.path, ReaderOptions(look_around=4)).frame(0)
    assert without_imu.up is None and len(without_imu.cloud) == 200
    # ahead is to the right of the LiDAR
    np.testing.assert_allclose(without_imu.cloud.xyz_m, POINTS_M[:, [0, 2, 1]] * [-1, -1, -1], atol=1e-6)
    with BagWriter(tmp_path, "mcap") as bag:
        bag.transform("/tf_static", START_NS, "lidar", "camera", T_lidar_camera)
        bag.imu("/imu", START_NS, tuple((9.81 * tilt.inv().apply([0.0, 0.0, 1.0])).tolist()), "lidar")
        write_scan(bag, START_NS)
        write_camera(bag, "cam", START_NS)
    frame = open_recording(bag.path, ReaderOptions(look_around=4, camera="around-090")).frame(0)
    np.testing.assert_allclose(frame.up, [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(-frame.cloud.xyz_m[:, 1], tilt.apply(POINTS_M.astype(np.float64))[:, 2], atol=1e-5)


def test_a_link_that_is_known_only_at_another_time_is_an_error(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        write_mount(bag, "/tf")
        write_scan(bag, START_NS + 2000 * MS)
        write_camera(bag, "cam", START_NS + 2000 * MS)
    with pytest.raises(
        FrameError, match=r"from lidar to camera is not known at this time; the nearest is 2\.00 s away"
    ):
        open_recording(bag.path).frame(0)


def test_gravity_comes_from_an_imu_at_rest(tmp_path: Path):
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1])
    up_imu = np.array([0.2, 0.1, 9.78])
    with BagWriter(tmp_path, "ros1") as bag:
        write_take(bag)
        bag.transform("/tf_static", START_NS, "camera", "imu", RigidTransform.from_rotation(turn))
        for i in range(30):
            shake = 0.0 if i < 10 else 4.0 * (-1) ** i
            bag.imu("/imu", START_NS + i * 100 * MS, (up_imu[0] + shake, up_imu[1], up_imu[2]))
    expected = turn.apply(up_imu / np.linalg.norm(up_imu))
    np.testing.assert_allclose(open_recording(bag.path).frame(1).up, expected, atol=1e-9)
    (tmp_path / "moving").mkdir()
    with BagWriter(tmp_path / "moving", "ros1") as bag:
        write_take(bag)
        for i in range(10):
            bag.imu("/imu", START_NS + i * 20 * MS, (4.0 * (-1) ** i, 0.0, 9.8), "camera")
    assert open_recording(bag.path).frame(1).up is None


def test_depth_of_another_camera_is_registered(tmp_path: Path):
    """A depth camera of another size, beside the colour camera."""
    T_color_depth = RigidTransform.from_translation([0.05, 0, 0])
    depth = np.full((12, 16), 2000, np.uint16)
    small = np.array([[15.0, 0, 7.5], [0, 15.0, 5.5], [0, 0, 1]])
    with BagWriter(tmp_path, "mcap") as bag:
        bag.transform("/tf_static", START_NS, "color_optical", "depth_optical", T_color_depth)
        write_camera(bag, "camera/color", START_NS, "color_optical")
        bag.info("/camera/depth/camera_info", START_NS, (16, 12), small, frame="depth_optical")
        bag.image("/camera/depth/image_rect_raw", START_NS, depth, "16UC1", "depth_optical")
        bag.info("/camera/depth/other_info", START_NS, (16, 12), 2 * small, frame="depth_optical")
    with pytest.raises(RecordingError, match=r"--depth-info: /camera/depth/camera_info .*, /camera/depth/other_info"):
        open_recording(bag.path)
    chosen = ReadAs(depth_info="/camera/depth/camera_info").options()
    with pytest.raises(ConfigError, match="without scans of a LiDAR, and takes no --look-around"):
        open_recording(bag.path, chosen.model_copy(update={"look_around": 4}))
    frame = open_recording(bag.path, chosen).frame(0)
    v, u = np.mgrid[:12, :16]
    expected = np.stack([(u - 7.5) / 15 * 2 + 0.05, (v - 5.5) / 15 * 2, np.full_like(u, 2.0, float)], -1).reshape(-1, 3)
    assert most_apart(frame.cloud.xyz_m, expected) < 1e-5
    assert len(frame.cloud) > 150
    assert frame.depth_m is not None and frame.depth_m.shape == IMAGE.shape[:2]


def test_a_dark_picture_of_16_bits_has_the_range_of_the_first_ones(tmp_path: Path):
    deep = np.floor(IMAGE * (4095 / 255) + 0.5).astype(np.uint16)
    with BagWriter(tmp_path, "mcap") as bag:
        write_mount(bag)
        for i, pixels in enumerate((np.full_like(deep, 15), deep)):
            write_scan(bag, START_NS + i * 100 * MS)
            bag.info("/cam/camera_info", START_NS + i * 100 * MS, SIZE, K, frame="camera")
            bag.image("/cam/image_raw", START_NS + i * 100 * MS, pixels, "rgb16", "camera")
    recording = open_recording(bag.path)
    np.testing.assert_array_equal(recording.frame(0).rgb, np.zeros_like(IMAGE))
    np.testing.assert_array_equal(recording.frame(1).rgb, IMAGE)


def test_a_broken_message_affects_only_its_frame(tmp_path: Path):
    with BagWriter(tmp_path, "sqlite3") as bag:
        write_take(bag)
        bag.image("/cam/image_raw", START_NS + 304 * MS, IMAGE, "rgb8", height=900)
        bag.cloud("/points", START_NS + 300 * MS, structured({"x": POINTS_M[:, 0]}))
    recording = open_recording(bag.path)
    with pytest.raises(FrameError, match=r"frame 000003: /cam/image_raw: .*900 pixels of rgb8 .* do not fit"):
        recording.frame(3)
    assert len(recording) == 4 and len(recording.frame(2).cloud)


def test_a_bag_in_remote_storage_is_copied_whole(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        write_take(bag)
    mirror = open_mirror(bag.path.as_uri(), tmp_path / "copies", 10**7)
    assert len(mirror.frame(2).cloud) == len(open_recording(bag.path).frame(2).cloud)


@pytest.mark.parametrize("missing", ["image", "info", "partner"])
def test_a_bag_without_a_part_says_so(tmp_path: Path, missing: str):
    with BagWriter(tmp_path, "ros1") as bag:
        bag.imu("/imu", START_NS, (0.0, 0.0, 9.8))
        if missing == "partner":
            write_camera(bag, "cam", START_NS)
        if missing == "info":
            bag.image("/cam/image_raw", START_NS, IMAGE, "rgb8")
            write_scan(bag, START_NS)
    problem = {"image": "neither images nor point clouds", "info": "no calibration of /cam/image_raw",
               "partner": "neither point clouds"}[missing]  # fmt: skip
    with pytest.raises(InputError, match=problem):
        open_recording(bag.path)


@pytest.mark.shared
def test_a_real_realsense_recording(shared: Path):
    """The numbers are those of its messages."""
    recording = open_recording(shared / "data" / "realsense" / "single_depth_color_640x480.bag")
    assert isinstance(recording, RosBag)
    assert recording.unit_m is not None and recording.chosen.depth is not None
    assert recording.keys == ("000000",)
    frame = recording.frame(0)
    matrix = [[613.2036743164062, 0, 319.9388427734375], [0, 613.4193115234375, 239.18299865722656], [0, 0, 1]]
    np.testing.assert_allclose(frame.camera.matrix, matrix, rtol=1e-12)
    image, depth = recording.chosen.image, recording.chosen.depth
    assert image is not None
    T = next(recording.tf.windows(0)).transform(image.frame, depth.frame, 0)
    np.testing.assert_allclose(T.translation, [0.01431131362915039, 0.000602306448854506, 0.000610804301686585])
    turn = [-5.319880231421298e-05, 0.0064634308469817235, 0.005154853722821664, 0.9999658465385437]
    assert (T.rotation.inv() * Rotation.from_quat(turn)).magnitude() < 1e-7
    content = message(recording.chosen.depth.topic, 0)
    units = np.frombuffer(content.data.tobytes(), "<u2").reshape(480, 640)
    # each point is a pixel of the depth image at its depth, in the colour camera
    matrix = np.array(message(recording.chosen.depth_info, 0).K).reshape(3, 3)
    back = T.inv().apply(frame.cloud.xyz_m.astype(np.float64))
    column, row = ((back[:, axis] / back[:, 2] * matrix[axis, axis] + matrix[axis, 2]) for axis in (0, 1))
    assert max(np.abs(column - np.rint(column)).max(), np.abs(row - np.rint(row)).max()) < 1e-3
    expected_m = units[np.rint(row).astype(int), np.rint(column).astype(int)] * np.float32(0.001)
    np.testing.assert_allclose(back[:, 2], expected_m, atol=1e-6)
    assert len(frame.cloud) > 100_000
    assert frame.depth_m is not None and frame.timestamp_ns == 360_713_523_000
