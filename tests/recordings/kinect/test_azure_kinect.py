"""Azure Kinects: recordings with the SDK's numbers, modes and damage; a connected one, by a stand-in for pyk4a."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import kinect_recording as made
import numpy as np
import pytest
from fake_pyk4a import Capture, Script, install
from kinect_recording import ACCELEROMETER, DEPTH_HEIGHT, DEPTH_WIDTH, calibration, depth_mm, picture
from scipy.spatial.transform import Rotation

from annotator.geometry.normals import normals_knn
from annotator.geometry.projection import project, undistort_px
from annotator.recordings import open_recording
from annotator.recordings.kinect import device as kinect_device
from annotator.recordings.kinect.calibration import COLOUR_MODES, parse_calibration, parse_samples, up_at_rest
from annotator.recordings.kinect.device import KinectDevice
from annotator.recordings.kinect.mkv_recording import AzureKinect, is_azure_kinect
from annotator.types.errors import DeviceError, FrameError, RecordingError
from annotator.workflows.live.open_source import KinectSource


@pytest.fixture(scope="module")
def recording_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three captures with MJPEG colour; do not change it."""
    return made.write_recording(tmp_path_factory.mktemp("kinect") / "take.mkv", "MJPG")


def opened(path: Path) -> AzureKinect:
    recording = open_recording(path)
    assert isinstance(recording, AzureKinect)
    return recording


@pytest.mark.parametrize("fourcc", ["MJPG", "NV12", "YUY2", "BGRA"])
def test_all_colour_formats_are_read_with_depth_and_time(tmp_path: Path, fourcc: str):
    recording = opened(made.write_recording(tmp_path / "take.mkv", fourcc))
    assert (recording.name, recording.keys, recording.is_sequence) == ("take", ("000000", "000001", "000002"), True)
    assert recording.fourcc == fourcc
    for i in (2, 0, 1):
        frame = recording.frame(i)
        off = np.abs(frame.rgb.astype(int) - made.picture(i)).max(axis=2)
        # subsampled chroma and JPEG artefacts change pixels where the quarters meet
        flat = np.ones(off.shape, bool)
        flat[made.HEIGHT // 2 - 16 : made.HEIGHT // 2 + 16] = flat[:, made.WIDTH // 2 - 16 : made.WIDTH // 2 + 16] = (
            False
        )
        assert off[flat].max() <= (0 if fourcc == "BGRA" else 4)
        np.testing.assert_array_equal(recording.depth_image(i), made.depth_mm(i))
        # the writer's clock has a resolution of 1 ms; the recording starts at 5 ms
        assert frame.timestamp_ns == pytest.approx(5_000_000 + i * 33_333_000, abs=1_000_000)


def by_opencv(camera, xyz: np.ndarray) -> np.ndarray:
    lens = np.array(camera.distortion)
    return cv2.projectPoints(xyz[:, None], np.zeros(3), np.zeros(3), camera.matrix, lens)[0][:, 0]


def test_dropped_images_leave_gaps_and_delayed_depth_is_matched_to_its_colour(tmp_path: Path):
    path = made.write_recording(tmp_path / "take.mkv", frames=5, without_depth=(1, 3), depth_delay_us=60_000)
    recording = opened(path)
    assert recording.keys == ("000000", "000002", "000004")
    np.testing.assert_array_equal(recording.depth_image(1), made.depth_mm(2))
    for i in (-1, 3):
        with pytest.raises(IndexError, match="3 frames"):
            recording.frame(i)


def test_a_frame_is_read_without_the_frames_before_it(recording_file: Path, tmp_path: Path):
    path, recording = tmp_path / "take.mkv", opened(recording_file)
    data = bytearray(recording_file.read_bytes())
    for block in (*recording.captures[0], recording.captures[1][0]):
        data[block.offset : block.offset + block.size] = bytes(block.size)
    path.write_bytes(data)
    np.testing.assert_array_equal(opened(path).frame(2).rgb, recording.frame(2).rgb)
    with pytest.raises(FrameError, match=r"take\.mkv: frame 000001: colour image: .*copy the recording again"):
        opened(path).frame(1)
    with pytest.raises(FrameError, match="frame 000000: colour image"):
        opened(path).frame(0)


