"""Numbers of points between pairs of planes, compared with masks."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.rcv.fit_kernels import count_within


def test_counts_agree_with_masks() -> None:
    rng = np.random.default_rng(0)
    for count in (0, 1, 1000):
        xyz = rng.normal(size=(count, 3)).astype(np.float32)
        axes = Rotation.random(rng=rng).as_matrix().astype(np.float32)
        low, high = rng.uniform(-2, 0, 3).astype(np.float32), rng.uniform(0, 2, 3).astype(np.float32)
        along = xyz.astype(np.float64) @ axes.T
        assert np.abs(along[:, None] - np.stack([low, high])).min(initial=1.0) > 1e-6
        x, y, z = ((along >= low) & (along <= high)).T
        expected = tuple(int(np.count_nonzero(mask)) for mask in (x & y & z, x & y, y & z))
        assert count_within(xyz, axes, low, high) == expected
        assert count < 1000 or min(expected) > 0
