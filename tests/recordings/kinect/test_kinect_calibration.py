"""The Azure Kinect's cameras, whose modes are windows of one sensor, and its accelerometer."""

from __future__ import annotations

import json
from pathlib import Path

import kinect_recording as made
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.normals import normals_knn
from annotator.geometry.projection import project
from annotator.recordings import open_recording
from annotator.recordings.kinect.calibration import (
    COLOUR_MODES,
    parse_calibration,
    parse_samples,
    up_at_rest,
)

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


@pytest.mark.parametrize(("depth", "color"), [((640, 480), (1280, 720)), ((640, 576), (640, 480))])
def test_image_sizes_of_no_camera_mode_are_refused(depth: tuple[int, int], color: tuple[int, int]):
    with pytest.raises(ValueError, match="belong to no mode of this camera"):
        parse_calibration(CONTENT, depth, color)


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
    assert up_at_rest(np.empty(0, samples((0, FELT)).dtype), now) is None


@pytest.mark.parametrize("sizes", [b"", b"\x28\x28", b"\xa8\xbf"], ids=["equal", "xiph", "ebml"])
def test_laced_samples_are_read_after_their_sizes(sizes: bytes):
    three = [made.imu_sample(1000 * number, FELT + number) for number in range(3)]
    found = parse_samples(b"\x02" + sizes + b"".join(three), True)
    assert found["time_ns"].tolist() == [made.START_NS + 1_000_000 * number for number in range(3)]
    np.testing.assert_allclose(found["acceleration_mps2"], FELT + np.arange(3)[:, None], atol=1e-6)


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