@pytest.mark.parametrize("share", [0.2, 0.9])
def test_a_truncated_file_is_reported_and_its_complete_frames_are_read(
    recording_file: Path, tmp_path: Path, share: float
):
    path, whole = tmp_path / "cut.mkv", opened(recording_file)
    data = recording_file.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    complete = sum(max(block.offset + block.size for block in blocks) <= len(data) * share for blocks in whole.captures)
    try:
        recording = opened(path)
    except RecordingError as error:
        assert complete == 0
        assert str(error).startswith(f"{path}: ")
        return
    good = 0
    for i in range(len(recording)):
        try:
            np.testing.assert_array_equal(recording.frame(i).rgb, whole.frame(i).rgb)
            good += 1
        except FrameError as error:
            assert "the file ends" in str(error)
    assert good == complete
    assert len(recording) <= complete + 1


def attaching(content: bytes) -> Callable[[Path], object]:
    return lambda path: made.write_recording(path, frames=1, attached=content)


def changed(**changes: object) -> Callable[[Path], object]:
    return attaching(json.dumps(made.calibration(**changes)).encode())


REFUSED = [
    pytest.param(
        lambda p: made.write_recording(p, titles=("COLOR", "IR", "OTHER")), r"it has: COLOR, IR, OTHER", id="no-depth"
    ),
    pytest.param(lambda p: made.write_recording(p, frames=2, without_depth=(0, 1)), "no frames", id="no-captures"),
    pytest.param(changed(Intrinsics={"ModelType": "x", "ModelParameters": made.LENS}), "lens model x", id="lens"),
    pytest.param(changed(Rt={"Rotation": [0] * 9, "Translation": [0] * 3}), "rotation matrix", id="no-rotation"),
]


@pytest.mark.parametrize(("write", "complaint"), REFUSED)
def test_unusable_recordings_are_errors_with_a_cause(tmp_path: Path, write: Callable[[Path], object], complaint: str):
    path = tmp_path / "take.mkv"
    write(path)
    with pytest.raises(RecordingError, match=complaint) as caught:
        open_recording(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert ";" in str(caught.value) or "expected" in str(caught.value)


def test_a_list_of_other_files_is_no_recording(recording_file: Path):
    """FFmpeg would open the files that it names."""
    (recording_file.parent / "list.mkv").write_text(f"ffconcat version 1.0\nfile {recording_file.name}\n")
    assert not is_azure_kinect(recording_file.parent / "list.mkv")
    assert is_azure_kinect(recording_file)


def test_recordings_of_orbbecs_wrapper_are_read(tmp_path: Path):
    """As its k4arecorder writes them: two inertial sensors of another name, and a calibration padded with zeros."""
    content = made.calibration(MetricRadius=0)
    sensors = content["CalibrationInformation"]["InertialSensors"]
    turned = {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [0, 0, 0]}
    sensors[0] |= {"SensorId": "CALIBRATION_InertialSensorId_LSM6DSM", "ModelTypeMask": 16}
    sensors.insert(0, sensors[0] | {"SensorType": "CALIBRATION_InertialSensorType_Gyro", "Rt": turned})
    still = [(time_us, made.ACCELEROMETER @ [0, -9.8, 0]) for time_us in range(0, 100_000, 1000)]
    attached = json.dumps(content).encode() + bytes(300)
    path = made.write_recording(tmp_path / "take.mkv", "MJPG", attached=attached, felt=still)
    frame = opened(path).frame(1)
    np.testing.assert_allclose(frame.up, [0, -1, 0], atol=1e-3)
    assert len(frame.cloud) > 50_000


@pytest.mark.shared
def test_the_real_recording_agrees_with_the_sdk(shared: Path):
    folder = shared / "data" / "azure_kinect"
    recording = opened(folder / "recording.mkv")
    frame = recording.frame(0)
    assert (frame.key, frame.rgb.shape, recording.depth_image(0).shape) == ("000000", (720, 1280, 3), (576, 640))
    assert frame.timestamp_ns == 800_222_000
    assert 200_000 < len(frame.cloud) < (recording.depth_image(0) > 0).sum()
    calibration = recording.calibration
    rows = np.genfromtxt(folder / "sdk_golden_even.csv", delimiter=",", names=True)
    px = np.stack([rows["u_depth_px"], rows["v_depth_px"]], axis=1)
    depth_mm = recording.depth_image(0)[px[:, 1].astype(int), px[:, 0].astype(int)]
    np.testing.assert_array_equal(depth_mm, rows["depth_mm"])
    in_depth = np.c_[undistort_px(calibration.depth, px), np.ones(len(px))] * depth_mm[:, None] / 1000
    in_color = calibration.T_color_depth.apply(in_depth)
    np.testing.assert_allclose(in_depth * 1000, np.c_[rows["x_d"], rows["y_d"], rows["z_d"]], atol=0.005)
    np.testing.assert_allclose(in_color * 1000, np.c_[rows["x_c"], rows["y_c"], rows["z_c"]], atol=0.005)
    expected = np.c_[rows["u_color_px"], rows["v_color_px"]]
    np.testing.assert_allclose(by_opencv(calibration.color, in_color), expected, atol=0.002)
    # the cloud is computed like single pixels: each visible row is one of its points
    inside = (expected > 1).all(axis=1) & (expected < [1278, 718]).all(axis=1)
    distance = np.array([np.abs(frame.cloud.xyz_m - point).max(axis=1).min() for point in in_color[inside][::100]])
    assert np.mean(distance < 1e-5) > 0.9


CONTENT = json.dumps(made.calibration()).encode()


@pytest.mark.parametrize("size", COLOUR_MODES)
def test_colour_modes_show_the_same_directions(size: tuple[int, int]):
    """Cropping keeps positions on the sensor, and scaling keeps directions: pixel edges are scaled, not centres."""
    full = parse_calibration(CONTENT, (640, 576), (4096, 3072)).color
    camera = parse_calibration(CONTENT, (640, 576), size).color
    scale = 4096 / size[0]
    xyz = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1], (50, 3))
    middle = (np.array([0, (3072 / scale - size[1]) / 2]) + project(camera, xyz) + 0.5) * scale - 0.5
    np.testing.assert_allclose(middle, project(full, xyz), atol=1e-9)


