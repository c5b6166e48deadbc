"""Normals of depth images and of unordered points."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_strategies import cameras, vectors
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from annotator.geometry.normals import normals_from_depth, normals_knn, px_per_ray
from annotator.geometry.projection import pixel_rays
from annotator.geometry.transforms import unit
from annotator.types import Camera
from annotator.types.errors import GeometryError

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


@pytest.mark.parametrize(
    ("points", "k", "message"), [(np.full((5, 3), np.nan), 16, "finite"), (np.ones((5, 3)), 2, "at least 3")]
)
def test_invalid_input_is_refused(points: np.ndarray, k: int, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        normals_knn(points, k)
