"""The common axis of boxes, and how alike they are turned about it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import common_axis


def standing(up: np.ndarray, turns: np.ndarray, lean_deg: float, seed: int) -> np.ndarray:
    """Boxes along an axis that lean by this much in all directions, with their axes in any order."""
    random = np.random.default_rng(seed)
    upright = Rotation.align_vectors(up[None], np.array([[0.0, 0.0, 1.0]]))[0]
    lean = Rotation.from_rotvec(random.normal(size=(len(turns), 3)) * np.radians(lean_deg) / np.sqrt(2))
    order = Rotation.create_group("O")[random.integers(24, size=len(turns))]
    return (lean * upright * Rotation.from_euler("z", turns[:, None]) * order).as_matrix()


@pytest.mark.parametrize("seed", range(4))
def test_the_axis_of_leaning_boxes_is_found(seed: int) -> None:
    random = np.random.default_rng(seed)
    up = random.normal(size=3)
    up /= np.linalg.norm(up)
    found = common_axis(standing(up, random.uniform(0, 2 * np.pi, 12), 6.0, seed))
    assert np.degrees(np.arccos(abs(found.axis @ up))) < 5
    assert np.degrees(found.spread_rad) < 15
    assert found.alike < 0.8


def test_boxes_that_do_not_turn_are_alike() -> None:
    turns = 0.3 + np.pi / 2 * np.arange(10)
    found = common_axis(standing(np.array([0.0, -1.0, 0.0]), turns, 1.0, 0))
    assert found.alike > 0.95


def test_boxes_in_all_directions_have_a_wide_spread() -> None:
    for seed in range(20):
        turned = Rotation.random(8, random_state=seed).as_matrix()
        assert np.degrees(common_axis(turned).spread_rad) > 20
