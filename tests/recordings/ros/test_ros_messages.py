"""Images, calibrations and point clouds from messages of every form."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from bag_writer import structured
from cloud_samples import ros_cloud
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.projection import project
from annotator.recordings.ros import pictures
from annotator.recordings.ros.bag import Topic
from annotator.recordings.ros.messages import cloud_of, read_camera_info
from annotator.recordings.ros.pictures import BAYER, color_image, depth_image, describe

RGB = np.random.default_rng(3).integers(0, 256, (6, 8, 3), np.uint8)


def image(pixels: np.ndarray, encoding: str, padding: int = 0, is_bigendian: int = 0, **changed: Any) -> Any:
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=5)
    fields = {"width": width, "height": height, "encoding": encoding, "is_bigendian": is_bigendian,
              "step": rows.shape[1], "data": rows.reshape(-1)}  # fmt: skip
    return SimpleNamespace(**(fields | changed))


ALPHA = np.full((6, 8, 1), 9, np.uint8)
GREY = RGB[:, :, :1]
COLORS = [
    ("rgb8", RGB, RGB), ("8UC3", RGB[:, :, ::-1], RGB), ("bgra8", np.dstack([RGB[:, :, ::-1], ALPHA]), RGB),
    ("mono8", GREY, np.repeat(GREY, 3, 2)), ("rgb16", RGB.astype(np.uint16) * 257, RGB),
    ("bgr16", RGB[:, :, ::-1].astype(np.uint16) << 8, RGB),
]  # fmt: skip


@pytest.mark.parametrize(("encoding", "pixels", "expected"), COLORS)
def test_colours_are_those_of_the_message(encoding: str, pixels: np.ndarray, expected: np.ndarray):
    padding = 3
    np.testing.assert_array_equal(color_image(image(pixels, encoding, padding)), expected)
    swapped = image(pixels.astype(pixels.dtype.newbyteorder(">")), encoding, padding, is_bigendian=1)
    np.testing.assert_array_equal(color_image(swapped), expected)


@pytest.mark.parametrize("pattern", BAYER)
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_patterns_begin_with_the_colour_of_their_name(pattern: str, bits: int):
    color = {"r": 200, "g": 100, "b": 50}
    mosaic = np.tile(np.array([[color[c] for c in pattern[:2]], [color[c] for c in pattern[2:]]], np.uint8), (8, 8))
    pixels = mosaic if bits == 8 else mosaic.astype(np.uint16) << 8
    inner = color_image(image(pixels[:, :, None], f"bayer_{pattern}{bits}"))[2:-2, 2:-2]
    assert (inner == (200, 100, 50)).all()


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("uyvy", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_yuv_images_are_converted(encoding: str, order: str):
    values = {"y": 180, "u": 90, "v": 160}
    pixels = np.tile(np.array([values[c] for c in order], np.uint8).reshape(1, 2, 2), (4, 4, 1))
    # BT.601, limited range
    y, u, v = 1.164 * (180 - 16), 90 - 128, 160 - 128
    expected = (y + 1.596 * v, y - 0.392 * u - 0.813 * v, y + 2.017 * u)
    assert np.abs(color_image(image(pixels, encoding)).astype(float) - expected).max() <= 2


def test_grey_messages_show_the_darkest_to_the_brightest_hundredth(monkeypatch: pytest.MonkeyPatch):
    """As of infrared cameras, whose highlights are saturated; one range for all pictures of a topic."""
    grey = np.linspace(500, 3500, 2000).astype(np.uint16).reshape(40, 50)
    grey[0, 0], grey[0, 1] = 65535, 0
    shown = color_image(image(grey, "mono16"))
    assert shown[0, 0, 0] == 255
    np.testing.assert_allclose(shown[20, 25, 0], 131, atol=1)
    monkeypatch.setattr(pictures, "message", lambda *_: image(grey, "mono16"))
    topic = Topic("/ir", "sensor_msgs/Image", (), np.empty(0))
    dark = color_image(image(np.full_like(grey, 530), "mono16"), (topic, (0,)))
    assert dark.max() <= 1


@given(st.sampled_from(["16UC1", "mono16", "32FC1"]), st.integers(0, 9), st.booleans(), st.data())
def test_depths_are_those_of_the_message(encoding: str, padding: int, is_bigendian: bool, data: st.DataObject):
    metres = np.array(data.draw(st.lists(st.integers(0, 65503), min_size=12, max_size=12))).reshape(3, 4)
    order = ">" if is_bigendian else "<"
    kind, expected = ("f4", metres / 8) if encoding == "32FC1" else ("u2", metres / 1000)
    stored = (metres / 8 if encoding == "32FC1" else metres).astype(order + kind)
    read = depth_image(image(stored[:, :, None], encoding, padding, int(is_bigendian)))
    np.testing.assert_array_equal(read, expected.astype(np.float32))
    if encoding != "32FC1":
        with_unit = depth_image(image(stored[:, :, None], encoding, padding, int(is_bigendian)), 0.00025)
        np.testing.assert_array_equal(with_unit, metres.astype(np.float32) * np.float32(0.00025))


def test_compressed_images_and_depths():
    png = cv2.imencode(".png", RGB[:, :, ::-1])[1]
    np.testing.assert_array_equal(color_image(SimpleNamespace(format="bgr8; png compressed bgr8", data=png)), RGB)
    millimetres = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    packed = cv2.imencode(".png", millimetres)[1].tobytes()
    for form, data in (("16UC1; compressedDepth png", bytes(12) + packed), ("16UC1; png compressed ", packed)):
        content = SimpleNamespace(format=form, data=np.frombuffer(data, np.uint8))
        assert describe(content, "/x")[2]
        np.testing.assert_array_equal(depth_image(content), millimetres.astype(np.float32) / np.float32(1000))
    # compressed_depth_image_transport: quantised inverse depth
    a, b = 100.0, -5.0
    quantised = np.rint(a / np.linspace(0.5, 9, 48, dtype=np.float32).reshape(6, 8) + b).astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + cv2.imencode(".png", quantised)[1].tobytes()
    content = SimpleNamespace(format="32FC1; compressedDepth", data=np.frombuffer(data, np.uint8))
    np.testing.assert_allclose(depth_image(content), a / (quantised - np.float32(b)), rtol=1e-6)


def test_rvl_depths_are_read():
    """Encoded as the paper's C code does: runs of zeros and of differences, nibble by nibble."""
    depth = [[0, 0, 1000, 1001], [999, 0, 65503, 65503], [3, 2, 0, 0]]
    packed = bytes.fromhex("040000000300000023f38a23f3fb8e1431ffee0f00000020")
    data = np.frombuffer(struct.pack("<iff", 0, 0, 0) + packed, np.uint8)
    read = depth_image(SimpleNamespace(format="16UC1; compressedDepth rvl", data=data))
    np.testing.assert_array_equal(read, np.array(depth, np.float32) / np.float32(1000))


