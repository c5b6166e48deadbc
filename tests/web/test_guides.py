"""Grid, rings, axes and the named views of a scene."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.geometry.ground import Ground, find_ground
from annotator.types import Camera, Frame, OrientedBox, PointCloud
from annotator.web.viewport.guides import AXES_COLORS, Look, Stand, guide_lines, scene_reach_m, stand
from annotator.web.viewport.palette import PALETTES, Theme

DARK = PALETTES[Theme.DARK]
UP = np.array([0.0, -1.0, 0.0])
BOX = OrientedBox.from_parts(np.array([3.0, 1.0, 15.0]), np.array([[0.0, 0, -1], [0, -1, 0], [-1, 0, 0]]).T, np.ones(3))


@pytest.fixture(params=["lidar", "depth"])
def frame(request: pytest.FixtureRequest) -> Frame:
    """A street 1.5 m below the camera, to 40 m."""
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-20, 20, 9000), np.full(9000, 1.5), rng.uniform(-40, 40, 9000)])
    depth_m = np.ones((60, 120), np.float32) if request.param == "depth" else None
    camera = Camera(120, 60, 100.0, 100.0, 59.5, 29.5)
    return Frame("0", 0, camera, np.zeros((60, 120, 3), np.uint8), PointCloud(xyz.astype(np.float32)), depth_m)


@pytest.fixture
def ground(frame: Frame) -> Ground:
    return find_ground(frame.cloud.xyz_m, UP)


def test_the_grid_lies_on_the_ground_and_a_lidar_has_rings_around_it(frame: Frame, ground: Ground) -> None:
    lines, colors = guide_lines(frame, ground, scene_reach_m(frame), DARK)
    assert lines.shape == colors.shape and np.isfinite(lines).all()
    grid = lines[(colors == colors[0, 0]).all(axis=(1, 2))]
    np.testing.assert_allclose(grid[..., 1], 1.5, atol=1e-3)
    steps = np.unique(np.diff(np.unique(grid[:, 0, 0].round(3))).round(3))
    assert steps.tolist() == [5.0]
    # nothing is behind a depth camera
    assert (grid[..., 2].min() < -30) == (frame.depth_m is None)
    rings = lines[(colors == DARK.rings).all(axis=(1, 2))]
    assert (len(rings) > 0) == (frame.depth_m is None)
    if len(rings):
        radius = np.linalg.norm(rings[:72, :, [0, 2]], axis=2)
        np.testing.assert_allclose(radius, 10.0, atol=1e-3)
    # the up axis points up, from the ground below the camera
    up_line = lines[(colors == AXES_COLORS[2]).all(axis=(1, 2))][0]
    np.testing.assert_allclose(up_line[0], [0, 1.5, 0], atol=1e-3)
    assert up_line[1, 1] < 0.5 and abs(up_line[1, [0, 2]]).max() < 1e-6


def test_named_views_look_from_where_their_names_say(frame: Frame, ground: Ground) -> None:
    def seen(look: Look, box: OrientedBox | None = None) -> Stand:
        found = stand(look, frame, ground, box, np.array([0.0, 0.0, 1.0]), 2.0)
        assert found is not None
        return found

    def gaze(of: Stand) -> np.ndarray:
        along = of.look_at_m - of.position_m
        return along / np.linalg.norm(along)

    # of the scene: it is seen by somebody who stands behind the camera, or to its left
    np.testing.assert_allclose(gaze(seen(Look.TOP)), [0, 1, 0], atol=2e-3)
    np.testing.assert_allclose(gaze(seen(Look.FRONT)), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(gaze(seen(Look.SIDE)), [1, 0, 0], atol=1e-9)
    start = seen(Look.START)
    assert start.position_m[2] < 0 < start.position_m @ UP, "behind the camera and above it"
    camera = seen(Look.CAMERA)
    np.testing.assert_array_equal(camera.position_m, 0)
    assert camera.fov_rad == pytest.approx(2 * np.arctan(0.3)), "the image fills a view of its own aspect"
    for look in (Look.BEHIND, Look.FOCUS):
        assert stand(look, frame, ground, None, np.array([0.0, 0.0, 1.0]), 2.0) is None
    # of a box that faces the camera's right-hand side
    heading = BOX.rotation[:, 0]
    for look, along in ((Look.TOP, -UP), (Look.FRONT, -heading), (Look.BEHIND, heading)):
        found = seen(look, BOX)
        np.testing.assert_array_equal(found.look_at_m, BOX.center_m)
        assert gaze(found) @ along > (0.9 if look is Look.BEHIND else 0.999)
    left = np.cross(UP, heading)
    np.testing.assert_allclose(gaze(seen(Look.SIDE, BOX)), -left, atol=1e-9)
    # the viewer goes to the box and looks in the same direction as before
    focus = seen(Look.FOCUS, BOX)
    np.testing.assert_allclose(gaze(focus), [0, 0, 1], atol=1e-9)
    assert 1 < np.linalg.norm(focus.position_m - BOX.center_m) < 5
