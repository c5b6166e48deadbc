"""Normals of depth images and points, the up direction of planes, and registration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from geometry_strategies import cameras, vectors
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from annotator.geometry.normals import normals_from_depth, normals_knn, px_per_ray
from annotator.geometry.projection import pixel_rays, unproject_depth
from annotator.geometry.registration import register, register_surface, share_found
from annotator.geometry.transforms import unit
from annotator.geometry.up_direction import UpEstimate, estimate_up
from annotator.synthetic.snapshots import snapshot
from annotator.types import Camera, Frame, PointCloud
from annotator.workflows.recorded.adjusting import LEAST_CERTAINTY, agreed_up

PINHOLE = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)


def plane_depth(camera: Camera, normal: np.ndarray, distance_m: float) -> np.ndarray:
    """Depth of the plane n.p = distance; 0 where a ray does not hit it."""
    rays = np.concatenate([pixel_rays(camera), np.ones((camera.height_px, camera.width_px, 1))], axis=-1)
    slope = rays @ normal
    return np.where(slope > 0.05, distance_m / np.maximum(slope, 0.05), 0.0).astype(np.float32)


def degrees_off(normals: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(normals, truth), axis=-1), (normals * truth).sum(axis=-1)))


def degrees_bent(camera: Camera) -> np.ndarray:
    """The largest change of the image's scale and direction within half a window of each pixel, degrees."""
    size = (camera.height_px, camera.width_px)
    scale = np.broadcast_to(px_per_ray(camera), (*size, 2, 2)).astype(np.float64)
    padded = np.pad(scale, ((4, 4), (4, 4), (0, 0), (0, 0)), mode="edge")
    around = np.stack([padded[v : v + size[0], u : u + size[1]] for v in (0, 4, 8) for u in (0, 4, 8)])
    return np.degrees(np.linalg.norm(np.linalg.inv(scale) @ around - np.eye(2), 2, (-2, -1)).max(axis=0))


def known(normals: np.ndarray) -> np.ndarray:
    return np.linalg.norm(normals, axis=-1) > 0.5


@settings(deadline=None)
@example(Camera(64, 48, 58.0, 55.1, 26.0, 19.3, (-0.09375, -0.03125, 0.0, 0.0)), np.array([0.0, 1.0, 0.0]), 1.0)
@given(cameras(), vectors(), st.floats(0.3, 5.0))
def test_normals_of_a_plane_point_towards_the_camera(camera: Camera, normal: np.ndarray, distance_m: float) -> None:
    assume(np.linalg.norm(normal) > 0.01)
    normal = unit(normal)
    depth = plane_depth(camera, normal, distance_m)
    normals = normals_from_depth(camera, depth)
    seen = known(normals)
    assert not normals[depth == 0].any()
    np.testing.assert_allclose(np.linalg.norm(normals[seen], axis=-1), 1.0, atol=1e-5)
    # the change of depth per distance across; steeper planes cannot be distinguished from jumps
    steepness = np.linalg.norm(normal[:2]) * depth / distance_m
    fair = (depth > 0) & (steepness < 1.8)
    assert seen[fair].all()
    # at the border the window extends to one side only, so lens distortion within it matters
    off = np.where(fair, degrees_off(normals, -normal), 0.0)
    assert (off <= 0.1 + 0.6 * degrees_bent(camera)).all()
    # the images are 64 px wide: 4 px here correspond to 40 px of a real camera
    assert off[4:-4, 4:-4].max() < 0.5


def test_normals_are_not_blurred_at_a_depth_jump() -> None:
    """A box in front of a wall: no normal is computed across the edge."""
    depth = np.full((120, 160), 2.0, np.float32)
    depth[40:80, 60:100] = 1.5
    normals = normals_from_depth(PINHOLE, depth)
    np.testing.assert_allclose(normals, np.broadcast_to([0.0, 0.0, -1.0], normals.shape), atol=1e-4)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_missing_depth_has_no_normal_and_does_not_disturb_others(bad: float) -> None:
    depth = np.full((120, 160), 2.0, np.float32)
    depth[::7, ::5] = bad
    normals = normals_from_depth(PINHOLE, depth)
    assert not normals[::7, ::5].any()
    full = normals[known(normals)]
    assert len(full) == np.count_nonzero(depth == 2.0)
    np.testing.assert_allclose(full, np.broadcast_to([0.0, 0.0, -1.0], full.shape), atol=1e-5)


