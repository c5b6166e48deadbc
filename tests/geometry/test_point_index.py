"""Queries of the index give the same points as a search of the whole cloud."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import contains
from annotator.geometry.point_index import PointIndex
from annotator.types import OrientedBox


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.floats(-0.1, 0.3), st.floats(0.01, 20))
def test_the_index_finds_the_same_points_as_a_full_search(seed: int, margin_m: float, size: float) -> None:
    rng = np.random.default_rng(seed)
    xyz = (rng.normal(size=(rng.integers(1, 400), 3)) * [1, 3, 9]).astype(np.float32)
    sides = size * rng.uniform(0.2, 1, 3)
    box = OrientedBox.from_parts(xyz[0].astype(np.float64), Rotation.random(rng=rng).as_matrix(), sides)
    index = PointIndex.of(xyz)
    wanted = np.flatnonzero(contains(box, xyz, margin_m))
    assert sorted(index.inside(box, margin_m).tolist()) == wanted.tolist()
    assert index.count(box, margin_m) == len(wanted)


def test_the_index_of_an_empty_cloud_finds_nothing() -> None:
    index = PointIndex.of(np.zeros((0, 3), np.float32))
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.ones(3))
    assert index.count(box) == 0
    assert len(index.inside(box)) == 0
