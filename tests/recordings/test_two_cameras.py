"""Depth from a camera that is not the colour camera: which points there are, where, and with which colour."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.projection import project, resized
from annotator.recordings.two_cameras import registered
from annotator.types import Camera

DEPTH = Camera(64, 48, 60.0, 61.0, 31.0, 23.5)
COLOR = Camera(160, 120, 140.0, 141.0, 80.0, 58.0, (0.05, -0.02, 0.001, -0.001))
SAME_PLACE = RigidTransform.identity()


def pose(shift_m: list[float], turn_rad: list[float]) -> RigidTransform:
    return RigidTransform.from_components(np.array(shift_m), Rotation.from_rotvec(turn_rad))


def picture(camera: Camera) -> np.ndarray:
    """A colour for each pixel that tells where it is."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    return np.stack([u, v, (u ^ v)], axis=-1).astype(np.uint8)


small = st.floats(-0.1, 0.1)


@given(st.lists(small, min_size=3, max_size=3), st.lists(small, min_size=3, max_size=3), st.integers(0, 99))
def test_each_point_is_a_measured_pixel_with_the_colour_that_it_projects_to(
    shift_m: list[float], turn_rad: list[float], seed: int
):
    random = np.random.default_rng(seed)
    depth_m = random.uniform(0.5, 3.0, (DEPTH.height_px, DEPTH.width_px)).astype(np.float32)
    depth_m[random.random(depth_m.shape) < 0.2] = random.choice([0.0, -1.0, np.nan, np.inf])
    T_color_depth, rgb = pose(shift_m, turn_rad), picture(COLOR)
    cloud, in_color_m = registered(depth_m, DEPTH, T_color_depth, rgb, COLOR)
    back = T_color_depth.inv().apply(cloud.xyz_m)
    px = project(DEPTH, back)
    u, v = np.rint(px).astype(int).T
    np.testing.assert_allclose(px, np.c_[u, v], atol=1e-2)
    np.testing.assert_allclose(back[:, 2], depth_m[v, u], rtol=1e-5)
    assert len({*zip(u, v, strict=True)}) == len(cloud)
    px = project(COLOR, cloud.xyz_m)
    clear = (np.abs(px % 1 - 0.5) > 1e-3).all(axis=1)
    u, v = np.rint(px[clear]).astype(int).T
    np.testing.assert_array_equal(cloud.rgb[clear], rgb[v, u])
    assert cloud.pixel_index is None
    # each pixel holds the nearest of its points
    expected = np.full(in_color_m.shape, np.inf, np.float32)
    u, v = np.floor(px + 0.5).astype(int).clip(0).T
    np.minimum.at(expected, (v.clip(max=COLOR.height_px - 1), u.clip(max=COLOR.width_px - 1)), cloud.xyz_m[:, 2])
    expected[np.isinf(expected)] = 0
    assert (expected != in_color_m).mean() < 1e-3


def test_points_outside_the_image_or_hidden_from_it_are_left_out():
    depth_m = np.full((48, 64), 2.0, np.float32)
    depth_m[:, 28:36] = 1.0  # a post before a wall
    T_color_depth = pose([-0.1, 0.0, 0.0], [0, 0, 0])
    cloud, in_color_m = registered(depth_m, DEPTH, T_color_depth, picture(COLOR), COLOR)
    middle = np.abs(cloud.xyz_m[:, 1]) < 0.2
    columns = np.rint(project(DEPTH, T_color_depth.inv().apply(cloud.xyz_m[middle]))[:, 0]).astype(int)
    # in the colour camera, the post lies 6 columns of the depth image further left, the wall 3
    missing = {*range(64)} - {*columns}
    assert {25, 26, 27} <= missing <= {0, 24, 25, 26, 27}
    assert set(np.unique(in_color_m)) == {0.0, 1.0, 2.0}  # nothing between the post and the wall
    aside, _ = registered(depth_m, DEPTH, pose([1.5, 0, 0], [0, 0, 0]), picture(COLOR), COLOR)
    assert 0 < len(aside) < len(cloud) / 2
    behind, nothing = registered(depth_m, DEPTH, pose([0, 0, -3], [0, 0, 0]), picture(COLOR), COLOR)
    assert len(behind) == 0 and not nothing.any()


def test_from_the_same_place_no_point_is_hidden():
    depth_m = np.where(np.mgrid[:48, :64].sum(axis=0) % 2, 1.0, 3.0).astype(np.float32)
    camera = Camera(640, 480, 600.0, 610.0, 314.5, 239.5)
    cloud, in_color_m = registered(depth_m, resized(camera, 64, 48), SAME_PLACE, picture(camera), camera)
    assert len(cloud) == depth_m.size == np.count_nonzero(in_color_m)
    np.testing.assert_allclose(project(camera, cloud.xyz_m)[0], [4.5, 4.5], atol=1e-3)  # the middle of ten pixels
