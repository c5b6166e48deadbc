"""Motion of the generated people and hands: continuous, without collisions, and with constant bone lengths."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from annotator.synthetic.crowd import PERSONAL_SPACE_M, Zone, crowd_moments
from annotator.synthetic.hands import Reach, hand_moments
from annotator.synthetic.materials import Palette
from annotator.synthetic.objects import HALF_WIDTH_M
from annotator.synthetic.scene import furnished_room

ZONE = Zone(2.4, 4.5, 0.5, 0.3, ((-2.0, 3.0, -0.8, 4.0), (0.9, 4.2, 2.0, 5.0)))


@pytest.fixture(scope="module")
def walk() -> tuple[np.ndarray, np.ndarray, np.ndarray, set[int]]:
    """Thirty seconds of four walkers at 10 Hz: places (t, n, 2), yaws (t, n), joints (t, n, k), gestures."""
    places, yaws, joints, gestures = [], [], [], set()
    for walkers in islice(crowd_moments(ZONE, 4, np.random.default_rng(5), 0.1), 300):
        places.append([walker.place for walker in walkers])
        yaws.append([walker.yaw for walker in walkers])
        joints.append([walker.joints for walker in walkers])
        gestures |= {walker.gesture for walker in walkers}
    return np.array(places), np.array(yaws), np.array(joints), gestures


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
    places, yaws, joints, _ = walk
    assert np.linalg.norm(np.diff(places, axis=0), axis=2).max() < 0.25  # 2.5 m/s
    assert np.abs(np.diff(yaws, axis=0)).max() < 0.3
    assert np.abs(np.diff(joints, axis=0)).max() < 0.81


def test_hands_move_smoothly_stay_apart_and_rotate_freely():
    reaches = [Reach((-0.17, -0.02), (1.5, 1.7), (1.1, 1.3)), Reach((0.02, 0.17), (1.5, 1.7), (1.1, 1.3))]
    moments = [
        (np.array([m.wrist_m for m in motions]), np.array([m.bend for m in motions]))
        for motions in islice(hand_moments(reaches, np.random.default_rng(1), 0.1), 300)
    ]
    wrists, bends = (np.array(part) for part in zip(*moments, strict=True))
    assert np.linalg.norm(np.diff(wrists, axis=0), axis=2).max() < 0.12
    assert np.linalg.norm(wrists[:, 0] - wrists[:, 1], axis=1).min() > 0.1
    backs = bends[:, :, :, 2].reshape(-1, 3)
    assert (backs[:, 2] > 0.5).any()
    assert (backs[:, 2] < -0.3).any()


@pytest.mark.parametrize("seed", range(3))
def test_every_room_has_space_for_people(seed: int):
    palette, random = Palette(), np.random.default_rng(seed)
    room = furnished_room(palette, random)
    zone = Zone(2.45, 4.5, 0.5, 0.3, room.obstacles)
    free = [zone.contains(np.array([x, y])) for x in np.linspace(-2, 2, 41) for y in np.linspace(2.4, 4.5, 22)]
    assert np.mean(free) > 0.25
    assert len(room.obstacles) == 6
    assert np.abs(room.mesh.vertices[:, 0]).max() < HALF_WIDTH_M + 0.2
    assert room.mesh.material.max() < len(palette.materials)