WRONG_IMAGES = [
    (image(RGB, "rgb8", height=7), "6 pixels|do not fit its 144 bytes"),
    (image(RGB, "rgb8", step=8), "rows of 8 bytes"),
    (image(RGB, "rgb8", width=1 << 30, height=1 << 30), "is too large"),
    (image(RGB, "hsv8"), "has the encoding 'hsv8'"),
]


@pytest.mark.parametrize(("content", "problem"), WRONG_IMAGES)
def test_images_that_contradict_themselves_are_errors(content: Any, problem: str):
    with pytest.raises(ValueError, match=problem):
        color_image(content)


def info(**changed: Any) -> Any:
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
    fields = {"width": 640, "height": 480, "distortion_model": "plumb_bob", "K": K, "D": [],
              "R": np.eye(3).ravel(), "P": np.zeros(12), "binning_x": 0, "binning_y": 0, "roi": roi}  # fmt: skip
    return SimpleNamespace(**(fields | changed))


def test_distortions_keep_their_order():
    D = [0.1, -0.05, 0.001, -0.002, 0.01]
    assert read_camera_info(info(D=D), False).camera.distortion == tuple(D)
    rational = [0.1, -0.05, 0.001, -0.002, 0.01, 0.3, 0.02, 0.004]
    content = info(D=rational, distortion_model="rational_polynomial")
    assert read_camera_info(content, False).camera.distortion == tuple(rational)
    assert read_camera_info(info(D=[0.0] * 5, distortion_model="?"), False).camera.distortion == ()


def test_a_rectified_image_has_the_camera_p_turned_by_r():
    R = Rotation.from_rotvec([0.01, -0.02, 0.03]).as_matrix()
    P = np.array([[450.0, 0, 300, -45.0], [0, 450, 250, 0], [0, 0, 1, 0]])
    content = info(D=[0.1, 0, 0, 0, 0], R=R.ravel(), P=P.ravel())
    rectified = read_camera_info(content, True)
    np.testing.assert_array_equal(rectified.camera.matrix, P[:, :3])
    assert rectified.camera.is_ideal
    np.testing.assert_allclose(rectified.T_camera_frame.rotation.as_matrix(), R, atol=1e-12)
    assert read_camera_info(content, False).camera.matrix[0, 0] == 500


def test_binning_and_region_of_interest():
    roi = SimpleNamespace(x_offset=100, y_offset=50, width=400, height=300)
    camera = read_camera_info(info(roi=roi, binning_x=2, binning_y=2), False).camera
    assert (camera.width_px, camera.height_px) == (200, 150)
    np.testing.assert_array_equal(camera.matrix, [[250, 0, 110], [0, 255, 95], [0, 0, 1]])