def sphere(count: int, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    outward = np.random.default_rng(0).normal(size=(count, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return (outward + center).astype(np.float32), outward


def test_normals_of_unordered_points_on_a_sphere_point_to_the_sensor() -> None:
    points, outward = sphere(5000, np.array([0.0, 1.0, 4.0]))
    normals = normals_knn(points)
    assert normals.dtype == np.float32
    assert ((normals * points).sum(axis=1) <= 0).all()
    towards_sensor = np.where((outward * points).sum(axis=1, keepdims=True) > 0, -outward, outward)
    assert np.median(degrees_off(normals, towards_sensor)) < 1.5


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (np.zeros((0, 3)), "nothing"),
        (np.ones((2, 3)), "two points"),
        (np.ones((30, 3)), "one spot"),
        (np.linspace(0, 1, 30)[:, None] * [1.0, 2.0, 3.0] + [0.0, 0.0, 5.0], "a line"),
    ],
)
def test_degenerate_clouds_have_no_normals(points: np.ndarray, why: str) -> None:
    normals = normals_knn(points)
    assert normals.shape == points.shape
    assert not normals.any(), why


CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
LEVEL = np.array([0.0, -1.0, 0.0])


def flat_frame(depth: np.ndarray) -> Frame:
    """A frame of a depth image without colours."""
    depth_m = depth.astype(np.float32)
    xyz, pixel = unproject_depth(CAMERA, depth_m)
    return Frame("0", 0, CAMERA, np.zeros((240, 320, 3), np.uint8), PointCloud(xyz, pixel_index=pixel), depth_m)


def planes_frame(up: np.ndarray) -> Frame:
    """A noisy depth image of a floor 1.2 m below the camera and of two walls."""
    random = np.random.default_rng(0)
    turn = Rotation.align_vectors(up[None], LEVEL[None])[0]
    rays = np.dstack(
        [*np.meshgrid((np.arange(320) - 159.5) / 260.0, (np.arange(240) - 119.5) / 260.0), np.ones((240, 320))]
    )
    depth = np.full((240, 320), np.inf)
    for normal, offset in (((0.0, -1.0, 0.0), -1.2), ((-0.6, 0.0, -0.8), -3.0), ((0.8, 0.0, -0.6), -3.5)):
        along = rays @ turn.apply(normal)
        with np.errstate(divide="ignore"):
            z = offset / along
        depth = np.where((z > 0) & (z < depth), z, depth)
    return flat_frame(np.where(np.isfinite(depth) & (depth < 8), depth * random.normal(1, 0.002, depth.shape), 0.0))


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize("roll_deg", [-20, 12])
@pytest.mark.parametrize("pitch_deg", [35, -10])
def test_a_room_tells_its_up_direction_whatever_the_tilt(roll_deg: int, pitch_deg: int):
    turn = Rotation.from_euler("xz", [pitch_deg, roll_deg], degrees=True)
    up = turn.apply(LEVEL)
    found = estimate_up(planes_frame(up))
    assert found is not None
    assert degrees(found.up, up) < 0.5
    assert found.certainty > LEAST_CERTAINTY


@pytest.mark.parametrize("points", [None, 0, 40, 3000])
def test_one_wall_alone_and_points_without_planes_are_refused(points: int | None):
    frame = flat_frame(np.random.default_rng(0).normal(2, 0.004, (240, 320)))
    if points is not None:
        xyz = np.random.default_rng(1).normal((0, 0, 4), 1, (points, 3)).astype(np.float32)
        frame = replace(frame, cloud=PointCloud(xyz), depth_m=None)
    found = estimate_up(frame)
    assert found is None or found.certainty < LEAST_CERTAINTY


def test_a_cloud_without_a_depth_image_tells_as_well():
    up = Rotation.from_euler("x", -15, degrees=True).apply(LEVEL)
    frame = planes_frame(up)
    keep = np.arange(0, len(frame.cloud), 7)
    bare = replace(frame, cloud=PointCloud(frame.cloud.xyz_m[keep]), depth_m=None)
    found = estimate_up(bare)
    assert found is not None
    assert degrees(found.up, up) < 1


def test_generated_arrangements_are_right_or_refused():
    checked = 0
    for seed in range(10, 16):
        frame = snapshot(seed, 7).frame
        found = estimate_up(replace(frame, up=None))
        if found is not None and found.certainty >= LEAST_CERTAINTY:
            assert frame.up is not None
            assert degrees(found.up, frame.up) < 2, seed
            checked += 1
    assert checked >= 4


def estimate(degrees_off: float, certainty: float = 0.9) -> UpEstimate:
    return UpEstimate(Rotation.from_euler("x", degrees_off, degrees=True).apply(LEVEL), certainty, 0.3, 0.3)


def test_frames_that_agree_give_one_direction():
    agreed = agreed_up([estimate(0.0), estimate(1.0), estimate(2.0), None, estimate(70.0, 0.1)])
    assert agreed.up is not None
    assert degrees(np.array(agreed.up), estimate(1.0).up) < 0.1
    assert (agreed.frames, agreed.agreeing) == (5, 3)
    assert np.degrees(agreed.spread_rad) == pytest.approx(1, abs=0.1)


def test_a_camera_that_turns_has_no_direction():
    agreed = agreed_up([estimate(float(angle)) for angle in (0, 10, 20, 30)])
    assert agreed.up is None
    assert "30 degrees" in agreed.reason


UP = np.array([0.0, 0.0, 1.0])


def corner(rng: np.random.Generator, points: int = 400) -> np.ndarray:
    """Points on three faces of a box without symmetries, as a sensor sees them."""
    xyz = rng.uniform(-0.5, 0.5, (points, 3))
    face = rng.integers(0, 3, points)
    xyz[np.arange(points), face] = 0.5
    return np.asarray(xyz * [1.0, 0.6, 1.6])


def pose_error(pose: tuple[np.ndarray, np.ndarray], turn: np.ndarray, shift: np.ndarray) -> tuple[float, float]:
    return float(Rotation.from_matrix(pose[0].T @ turn).magnitude()), float(np.linalg.norm(pose[1] - shift))


@given(
    st.integers(0, 20),
    st.floats(-0.15, 0.15),
    st.tuples(*[st.floats(-0.08, 0.08)] * 3),
    st.sampled_from([None, UP]),
)
def test_a_small_motion_is_found(
    seed: int, angle: float, shift: tuple[float, float, float], up: np.ndarray | None
) -> None:
    points = corner(np.random.default_rng(seed))
    turn, moved = Rotation.from_rotvec(angle * UP).as_matrix(), np.array(shift)
    pose = register(points, KDTree(points @ turn.T + moved), (np.eye(3), np.zeros(3)), 0.35, up)
    assert pose is not None
    turned_by, moved_by = pose_error(pose, turn, moved)
    assert turned_by < 0.03
    assert moved_by < 0.03


def test_other_objects_and_hidden_parts_do_no_harm() -> None:
    rng = np.random.default_rng(3)
    points = corner(rng)
    turn, shift = Rotation.from_rotvec(0.1 * UP).as_matrix(), np.array([0.08, -0.05, 0.02])
    visible = (points @ turn.T + shift)[points[:, 0] > -0.25]
    others = rng.uniform([0.9, -1.0, -1.0], [1.4, 1.0, 1.0], (500, 3))
    cloud = KDTree(np.concatenate([visible, others]))
    pose = register(points, cloud, (np.eye(3), np.zeros(3)), 0.35)
    assert pose is not None
    turned_by, moved_by = pose_error(pose, turn, shift)
    assert turned_by < 0.05
    assert moved_by < 0.05
    assert share_found(points, cloud, pose, 0.05) == pytest.approx(len(visible) / len(points), abs=0.1)


def test_with_a_vertical_the_rotation_stays_about_it() -> None:
    points = corner(np.random.default_rng(4))
    turn = Rotation.from_rotvec([0.1, 0.0, 0.1]).as_matrix()
    pose = register(points, KDTree(points @ turn.T), (np.eye(3), np.zeros(3)), 0.35, UP)
    assert pose is not None
    np.testing.assert_allclose(pose[0] @ UP, UP, atol=1e-12)


def test_points_without_a_cloud_nearby_have_no_pose() -> None:
    points = corner(np.random.default_rng(6))
    assert register(points, KDTree(points + 5.0), (np.eye(3), np.zeros(3)), 0.35) is None
    assert share_found(points, KDTree(points + 5.0), (np.eye(3), np.zeros(3)), 0.05) == 0.0


def test_a_surface_that_turns_is_turned_all_the_way_by_planes() -> None:
    """Points that come into view pull the nearest points back; planes let the surface slide along itself."""
    rng = np.random.default_rng(0)
    angles, heights = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(-0.5, 0.5, 6000)
    xyz = np.stack([0.3 * np.cos(angles), 0.2 * np.sin(angles), heights], axis=1)
    normals = np.stack([np.cos(angles) / 0.3, np.sin(angles) / 0.2, np.zeros(6000)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turn = Rotation.from_rotvec(0.2 * UP).as_matrix()
    before, after = normals[:, 1] < 0, (normals @ turn.T)[:, 1] < 0
    cloud, around = xyz[after] @ turn.T, normals[after] @ turn.T
    start = (np.eye(3), cloud.mean(axis=0) - xyz[before].mean(axis=0))
    by_points = register(xyz[before], KDTree(cloud), start, 0.1, UP)
    by_planes = register_surface(xyz[before], KDTree(cloud), around, start, 0.1, UP)
    assert by_points is not None and by_planes is not None
    error = pose_error(by_planes, turn, np.zeros(3))
    assert error[0] < 0.02 and error[1] < 0.01
    assert error[0] < 0.2 * pose_error(by_points, turn, np.zeros(3))[0]


@pytest.mark.parametrize("up", [None, UP])
def test_points_on_a_line_have_no_planes_to_register_with(up: np.ndarray | None) -> None:
    line = np.linspace(0, 1, 200)[:, None] * [0.3, 0.2, 1.0] + [0.0, 0.0, 2.0]
    normals = normals_knn(line).astype(np.float64)
    assert not normals.any()
    assert register_surface(line + 0.01, KDTree(line), normals, (np.eye(3), np.zeros(3)), 0.1, up) is None
