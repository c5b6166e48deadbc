"""Folders of point clouds: with and without images and calibrations, and the image drawn if there is none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cloud_samples import SCAN, camera_file, image, put_image
from kitti_samples import HEIGHT, OBJECT_CALIB, WIDTH, by_formula

from annotator.geometry.projection import project
from annotator.recordings import open_recording
from annotator.recordings.clouds.virtual_camera import virtual_image
from annotator.types import Camera, PointCloud
from annotator.types.errors import FrameError

LIDAR_TO_CAMERA = [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]


@pytest.mark.parametrize("place", ["", "velodyne"])
def test_clouds_without_images_are_seen_from_the_lidars_position(tmp_path: Path, place: str):
    folder = tmp_path / place
    folder.mkdir(exist_ok=True)
    for key in ("10", "2"):
        np.save(folder / f"{key}.npy", SCAN)
    recording = open_recording(tmp_path)
    assert (recording.format, recording.keys, recording.root) == ("cloud_folder", ("2", "10"), tmp_path)
    frame = recording.frame(1)
    # all points are kept, also those behind; x forward, y left, z up
    np.testing.assert_allclose(frame.cloud.xyz_m, np.stack([-SCAN[:, 1], -SCAN[:, 2], SCAN[:, 0]], axis=1), atol=1e-6)
    np.testing.assert_array_equal(frame.cloud.reflectance, SCAN[:, 3])
    np.testing.assert_allclose(frame.T_camera_label.apply(SCAN[:, :3].astype(float)), frame.cloud.xyz_m, atol=1e-5)
    np.testing.assert_array_equal(frame.up, [0, -1, 0])
    assert frame.cloud.rgb is None
    # the image shows the points, and almost nothing elsewhere
    ahead = frame.cloud.xyz_m[frame.cloud.xyz_m[:, 2] > 5]
    u, v = np.rint(project(frame.camera, ahead)).astype(int).T
    inside = (u >= 0) & (u < 1280) & (v >= 0) & (v < 720)
    assert inside.sum() > 200
    assert frame.rgb[v[inside], u[inside]].any(axis=1).all()
    assert 0.001 < frame.rgb.any(axis=2).mean() < 0.3


@pytest.mark.parametrize(("calib", "images"), [("calib/7.txt", "image"), ("calib.txt", "points")])
def test_a_cloud_with_an_image_and_kittis_calibration_is_read_as_in_kitti(tmp_path: Path, calib: str, images: str):
    (tmp_path / "points").mkdir()
    (tmp_path / "points" / "7.bin").write_bytes(SCAN.tobytes())
    put_image(tmp_path / images / "7.png", 3)
    (tmp_path / calib).parent.mkdir(exist_ok=True)
    (tmp_path / calib).write_text(OBJECT_CALIB)
    frame = open_recording(tmp_path).frame(0)
    px, inside = by_formula(SCAN)
    np.testing.assert_allclose(project(frame.camera, frame.cloud.xyz_m), px[inside], atol=2e-3)
    u, v = np.rint(px[inside]).astype(int).T
    np.testing.assert_array_equal(frame.cloud.rgb, image(3)[v, u])
    np.testing.assert_array_equal(frame.cloud.reflectance, SCAN[inside, 3])
    np.testing.assert_allclose(frame.T_camera_label.apply(SCAN[inside, :3].astype(float)), frame.cloud.xyz_m, atol=0.02)


def test_a_calibration_without_images_is_the_camera_of_the_drawn_image(tmp_path: Path):
    np.save(tmp_path / "7.npy", SCAN[:, :3])
    (tmp_path / "calib.txt").write_text(OBJECT_CALIB)
    frame = open_recording(tmp_path).frame(0)
    assert (frame.camera.width_px, frame.camera.height_px, len(frame.cloud)) == (123, 35, len(SCAN))
    (tmp_path / "calib.txt").unlink()
    (tmp_path / "camera_intrinsic.json").write_text(camera_file(cloud_to_camera=LIDAR_TO_CAMERA))
    (tmp_path / "gravity.json").write_text('{"up": [0, -2, 0]}')
    frame = open_recording(tmp_path).frame(0)
    assert (frame.camera.width_px, frame.camera.fx) == (WIDTH, 70)
    np.testing.assert_allclose(
        frame.cloud.xyz_m, np.stack([0.1 - SCAN[:, 1], 0.2 - SCAN[:, 2], SCAN[:, 0] - 0.3], axis=1), atol=1e-5
    )
    np.testing.assert_array_equal(frame.up, [0, -1, 0])


def test_clouds_in_the_camera_frame_keep_their_coordinates_and_colours(tmp_path: Path):
    rgb = np.random.default_rng(0).integers(0, 255, (len(SCAN), 3))
    np.save(tmp_path / "7.npy", np.c_[SCAN[:, :3], rgb])
    (tmp_path / "camera_intrinsic.json").write_text(camera_file())
    put_image(tmp_path / "color" / "7.png", 1)
    frame = open_recording(tmp_path).frame(0)
    px = project(frame.camera, SCAN[:, :3].astype(np.float64))
    kept = (SCAN[:, 2] > 0.1) & (px >= -0.5).all(axis=1) & (px < [WIDTH - 0.5, HEIGHT - 0.5]).all(axis=1)
    np.testing.assert_array_equal(frame.cloud.xyz_m, SCAN[kept, :3])
    np.testing.assert_array_equal(frame.cloud.rgb, rgb[kept])
    assert frame.up is None


def calibrated(**more: object) -> Callable[[Path], object]:
    return lambda path: (path / "camera_intrinsic.json").write_text(camera_file(**more))


TURNED = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
ELSEWHERE = [*LIDAR_TO_CAMERA[:2], [1, 0, 0, -99], LIDAR_TO_CAMERA[3]]
BROKEN = [
    (lambda p: None, "calibration of the images is missing; write camera_intrinsic.json"),
    (calibrated(cloud_to_camera=TURNED), "not a rigid transform"),
    (calibrated(width=99), "the image is 120 x 40 pixels, but the camera is for 99 x 40"),
    (calibrated(cloud_to_camera=ELSEWHERE), r"none of its points lies in the image \(3000 in all\)"),
    (lambda p: (p / "image" / "7.png").unlink(), "missing; put 7.png"),
    (lambda p: np.save(p / "points" / "7.npy", SCAN), r"ambiguous: the folder has 7\.bin, 7\.npy"),
]


@pytest.mark.parametrize(("damage", "complaint"), BROKEN)
def test_a_broken_frame_is_an_error_and_others_are_read(
    tmp_path: Path, damage: Callable[[Path], object], complaint: str
):
    (tmp_path / "points").mkdir()
    for key in ("7", "8"):
        (tmp_path / "points" / f"{key}.bin").write_bytes(SCAN.tobytes())
        put_image(tmp_path / "image" / f"{key}.png", 3)
    damage(tmp_path)
    recording = open_recording(tmp_path)
    with pytest.raises(FrameError, match=complaint):
        recording.frame(0)
    if not (tmp_path / "camera_intrinsic.json").exists():
        (tmp_path / "camera_intrinsic.json").write_text(camera_file(cloud_to_camera=LIDAR_TO_CAMERA))
        assert len(recording.frame(1).cloud) > 10


def test_the_drawn_image_shows_the_nearest_point():
    camera = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    xyz = np.array([[0, 0, 4], [0, 0, 1], [0, 0, 2], [0, 0, -1], [9, 0, 1]], np.float32)
    rgb = np.array([[1, 1, 1], [250, 0, 0], [2, 2, 2], [3, 3, 3], [4, 4, 4]], np.uint8)
    picture = virtual_image(camera, PointCloud(xyz, rgb=rgb))
    np.testing.assert_array_equal(picture[14:16, 19:21], np.full((2, 2, 3), [250, 0, 0]))
    assert {tuple(color) for color in picture.reshape(-1, 3)} == {(0, 0, 0), (250, 0, 0)}