@pytest.mark.parametrize(("size", "bin_px", "corner"), [((320, 288), 2, (192, 180)), ((1024, 1024), 1, (0, 0))])
def test_depth_modes_are_windows_of_one_sensor(size: tuple[int, int], bin_px: int, corner: tuple[int, int]):
    full = parse_calibration(CONTENT, (1024, 1024), (1280, 720)).depth
    camera = parse_calibration(CONTENT, size, (1280, 720)).depth
    xyz = np.random.default_rng(0).uniform([-0.5, -0.5, 1], [0.5, 0.5, 1], (50, 3))
    on_sensor = (project(camera, xyz) + 0.5) * bin_px - 0.5 + corner
    np.testing.assert_allclose(on_sensor, project(full, xyz), atol=1e-9)


def test_image_sizes_of_no_camera_mode_are_refused():
    with pytest.raises(ValueError, match="belong to no mode of this camera"):
        parse_calibration(CONTENT, (640, 480), (1280, 720))


def test_there_are_no_points_beyond_the_calibrated_radius():
    content = json.dumps(made.calibration(MetricRadius=0.3)).encode()
    calibration = parse_calibration(content, (320, 288), (1280, 720))
    image = np.full((288, 320), 1000, np.uint16)
    in_depth = calibration.seen_points(image)[0] + np.array([made.BASELINE_M, 0, 0], np.float32)
    assert 0 < len(in_depth) < image.size
    assert np.linalg.norm(in_depth[:, :2], axis=1).max() <= 0.3001


# Tilted forward by 20 degrees, in the colour camera's axes (here the same as the device's).
UP = Rotation.from_euler("x", 20, degrees=True).apply([0, -1.0, 0])
SHAKEN = np.array([1.0, 0, 0])
FELT = made.ACCELEROMETER @ UP * 9.79


def test_up_is_the_acceleration_near_the_frames_time(tmp_path: Path):
    random = np.random.default_rng(0)
    still = [(3000 * number, FELT + random.normal(0, 0.03, 3)) for number in range(20)]
    # a knock, half a second later
    knock = [(1_000_000 + 1000 * number, (1.0, 2.0, 30.0)) for number in range(3)]
    recording = open_recording(made.write_recording(tmp_path / "take.mkv", felt=[*still, *knock]))
    for i in range(3):
        up = recording.frame(i).up
        assert np.degrees(np.arccos(up @ UP)) < 0.2
        np.testing.assert_allclose(np.linalg.norm(up), 1)
    assert open_recording(made.write_recording(tmp_path / "none.mkv", frames=1)).frame(0).up is None


