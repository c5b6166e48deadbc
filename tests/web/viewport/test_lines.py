"""Lines and poses in the scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import project
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import first_views
from annotator.recordings import open_recording
from annotator.types import Box2D, Camera, Frame, OrientedBox
from annotator.web.viewport.lines import arrow_lines, frustum_lines, placed_box_lines, view_placement
from annotator.workflows.recorded.reading import load_truth


@pytest.fixture(scope="module")
def frame(generated: Path) -> Frame:
    return open_recording(generated / "people").frame(0)


@pytest.fixture(scope="module")
def truth(generated: Path, frame: Frame) -> OrientedBox:
    return load_truth(open_recording(generated / "people"), 0, frame)[0].box


def test_a_box_is_drawn_as_its_edges_and_an_arrow_through_its_front(truth: OrientedBox) -> None:
    lines = placed_box_lines(truth)
    assert lines.shape == (21, 2, 3)
    corners = box_corners(truth)
    ends = lines[:12].reshape(-1, 3)
    nearest = np.linalg.norm(ends[:, None] - corners, axis=2)
    assert nearest.min(axis=1).max() < 1e-5
    np.testing.assert_array_equal(np.bincount(nearest.argmin(axis=1)), np.full(8, 3))
    # in the box's own axes: from the middle of the top; the head begins in front of the front face
    shaft, head = ((part - truth.center_m) @ truth.rotation for part in (lines[12], lines[13:]))
    mean_m, top_m, front_m = truth.size_m.mean(), truth.size_m[2] / 2, truth.size_m[0] / 2
    tip = [front_m + 0.4 * mean_m, 0, top_m]
    np.testing.assert_allclose(shaft, [[0, 0, top_m], tip], atol=1e-5)
    np.testing.assert_allclose(head[:4, 0], [tip] * 4, atol=1e-5)
    corners = head[:4, 1]
    np.testing.assert_allclose(corners[:, 0], front_m + 0.08 * mean_m, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(corners[:, 1:] - [0, top_m], axis=1), 0.13 * mean_m, atol=1e-5)
    np.testing.assert_allclose(head[4:], np.stack([corners, np.roll(corners, -1, axis=0)], axis=1), atol=1e-5)


@pytest.mark.parametrize("distortion", [(), (0.08, -0.1, 0.001, -0.002, 0.02)])
def test_the_frustum_projects_onto_the_image_box(frame: Frame, distortion: tuple[float, ...]) -> None:
    camera = frame.camera
    bent = Camera(camera.width_px, camera.height_px, camera.fx, camera.fy, camera.cx, camera.cy, distortion)
    seen = Frame("0", 0, bent, frame.rgb, frame.cloud)
    box = Box2D("person", 40.0, 30.0, 200.0, 180.0)
    lines = frustum_lines(seen, box)
    px = project(bent, lines[:4, 1])
    corners = np.array([[40, 30], [200, 30], [200, 180], [40, 180]])
    np.testing.assert_allclose(px, corners, atol=0.05)
    np.testing.assert_array_equal(lines[:4, 0], 0)
    border = project(bent, lines[4:, 0])
    on_edge = np.abs(border[:, [0, 0, 1, 1]] - [40, 200, 30, 180]).min(axis=1)
    assert on_edge.max() < 0.05


def test_an_arrow_has_its_head_on_the_shaft() -> None:
    start, end = np.array([0.3, -0.2, 1.0]), np.array([0.1, 0.9, 3.0])
    tip = start + 0.6 * (end - start)
    lines = arrow_lines(start, tip, end)
    np.testing.assert_allclose(lines[0], [start, end], atol=1e-6)
    head = lines[1:].reshape(-1, 3) - start
    share = head @ (end - start) / float((end - start) @ (end - start))
    # the head is a ring around the shaft, connected to the tip
    assert 0.4 < share.min() < share.max() == pytest.approx(0.6, abs=1e-6)
    ring = head[share < 0.59] - share.min() * (end - start)
    np.testing.assert_allclose(ring.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(ring, axis=1), np.linalg.norm(ring[0]), atol=1e-5)


def test_a_view_is_placed_in_front_of_its_points_with_each_pixel_in_place(frame: Frame, truth: OrientedBox) -> None:
    image_box = box_on_image(frame.camera, truth, "person")
    assert image_box is not None
    views = first_views(frame, image_box, RcvConfig())
    assert views is not None
    for view in views:
        place = view_placement(view)
        right, down, into = place.R_camera_view.T
        np.testing.assert_allclose([right, down, into], view.axes, atol=1e-12)
        assert (view.xyz_m @ into).min() > place.center_m @ into
        # the centre of pixel (0, 0), computed from the placement's size and from the view's origin
        height_px, width_px = view.rgb.shape[:2]
        half = 0.5 * place.size_m * (1 - 1 / np.array([width_px, height_px]))
        corner = place.center_m - half[0] * right - half[1] * down
        np.testing.assert_allclose([corner @ right, corner @ down], view.origin_m, atol=1e-9)
        along = place.looks_at_m - place.seen_from_m
        np.testing.assert_allclose(along / np.linalg.norm(along), into, atol=1e-9)
