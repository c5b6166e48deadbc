"""The visible parts of the edges of boxes on the image."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import EDGES, box_corners
from annotator.geometry.outline import PIECES_DISTORTED, box_on_image, heading_px, visible_edges
from annotator.geometry.projection import project
from annotator.types import Camera, OrientedBox

CAMERA = Camera(640, 480, 500.0, 510.0, 320.0, 235.0)
DISTORTED = Camera(640, 480, 500.0, 510.0, 320.0, 235.0, (-0.28, 0.09, 0.001, -0.0005, -0.012))


def box_at(x: float, y: float, z: float, size: float = 1.0, turn: float = 0.4) -> OrientedBox:
    rotation = Rotation.from_euler("xyz", [0.2, turn, -0.3]).as_matrix()
    return OrientedBox.from_parts(np.array([x, y, z]), rotation, np.array([size, 0.6 * size, 0.4 * size]))


def test_a_box_in_full_view_has_twelve_edges() -> None:
    box = box_at(0.1, 0.0, 4.0)
    (pieces,) = visible_edges(CAMERA, [box])
    px = project(CAMERA, box_corners(box))
    assert np.allclose(pieces, px[np.array(EDGES)], atol=1e-6)


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED])
@pytest.mark.parametrize(
    "place", [(0.0, 0.0, 3.0), (1.7, 0.2, 3.0), (-0.9, 0.8, 2.0), (0.0, 0.0, 0.4), (0.3, 0.1, 0.2)]
)
def test_the_visible_edges_stay_within_the_2d_box(camera: Camera, place: tuple[float, float, float]) -> None:
    box = box_at(*place)
    (pieces,) = visible_edges(camera, [box])
    spanned = box_on_image(camera, box, "x")
    assert spanned is not None
    inside = pieces.reshape(-1, 2).clip([-0.5, -0.5], [639.5, 479.5])
    # a face may extend beyond the visible edges, but no edge beyond the faces
    assert (inside.min(axis=0) >= np.array(spanned.xyxy[:2]) - 0.1).all()
    assert (inside.max(axis=0) <= np.array(spanned.xyxy[2:]) + 0.1).all()
    assert np.isfinite(pieces).all()


def test_invisible_boxes_have_no_edges_and_the_order_is_kept() -> None:
    behind, beside, shown = box_at(0, 0, -3.0), box_at(30.0, 0, 3.0), box_at(0, 0, 4.0)
    found = visible_edges(CAMERA, [behind, shown, beside])
    assert [len(pieces) for pieces in found] == [0, 12, 0]
    assert visible_edges(CAMERA, []) == []


def test_edges_are_curved_on_a_distorted_image() -> None:
    (pieces,) = visible_edges(DISTORTED, [box_at(0.6, 0.4, 2.5)])
    assert len(pieces) == 12 * PIECES_DISTORTED
    ends = pieces.reshape(12, PIECES_DISTORTED, 2, 2)
    assert np.allclose(ends[:, :-1, 1], ends[:, 1:, 0]), "the pieces of an edge are connected"


@pytest.mark.parametrize(
    ("yaw_deg", "tip_px", "along"),
    [
        # the box is 4 m away, 2 x 1 x 0.6 m: the arrow reaches 1 + 0.2 * 1.2 = 1.24 m from its centre
        (0.0, (500 * 1.24 / 4 + 320, 235), (1, 0)),
        (180.0, (-500 * 1.24 / 4 + 320, 235), (-1, 0)),
        (45.0, (500 * 0.8768 / (4 - 0.8768) + 320, 235), (1, 0)),
    ],
)
def test_the_heading_is_an_arrow_with_a_head_of_its_own_size(
    yaw_deg: float, tip_px: tuple[float, float], along: tuple[int, int]
) -> None:
    turn = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 4.0]), turn, np.array([2.0, 1.0, 0.6]))
    shaft, *head = heading_px(CAMERA, box, 10.0)
    np.testing.assert_allclose(shaft, [(320, 235), tip_px], atol=0.02)
    for line, side in zip(head, (-1, 1), strict=True):
        np.testing.assert_allclose(line[0], shaft[1], atol=1e-9)
        back = line[1] - line[0]
        assert np.linalg.norm(back) == pytest.approx(10)
        assert back @ np.array(along) == pytest.approx(-10 * np.cos(np.pi / 6))
        assert np.sign(back[1]) == -side * along[0]


def test_a_heading_that_reaches_behind_the_camera_has_no_arrow() -> None:
    to_camera = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    near = OrientedBox.from_parts(np.array([0.0, 0.0, 0.5]), to_camera, np.ones(3))
    np.testing.assert_allclose(near.rotation[:, 0], [0, 0, -1], atol=1e-12)
    assert heading_px(CAMERA, near, 10.0).shape == (0, 2, 2)
