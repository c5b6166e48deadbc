"""The perfect detector."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.detection.perfect import PerfectDetector
from annotator.types import Camera, Frame, OrientedBox, PointCloud, PseudoView, Region, Truth

CAMERA = Camera(200, 160, 150.0, 150.0, 99.5, 79.5)


def make_box(center: tuple[float, float, float], size: tuple[float, float, float], turn: float = 0.4) -> OrientedBox:
    return OrientedBox.from_parts(
        np.array(center), Rotation.from_euler("yx", [turn, 0.2]).as_matrix(), np.array(size, np.float64)
    )


def fill(box: OrientedBox, n: int, seed: int = 0) -> np.ndarray:
    """Points spread evenly inside a box."""
    local = np.random.default_rng(seed).uniform(-0.49, 0.49, (n, 3)) * box.size_m
    return (local @ box.rotation.T + box.center_m).astype(np.float32)


def make_frame(truths: list[Truth], counts: list[int], key: str = "000001", camera: Camera = CAMERA) -> Frame:
    xyz = np.concatenate([fill(t.box, n, i) for i, (t, n) in enumerate(zip(truths, counts, strict=True))])
    rgb = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    return Frame(key, 0, camera, rgb, PointCloud(xyz))


def make_view(xyz: np.ndarray, size: tuple[int, int] = (120, 90), scale: float = 0.02) -> PseudoView:
    """A view along an oblique direction, centred on the points."""
    axes = Rotation.from_euler("zyx", [0.3, -0.5, 0.8]).as_matrix()
    middle = (xyz @ axes[:2].T).mean(axis=0)
    rgb = np.zeros((size[1], size[0], 3), np.uint8)
    return PseudoView(rgb, axes, scale, middle - (np.array(size) - 1) / 2 * scale, xyz)


NEAR = Truth("Car", make_box((0.0, 0.1, 3.0), (1.0, 0.6, 0.4)))
FAR = Truth("Van", make_box((1.0, -0.3, 5.0), (0.8, 0.8, 0.8), 1.1))


def test_view_box_spans_the_projected_corners() -> None:
    frame = make_frame([NEAR, FAR], [50, 30])
    view = make_view(frame.cloud.xyz_m, (300, 300), 0.02)
    car, van = PerfectDetector.for_frame(frame, [NEAR, FAR]).detect([view])[0]
    assert (car.label, van.label) == ("Car", "Van")  # most points first
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    for box, truth in ((car, NEAR), (van, FAR)):
        corners = truth.box.T_camera_box.apply(signs * truth.box.size_m / 2)
        along = corners @ view.axes[:2].T
        np.testing.assert_allclose(
            view.interval_m(box), np.stack([along.min(axis=0), along.max(axis=0)], axis=1), atol=1e-9
        )


@pytest.mark.parametrize(("drawn", "found"), [(0, 0), (2, 0), (4, 0), (5, 1), (50, 1)])
def test_objects_with_too_few_drawn_points_are_not_detected(drawn: int, found: int) -> None:
    frame = make_frame([NEAR], [50])
    rest = np.array([[9.0, 9.0, 9.0]], np.float32)
    view = make_view(np.concatenate([frame.cloud.xyz_m[:drawn], rest]), (900, 900), 0.05)
    assert len(PerfectDetector.for_frame(frame, [NEAR]).detect([view])[0]) == found


def test_boxes_on_a_region_are_those_of_the_image_shifted_and_clipped() -> None:
    frame = make_frame([NEAR, FAR], [50, 50])
    detector = PerfectDetector.for_frame(frame, [NEAR, FAR])
    whole = {box.label: box for box in detector.detect([frame])[0]}
    near = whole["Car"]
    x, y = int(near.x_min) + 3, max(int(near.y_min) - 4, 0)
    region = Region(frame, x, y, 200 - x, 160 - y)
    (on_region,) = detector.detect([region])
    shown = {box.label: box for box in on_region}["Car"]
    assert shown.xyxy == (-0.5, near.y_min - y, near.x_max - x, near.y_max - y)
    corner = Region(frame, 0, 0, 2, 2)
    assert detector.detect([corner]) == [[]]