def samples(*felt: tuple[int, np.ndarray]) -> np.ndarray:
    return parse_samples(bytes([len(felt) - 1]) + b"".join(made.imu_sample(*each) for each in felt), True)


def test_up_is_none_without_samples_or_while_the_device_moves():
    now = made.START_NS
    np.testing.assert_allclose(up_at_rest(samples((0, FELT)), now), FELT / np.linalg.norm(FELT), atol=1e-6)
    assert up_at_rest(samples((0, FELT * 1.05)), now) is None
    assert up_at_rest(samples((0, FELT * 0.0)), now) is None
    assert up_at_rest(samples((0, FELT), (10, FELT + SHAKEN), (20, FELT - SHAKEN)), now) is None
    assert up_at_rest(samples((600_000, FELT)), now) is None
    assert up_at_rest(samples((0, FELT * np.nan)), now) is None
    assert up_at_rest(np.empty((0, 4)), now) is None


@pytest.mark.parametrize("sizes", [b"", b"\x28\x28"], ids=["equal", "xiph"])
def test_laced_samples_are_read_after_their_sizes(sizes: bytes):
    three = [made.imu_sample(1000 * number, FELT + number) for number in range(3)]
    found = parse_samples(b"\x02" + sizes + b"".join(three), True)
    assert found[:, 0].tolist() == [made.START_NS + 1_000_000 * number for number in range(3)]
    np.testing.assert_allclose(found[:, 1:], FELT + np.arange(3)[:, None], atol=1e-6)


@pytest.mark.shared
def test_up_is_the_normal_of_the_real_desk(shared: Path):
    frame = open_recording(shared / "data" / "azure_kinect" / "recording.mkv").frame(0)
    assert frame.up is not None
    assert frame.up @ [0, -1, 0] > 0.9
    # the desk is at the most frequent height of approximately level points
    xyz = frame.cloud.xyz_m[::20].astype(np.float64)
    level = normals_knn(xyz) @ frame.up > np.cos(np.radians(20))
    heights = xyz[level] @ frame.up
    counts, edges = np.histogram(heights, np.arange(heights.min(), heights.max(), 0.01))
    desk = xyz[level][np.abs(heights - edges[counts.argmax()] - 0.005) < 0.03]
    assert len(desk) > 1000
    normal = np.linalg.svd(desk - desk.mean(axis=0))[2][2]
    assert np.degrees(np.arccos(abs(normal @ frame.up))) < 2


GO_ON = threading.Event()
# The acceleration at rest of an upright device, whose y axis points down.
AT_REST = 9.81 * ACCELEROMETER @ np.array([0.0, -1.0, 0.0])


def capture(number: int, *, color: bool = True, depth: bool = True) -> Capture:
    """A capture of the synthetic recording, binned."""
    bgra = np.dstack([picture(number)[:, :, ::-1], np.full((720, 1280), 255, np.uint8)])
    return Capture(
        np.ascontiguousarray(bgra) if color else None,
        depth_mm(number) if depth else None,
        1_000_000 + 33_333 * number,
        time.perf_counter_ns(),
    )


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Script:
    made = Script(calibration=json.dumps(calibration()))
    install(monkeypatch, made)
    return made


