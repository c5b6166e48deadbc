"""Frames with a corrected calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.oriented_box import corrected, with_image
from annotator.geometry.projection import project, unproject_depth
from annotator.types import Camera, Correction, Frame, PointCloud

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
TURN = Correction((0.02, -0.03, 0.01), (0.05, -0.02, 0.1))


@pytest.fixture
def frame() -> Frame:
    """A slanted plane with a coloured image."""
    depth = (2 + np.linspace(0, 1, 64)[None] * np.ones((48, 1))).astype(np.float32)
    xyz, pixel = unproject_depth(CAMERA, depth)
    rgb = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    cloud = PointCloud(xyz, rgb.reshape(-1, 3)[pixel], pixel_index=pixel)
    return Frame("0", 0, CAMERA, rgb, cloud, depth, np.array([0.0, -1.0, 0.0]))


def test_points_normals_and_up_move_with_the_cloud(frame: Frame):
    T = TURN.T_camera_recorded
    moved = corrected(frame, TURN)
    assert np.allclose(moved.cloud.xyz_m, T.apply(frame.cloud.xyz_m), atol=1e-6)
    assert moved.up is not None
    assert np.allclose(moved.up, T.rotation.apply([0.0, -1.0, 0.0]))
    assert moved.cloud.normals is not None
    known = np.linalg.norm(moved.cloud.normals, axis=1) > 0.5
    # the normals of the plane, turned
    x, _, z = frame.cloud.xyz_m.T
    assert known.mean() > 0.8
    plane = np.cross(np.subtract(*moved.cloud.xyz_m[[70, 60]]), np.subtract(*moved.cloud.xyz_m[[640, 0]]))
    cosine = np.abs(moved.cloud.normals[known] @ plane / np.linalg.norm(plane))
    assert np.median(cosine) > 0.99
    assert x.std() > 0 and z.std() > 0


def test_the_depth_image_is_no_longer_registered(frame: Frame):
    moved = corrected(frame, TURN)
    assert moved.depth_m is None
    assert moved.cloud.pixel_index is None


def test_points_take_the_colour_of_the_pixel_on_which_they_fall(frame: Frame):
    moved = corrected(frame, Correction(shift_m=(0.1, 0.0, 0.0)))
    px = project(CAMERA, moved.cloud.xyz_m).round().astype(int)
    inside = (px[:, 0] >= 0) & (px[:, 0] < 64) & (px[:, 1] >= 0) & (px[:, 1] < 48)
    assert moved.cloud.rgb is not None
    assert frame.cloud.rgb is not None
    assert (moved.cloud.rgb[inside] == frame.rgb[px[inside, 1], px[inside, 0]]).all()
    assert (moved.cloud.rgb[~inside] == frame.cloud.rgb[~inside]).all()
    assert not (moved.cloud.rgb == frame.cloud.rgb).all()


def test_labels_of_the_recordings_files_move_along(frame: Frame):
    T_camera_label = RigidTransform.from_components([0.1, 0.2, 0.3], Rotation.from_rotvec([0.0, 0.5, 0.0]))
    moved = corrected(replace(frame, T_camera_label=T_camera_label), TURN)
    expected = TURN.T_camera_recorded * T_camera_label
    assert moved.T_camera_label is not None
    assert np.allclose(moved.T_camera_label.as_matrix(), expected.as_matrix())
    assert moved.T_camera_recorded is not None
    assert corrected(frame, TURN).T_camera_label is not None


def test_another_image_colours_the_cloud_in_its_place(frame: Frame):
    shown = with_image(frame, 255 - frame.rgb)
    assert frame.cloud.rgb is not None
    assert shown.cloud.rgb is not None
    assert (shown.cloud.rgb == 255 - frame.cloud.rgb).all()
    assert (shown.cloud.xyz_m == frame.cloud.xyz_m).all()
    assert shown.depth_m is not None
