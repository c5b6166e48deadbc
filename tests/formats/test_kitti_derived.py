"""KITTI fields derived from a 3D box; tests/benchmarks/test_golden.py compares with the reference numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from annotator.formats.kitti_rows import derived_box, heading, heading_rotation, observation_angle
from annotator.types import Camera, OrientedBox

CAMERA = Camera(200, 100, 100.0, 100.0, 99.5, 49.5)


def box(x: float, z: float, size: float = 1.0) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, z]), heading_rotation(0.0), np.full(3, size))


def test_the_2d_box_of_a_centred_box_equals_the_one_by_hand() -> None:
    derived = derived_box(CAMERA, box(0.0, 5.5), None)
    assert derived is not None
    assert derived.clipped == derived.unclipped == pytest.approx((89.5, 39.5, 109.5, 59.5))
    assert derived.truncated == 0.0


def test_the_2d_box_is_shifted_with_the_colour_camera() -> None:
    beside = derived_box(CAMERA, box(0.0, 5.5), RigidTransform.from_translation([0.5, 0.0, 0.0]))
    assert beside is not None
    assert beside.clipped == pytest.approx((99.5, 39.5, 119.5, 59.5))


def test_truncation_is_the_fraction_outside_the_image() -> None:
    derived = derived_box(CAMERA, OrientedBox.from_parts(np.array([-0.995, 0, 1.0]), np.eye(3), np.full(3, 1e-3)), None)
    assert derived is not None
    assert derived.clipped[0] == 0.0
    assert derived.truncated == pytest.approx(0.5, abs=0.01)
    beside = derived_box(CAMERA, box(-50.0, 5.0), None)
    assert beside is not None
    assert beside.truncated == 1.0


def test_a_box_behind_the_camera_has_no_2d_box() -> None:
    assert derived_box(CAMERA, box(0.0, -5.0), None) is None
    around = derived_box(CAMERA, box(0.0, 0.0), None)
    assert around is not None
    assert around.clipped == (0.0, 0.0, 199.0, 99.0)


angles = st.floats(-3.14, 3.14)


@given(angles, angles)
def test_heading_and_observation_angle_are_recovered(rotation_y: float, direction: float) -> None:
    turned = OrientedBox.from_parts(np.zeros(3), heading_rotation(rotation_y), np.ones(3))
    assert heading(turned) == pytest.approx(rotation_y)
    alpha = observation_angle(rotation_y, math.sin(direction), math.cos(direction))
    assert -math.pi <= alpha <= math.pi
    assert math.remainder(alpha + direction - rotation_y, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