@pytest.fixture
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shortens the timeouts."""
    monkeypatch.setattr(kinect_device, "FIRST_FRAME_WITHIN_S", 0.2)
    monkeypatch.setattr(kinect_device, "NEXT_FRAME_WITHIN_S", 0.1)


def test_frames_of_a_device_have_the_same_content_as_those_of_a_recording(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kinect_device, "DEPTH_SIZE", (320, 288))
    script.captures = ["timeout", capture(0), capture(1, depth=False), capture(2)]
    script.felt = [(990_000 + 100 * n, AT_REST) for n in range(50)]
    device = KinectDevice()
    first, second = device.next_frame(GO_ON), device.next_frame(GO_ON)
    assert first is not None and second is not None
    frame, arrived_s = first
    assert (frame.key, frame.timestamp_ns) == ("000000", 1_000_000_000)
    assert (second[0].key, second[0].timestamp_ns) == ("000001", 1_066_666_000)
    assert (frame.rgb == picture(0)).all()
    assert frame.camera.width_px == 1280
    assert len(frame.cloud) > 10_000
    assert frame.cloud.rgb is not None
    # the wall at 2 m and the post at 1 m, seen by the colour camera
    assert {round(float(z), 1) for z in np.percentile(frame.cloud.xyz_m[:, 2], [1, 50])} == {1.0, 2.0}
    assert frame.up is not None
    assert np.degrees(np.arccos(frame.up @ [0, -1, 0])) < 0.01
    assert time.perf_counter() - 5 < arrived_s <= time.perf_counter()
    device.close()
    device.close()
    assert (script.opened, script.closed) == (1, 1)


def test_a_device_is_selected_by_serial_number_or_index(script: Script) -> None:
    script.serials, script.busy = ("000000000011", "000000000022", "000000000033"), (0,)
    for which, serial in (("1", "000000000022"), ("000000000033", "000000000033")):
        device = KinectDevice(which)
        assert device.name == f"Azure Kinect {serial}"
        device.close()
    assert script.opened == script.closed, "devices that were only inspected are closed again"


@pytest.mark.parametrize(
    ("change", "which", "said"),
    [
        (lambda s: setattr(s, "serials", ()), None, "no Azure Kinect is connected; check its power supply"),
        (lambda s: None, "000000000099", "Kinect 000000000099 can be opened; of 1 connected, .*: 000123456712"),
        (lambda s: setattr(s, "busy", (0,)), None, "another program uses it"),
        (lambda s: setattr(s, "starts", False), None, "its cameras do not start. Its firmware may be too"),
        (lambda s: setattr(s, "calibration", "{}"), None, "calibration cannot be used .CalibrationInformation"),
    ],
)
def test_an_unusable_device_is_an_error_and_is_closed(
    script: Script, change: Callable[[Script], None], which: str | None, said: str
) -> None:
    change(script)
    with pytest.raises(DeviceError, match=said):
        KinectDevice(which)
    assert script.opened == script.closed


def test_without_pyk4a_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyk4a", None)
    with pytest.raises(DeviceError, match=r'cannot be imported .*pip install "rcv-annotator\[kinect\]".*glibc 2\.38'):
        KinectDevice()


@pytest.mark.parametrize("end", ["unplugged", "silent", "only colour"])
def test_an_unplugged_or_silent_device_is_an_error(script: Script, short_timeouts: None, end: str) -> None:
    script.captures = [capture(0)]
    if end == "unplugged":
        script.captures.append("gone")
    if end == "only colour":
        script.captures += [capture(1, depth=False)] * 3
    source = KinectSource()
    script.captures[0].depth = np.full((576, 640), 1000, np.uint16)  # type: ignore[union-attr]
    taken = source.read(GO_ON)
    assert taken is not None
    assert 0 <= taken.read_s < 10
    said = "disconnected; it was unplugged" if end == "unplugged" else "no frame for 0.1 s"
    with pytest.raises(DeviceError, match=said):
        source.read(GO_ON)
    source.close()
    assert (script.opened, script.closed) == (1, 1)


def test_a_missing_first_frame_and_images_of_another_size_are_errors(script: Script, short_timeouts: None) -> None:
    device = KinectDevice()
    with pytest.raises(DeviceError, match=r"no frame for 0\.2 s"):
        device.next_frame(GO_ON)
    script.captures = [capture(0)]  # binned, although the device was opened unbinned
    with pytest.raises(DeviceError, match=rf"its images are \({DEPTH_HEIGHT}, {DEPTH_WIDTH}\)"):
        device.next_frame(GO_ON)


def test_waiting_for_a_frame_can_be_stopped_and_old_frames_are_skipped(script: Script) -> None:
    source = KinectSource()
    stop = threading.Event()
    got: list[Any] = []
    thread = threading.Thread(target=lambda: got.append(source.read(stop)))
    thread.start()
    stop.set()
    thread.join(10)
    assert got == [None]
    script.captures = [capture(0), capture(1)]
    source.resume()
    assert script.captures == []
