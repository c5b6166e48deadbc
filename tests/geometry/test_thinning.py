"""Thinning of point clouds."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from annotator.geometry.projection import thin


@given(st.integers(0, 5000), st.integers(1, 1000))
def test_thinning_keeps_the_given_number_of_points_in_order(n_points: int, most: int) -> None:
    keep = thin(n_points, most)
    if n_points <= most:
        assert keep is None
        return
    assert keep is not None
    assert len(keep) == most
    assert (np.diff(keep) > 0).all()
    assert keep[0] >= 0
    assert keep[-1] < n_points


def test_thinning_is_even_and_deterministic() -> None:
    keep = thin(1_000_000, 1000)
    assert keep is not None
    counts, _ = np.histogram(keep, bins=100, range=(0, 1_000_000))
    assert counts.min() >= 9
    assert counts.max() <= 11
    again = thin(1_000_000, 1000)
    assert again is not None
    np.testing.assert_array_equal(keep, again)
