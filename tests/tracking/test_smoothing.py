"""Smoothing of the boxes of an object, and interpolation between two known boxes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.tracking.link import TrackingConfig
from annotator.tracking.smooth import FLIP, TrackBox, are_upright, between, relabelled, relabellings, smoothed
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

CONFIG = TrackingConfig()
# columns: the length, width and height axes of an upright box that faces away from the camera
STANDING = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def car(n: float, yaw_deg: float = 0.0, size_m: tuple[float, float, float] = (4.2, 1.8, 1.5)) -> OrientedBox:
    """A car that drives away, rotated about its up axis."""
    turn = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    return OrientedBox.from_parts(np.array([1.0, 0.8, 8.0 + 0.6 * n]), STANDING @ turn, np.array(size_m))


def heading(box: OrientedBox) -> np.ndarray:
    return box.rotation[:, 0]


def test_flipped_headings_are_corrected_by_the_motion() -> None:
    rng = np.random.default_rng(3)
    true = [car(n, 2.0 * n) for n in range(12)]
    noisy = []
    for box in true:
        size = box.size_m * (1 + 0.05 * rng.standard_normal(3))
        turn = Rotation.from_rotvec([0, 0, 0.03 * rng.standard_normal()]).as_matrix()
        found = OrientedBox.from_parts(box.center_m, box.rotation @ turn, size)
        noisy.append(relabelled(found, FLIP) if rng.random() < 0.7 else found)
    assert sum(heading(box) @ heading(own) < 0 for box, own in zip(noisy, true, strict=True)) > 6
    better = smoothed([TrackBox(float(n), box) for n, box in enumerate(noisy)], CONFIG)
    assert all(heading(box) @ heading(own) > 0.99 for box, own in zip(better, true, strict=True))
    assert len({tuple(box.size_m) for box in better}) == 1
    driven = smoothed([TrackBox(float(n), box) for n, box in enumerate(noisy)], CONFIG, is_still=False)
    assert all(heading(box) @ heading(own) < -0.99 for box, own in zip(driven, true, strict=True)), "the majority"
    before, after = (np.mean([iou_3d(b, t) for b, t in zip(boxes, true, strict=True)]) for boxes in (noisy, better))
    assert after > before + 0.02


def test_a_size_that_changes_over_time_is_not_averaged() -> None:
    strides = [0.7 + 0.3 * np.sin(0.5 * n) for n in range(20)]
    boxes = [car(0.1 * n, 0.0, (2.0, length, 1.5 + 0.02 * (-1) ** n)) for n, length in enumerate(strides)]
    better = smoothed([TrackBox(float(n), box) for n, box in enumerate(boxes)], CONFIG)
    # a constant length would have a mean error of 0.19
    assert np.mean(np.abs(np.array([box.size_m[1] for box in better]) - strides)) < 0.04
    assert len({box.size_m[2] for box in better}) == 1, "a size with independent noise becomes constant"


def test_without_motion_the_majority_determines_the_front() -> None:
    still = [OrientedBox.from_parts(car(0).center_m, STANDING, np.array([4.2, 1.8, 1.5]))] * 7
    mixed = [relabelled(box, FLIP) if n in (1, 4) else box for n, box in enumerate(still)]
    better = smoothed([TrackBox(float(n), box) for n, box in enumerate(mixed)], CONFIG)
    assert all(heading(box) @ heading(still[0]) > 0.999 for box in better)


def test_reviewed_boxes_are_kept_and_set_the_heading_of_the_others() -> None:
    # a reviewed box says that the car drives backwards
    boxes = [car(n, 0.0, (4.0 + 0.1 * n, 1.8, 1.5)) for n in range(6)]
    fixed = relabelled(car(3, 0.0, (4.1, 1.7, 1.5)), FLIP)
    track = [TrackBox(float(n), fixed if n == 3 else box, is_fixed=n == 3) for n, box in enumerate(boxes)]
    better = smoothed(track, CONFIG)
    assert better[3] is fixed
    assert all(heading(box) @ heading(fixed) > 0.999 for box in better)
    assert all(box.size_m[1] == pytest.approx(1.8) and 4.0 <= box.size_m[0] <= 4.2 for box in better[:3])


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(0, 23), min_size=5, max_size=5), st.integers(0, 2**31))
def test_permuted_axes_have_no_effect(places: list[int], seed: int) -> None:
    """A freely rotating box with a random permutation of its axes in each frame."""
    start = Rotation.random(rng=np.random.default_rng(seed))
    turns = [start * Rotation.from_rotvec([0.05 * n, 0.08 * n, 0.0]) for n in range(5)]
    true = [OrientedBox.from_parts(np.ones(3), turn.as_matrix(), np.array([0.2, 0.1, 0.05])) for turn in turns]
    other = [relabelled(box, relabellings(False)[place]) for box, place in zip(true, places, strict=True)]
    better = smoothed([TrackBox(float(n), box) for n, box in enumerate(other)], CONFIG)
    # a uniform rotation is not treated as noise, and every box keeps its position
    assert min(iou_3d(a, b) for a, b in zip(better, true, strict=True)) > 0.999
    turned = [(a.T_camera_box.rotation.inv() * b.T_camera_box.rotation).magnitude() for a, b in pairwise(better)]
    assert max(turned) < 0.12


def test_relabelled_boxes_are_the_same_boxes() -> None:
    box = car(0, 20.0)
    for is_upright in (True, False):
        changes = relabellings(is_upright)
        assert np.array_equal(changes[0], np.eye(3))
        assert len({change.tobytes() for change in changes + 0.0}) == (4 if is_upright else 24)
        assert all(iou_3d(relabelled(box, change), box) == pytest.approx(1.0) for change in changes)
    assert are_upright([box, car(1, 200.0)])
    assert not are_upright([box, relabelled(box, relabellings(False)[5])])


def test_position_size_and_rotation_are_interpolated_linearly() -> None:
    first, last = car(0, 0.0), relabelled(car(10, 40.0, (4.6, 1.8, 1.5)), FLIP)
    found = between(first, last, 2.0, 12.0, [4.5, 7.0, 9.5])
    assert np.allclose([box.center_m for box in found], [car(n).center_m for n in (2.5, 5, 7.5)])
    assert np.allclose([box.size_m[0] for box in found], [4.3, 4.4, 4.5])
    assert all(
        iou_3d(box, car(n, 4.0 * n, (4.2 + 0.04 * n, 1.8, 1.5))) > 0.999
        for box, n in zip(found, (2.5, 5, 7.5), strict=True)
    )
    with pytest.raises(GeometryError, match="between the two"):
        between(first, last, 2.0, 12.0, [12.0])
