"""Generated frames of any objects: their boxes hold the measured points, and equal seeds give equal frames."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.geometry.oriented_box import contains
from annotator.synthetic.snapshots import MIN_POINTS, Snapshot, snapshot

SEEDS = range(12)


@pytest.fixture(scope="module")
def snapshots() -> list[Snapshot]:
    return [snapshot(seed) for seed in SEEDS]


def test_the_boxes_hold_their_measured_points(snapshots: list[Snapshot]) -> None:
    objects = [(shot, item) for shot in snapshots for item in shot.objects]
    assert len(objects) > 2 * len(SEEDS)
    for shot, item in objects:
        assert item.points.sum() >= MIN_POINTS
        # the noise of a far depth measurement is the largest error
        distance_m = float(np.linalg.norm(item.box.center_m))
        margin_m = 0.05 + 0.01 * distance_m**2 if shot.frame.depth_m is not None else 0.15
        assert contains(item.box, shot.frame.cloud.xyz_m[item.points], margin_m).mean() > 0.95


def test_snapshots_come_from_depth_cameras_and_from_lidars(snapshots: list[Snapshot]) -> None:
    lidars = [shot for shot in snapshots if shot.frame.depth_m is None]
    assert 0 < len(lidars) < len(snapshots)
    for shot in snapshots:
        cloud = shot.frame.cloud
        assert (cloud.pixel_index is None) == (shot.frame.depth_m is None)
        assert np.linalg.norm(shot.frame.up) == pytest.approx(1)
    assert max(shot.frame.cloud.xyz_m[:, 2].max() for shot in lidars) > 20


def test_equal_seeds_give_equal_frames_and_other_versions_do_not(snapshots: list[Snapshot]) -> None:
    for seed in (0, 1, 2):
        again, other = snapshot(seed), snapshot(seed, version=2)
        assert np.array_equal(again.frame.cloud.xyz_m, snapshots[seed].frame.cloud.xyz_m)
        assert not np.array_equal(other.frame.cloud.xyz_m, snapshots[seed].frame.cloud.xyz_m)
