"""What is no measurement in a depth image, for each type of number."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.geometry.projection import in_metres

INF, NAN = float("inf"), float("nan")
TABLE = [
    ("u2", [0, 1, 2000, 65503, 65504, 65535], [0, 1, 2000, 65503, 0, 0]),
    ("i2", [-1, 0, 2000, 32767, -32768], [0, 0, 2000, 0, 0]),
    ("i4", [-5, 2000, 65535, 70000, 2**31 - 1], [0, 2000, 0, 70000, 0]),
    ("f2", [-1, NAN, INF, 65504, 2000], [0, 0, 0, 0, 2000]),
    ("f4", [-INF, NAN, INF, -2, 65504, 65535, 2000.5], [0, 0, 0, 0, 0, 0, 2000.5]),
    ("f8", [NAN, 65535, 3], [0, 0, 3]),
]


@pytest.mark.parametrize("units_per_m", [1.0, 1000.0, 5000.0])
@pytest.mark.parametrize(("kind", "raw", "units"), TABLE)
def test_depths_in_metres(kind: str, raw: list[float], units: list[float], units_per_m: float):
    for order in "<>":
        depth_m = in_metres(np.array([raw], order + kind), units_per_m)
        np.testing.assert_array_equal(depth_m, np.array([units], np.float32) / np.float32(units_per_m))
        assert depth_m.dtype == np.float32