def test_fisheye_images_are_undistorted():
    K, D = np.array([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]]), np.array([0.05, -0.01, 0.002, 0.0])
    camera = read_camera_info(info(K=K.ravel(), D=D, distortion_model="equidistant"), False)
    assert camera.camera.is_ideal
    # a bright dot where the fisheye camera sees a point is where the pinhole camera projects that point
    point = np.array([[0.3, -0.2, 1.0]])
    seen = cv2.fisheye.projectPoints(point[None], np.zeros(3), np.zeros(3), K, D)[0].reshape(2)
    rgb = np.zeros((480, 640, 3), np.uint8)
    cv2.circle(rgb, tuple(np.rint(seen).astype(int).tolist()), 3, (255, 255, 255), -1)
    rows, columns = np.nonzero(camera.picture(rgb)[:, :, 0] > 128)
    assert np.abs(project(camera.camera, point)[0] - (columns.mean(), rows.mean())).max() < 1


def test_the_inverse_model_of_realsense_is_approximated():
    D = [-0.055, 0.064, 0.0002, -0.0003, -0.02]
    camera = read_camera_info(info(D=D, distortion_model="Inverse Brown Conrady"), False).camera
    px = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7)), -1).reshape(-1, 2)
    x, y = (px[:, 0] - 320) / 500, (px[:, 1] - 240) / 510
    r2 = x * x + y * y
    # librealsense's rsutil.h, rs2_deproject_pixel_to_point
    f = 1 + D[0] * r2 + D[1] * r2**2 + D[4] * r2**3
    ux = x * f + 2 * D[2] * x * y + D[3] * (r2 + 2 * x * x)
    uy = y * f + 2 * D[3] * x * y + D[2] * (r2 + 2 * y * y)
    np.testing.assert_allclose(project(camera, np.stack([ux, uy, np.ones_like(ux)], 1)), px, atol=0.3)


WRONG_INFOS = [
    (info(K=np.zeros(9)), "not calibrated: K is zero"),
    (info(K=[500.0, 3, 320, 0, 510, 240, 0, 0, 1]), "not a pinhole camera"),
    (info(D=[0.1] * 15), "15 numbers"),
    (info(D=[0.1], distortion_model="equidistant"), "equidistant has four"),
    (info(width=1 << 31, height=1 << 31), "is too large"),
]


@pytest.mark.parametrize(("content", "problem"), WRONG_INFOS)
def test_calibrations_that_cannot_be_used_are_errors(content: Any, problem: str):
    with pytest.raises(ValueError, match=problem):
        read_camera_info(content, False)


def test_an_image_of_another_size_than_its_calibration_is_refused():
    with pytest.raises(ValueError, match="has 32 x 24 pixels, but its camera has 640 x 480"):
        read_camera_info(info(), False).require_size((24, 32, 3))


@given(st.data())
def test_clouds_of_any_layout_are_read(data: st.DataObject):
    """Any order and type of fields, padding, byte order, organised or not."""
    random = np.random.default_rng(data.draw(st.integers(0, 999)))
    count = 12
    xyz = random.integers(-50, 50, (count, 3)) / 4
    kind = data.draw(st.sampled_from(["f4", "f8"]))
    packed = random.integers(0, 1 << 24, count).astype(np.uint32)
    columns = {name: values.astype(kind) for name, values in zip("xyz", xyz.T, strict=True)}
    columns["intensity"] = random.integers(0, 256, count).astype(data.draw(st.sampled_from(["u1", "f4", "u2", "f8"])))
    columns["rgb"] = packed.view(np.float32) if data.draw(st.booleans()) else packed
    columns["ring"] = np.arange(count, dtype=np.uint16)
    names = data.draw(st.permutations(list(columns)))
    order, padding = data.draw(st.sampled_from("<>")), data.draw(st.integers(0, 5))
    points = structured({name: columns[name] for name in names}, order, padding)
    height = data.draw(st.sampled_from([1, 3]))
    raw = cloud_of(ros_cloud(points, height, data.draw(st.integers(0, 9))))
    np.testing.assert_array_equal(raw.xyz_m, xyz)
    shifts = np.array([16, 8, 0])
    np.testing.assert_array_equal(raw.rgb, packed[:, None] >> shifts & 255)
    assert raw.reflectance is not None and raw.reflectance.max() <= 1


POINTS = structured({name: np.arange(4, dtype=np.float32) for name in "xyz"})
WRONG_CLOUDS = [
    (ros_cloud(POINTS, width=5), "declares 5 x 1 points"),
    (ros_cloud(POINTS, point_step=11, width=1, row_step=11), "field z at byte 8, outside of a point of 11 bytes"),
    (ros_cloud(POINTS, fields=ros_cloud(POINTS).fields[:2]), "no column z"),
]


@pytest.mark.parametrize(("content", "problem"), WRONG_CLOUDS)
def test_clouds_that_contradict_themselves_are_errors(content: Any, problem: str):
    with pytest.raises(ValueError, match=problem):
        cloud_of(content)
