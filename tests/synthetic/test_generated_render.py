"""Geometry of generated scenes: meshes, rays, silhouettes, boxes and sensor noise, compared with closed forms."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.oriented_box import contains
from annotator.synthetic.arrangements import Actor
from annotator.synthetic.materials import Lights, Material, Palette
from annotator.synthetic.mesh import Mesh, Parts, box_mesh, joined
from annotator.synthetic.people import pacing
from annotator.synthetic.render import Rendering, Sensor, depth_image, render, whole_px
from annotator.types import Camera

CAMERA = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
LEVEL = RigidTransform.identity()  # the camera frame is the world frame
RED, WHITE = Material((0.8, 0.1, 0.1), grain=0.0), Material((0.9, 0.9, 0.9), grain=0.0)
LIGHTS = Lights((0.0, -3.0, 1.0))


def palette() -> Palette:
    made = Palette()
    for material in (RED, WHITE):
        made.add(material)
    return made


def ball(
    center: tuple[float | int, float | int, float | int], radius: float, track: int = 1, power: float = 2.0
) -> Mesh:
    blobs = Parts()
    blobs.ball(np.array(center, float), (radius, radius, radius), 0, power=power)
    return blobs.mesh().tracked(track)


WALL = box_mesh((0, 0, 3.5), (20, 20, 1), 1)


def rendered(mesh: Mesh) -> Rendering:
    """A mesh in front of the wall."""
    return render(CAMERA, LEVEL, joined([WALL, mesh]), palette(), LIGHTS)


def test_the_depth_agrees_with_the_plane_and_the_sphere():
    rendering = rendered(ball((0, 0, 2.0), 0.5))
    seen = rendering.track == 1
    np.testing.assert_allclose(rendering.depth_m[~seen], 3.0, atol=1e-5)
    # a ray meets the sphere |x - c| = r at the smaller root
    v, u = np.nonzero(seen)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))], axis=1)
    square, middle = (rays**2).sum(axis=1), rays[:, 2] * 2.0
    root = np.maximum(middle**2 - square * (4 - 0.25), 0)
    exact = (middle - np.sqrt(root)) / square
    assert np.median(np.abs(rendering.depth_m[seen] - exact)) < 0.01  # the mesh has flat facets
    outline = np.hypot(v - CAMERA.cy, u - CAMERA.cx).max()
    assert outline == pytest.approx(80 * 0.5 / np.sqrt(4 - 0.25), abs=1.0)


def test_an_actors_box_touches_its_surface_on_all_six_sides():
    axes = Rotation.from_euler("xyz", [0.3, -0.5, 1.1]).as_matrix()
    mesh = joined([ball((0.2, 0.1, 2.0), 0.3, power=4), ball((-0.3, 0.2, 2.4), 0.2)])
    T_camera_world = RigidTransform.from_components([0.1, -0.2, 0.3], Rotation.from_euler("y", 0.4))
    box = Actor(1, "thing", mesh, axes).box(T_camera_world)
    in_camera = T_camera_world.apply(mesh.vertices.astype(np.float64))
    assert contains(box, in_camera, 1e-6).all()
    local = box.T_camera_box.inv().apply(in_camera)
    np.testing.assert_allclose(local.max(axis=0), box.size_m / 2, atol=1e-6)
    np.testing.assert_allclose(local.min(axis=0), -box.size_m / 2, atol=1e-6)
    np.testing.assert_allclose(box.rotation, T_camera_world.rotation.as_matrix() @ axes, atol=1e-9)


@settings(deadline=None)
@given(st.floats(-0.4, 0.4), st.floats(-0.25, 0.25), st.floats(1.5, 2.2), st.floats(0.1, 0.3))
def test_the_whole_of_an_object_counts_what_is_hidden_and_what_is_outside(x: float, y: float, z: float, radius: float):
    mesh = ball((x, y, z), radius, power=3)
    seen = int((rendered(mesh).track == 1).sum())
    assert whole_px(CAMERA, LEVEL, mesh) == seen
    aside = ball((CAMERA.cx / CAMERA.fx * z, y, z), radius, power=3)  # half of it is beyond the image's border
    assert whole_px(CAMERA, LEVEL, aside) == pytest.approx(2 * (rendered(aside).track == 1).sum(), rel=0.25, abs=12)


@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_the_depth_noise_grows_with_the_square_of_the_distance(z: float):
    sensor = Sensor()
    ones = np.ones((200, 200), np.float32)
    plane = Rendering(np.zeros((200, 200, 3), np.uint8), z * ones, np.zeros((200, 200), np.int16), ones)
    measured = depth_image(plane, sensor, np.random.default_rng(0)).astype(float) / 1000
    valid = measured > 0
    assert 1 - valid.mean() == pytest.approx(sensor.dropout, abs=0.003)
    assert measured[valid].mean() == pytest.approx(z, abs=2e-4)
    assert measured[valid].std() == pytest.approx(0.0008 + 0.0009 * z**2, rel=0.1)


def test_people_pace_steadily_within_reach():
    walkers = list(islice(pacing(0.3, 3.0, 1.2, np.random.default_rng(5)), 300))
    places = np.array([walker.place for walker in walkers])
    assert np.ptp(places[:, 0]) > 1.0
    assert np.abs(places[:, 0]).max() < 1.3
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.25, "2.5 m/s"
    assert np.abs(np.diff([walker.yaw for walker in walkers])).max() < 0.27
