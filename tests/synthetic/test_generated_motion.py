"""Motion of the generated people: continuous, and without collisions."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from annotator.synthetic.crowd import PERSONAL_SPACE_M, Zone, crowd_moments

ZONE = Zone(2.4, 4.5, 0.5, 0.3, ((-2.0, 3.0, -0.8, 4.0), (0.9, 4.2, 2.0, 5.0)))


@pytest.fixture(scope="module")
def walk() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Thirty seconds of four walkers at 10 Hz: places (t, n, 2), yaws (t, n), joints (t, n, k)."""
    moments = list(islice(crowd_moments(ZONE, 4, np.random.default_rng(5), 0.1), 300))
    places, yaws, joints = (
        [[getattr(w, n) for w in walkers] for walkers in moments] for n in ("place", "yaw", "joints")
    )
    return np.array(places), np.array(yaws), np.array(joints)


def test_people_avoid_each_other_and_the_furniture(walk: tuple[np.ndarray, ...]):
    places = walk[0]
    gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=3)
    gaps[:, np.arange(4), np.arange(4)] = np.inf
    assert gaps.min() > 0.6 * PERSONAL_SPACE_M
    assert np.percentile(gaps.min(axis=(1, 2)), 5) > 0.9 * PERSONAL_SPACE_M
    for x_min, y_min, x_max, y_max in ZONE.obstacles:
        x, y = places[..., 0], places[..., 1]
        assert not ((x > x_min) & (x < x_max) & (y > y_min) & (y < y_max)).any()


def test_motion_is_continuous(walk: tuple[np.ndarray, ...]):
    places, yaws, joints = walk
    assert np.linalg.norm(np.diff(places, axis=0), axis=2).max() < 0.25  # 2.5 m/s
    assert np.abs(np.diff(yaws, axis=0)).max() < 0.3
    assert np.abs(np.diff(joints, axis=0)).max() < 0.81
