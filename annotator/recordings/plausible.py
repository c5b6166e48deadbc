"""What the numbers of a calibration can be: outside of it nothing is a camera or a place, and products overflow."""

from __future__ import annotations

import numpy as np

# Metres or pixels, whatever is written.
LARGEST = 1e9
SMALLEST_FOCAL_PX = 1e-3
# Wider or higher pictures than any camera's.
LARGEST_SIDE_PX = 1 << 16


def are_plausible(values: np.ndarray) -> bool:
    """True where all numbers are finite and none is out of all reason."""
    return bool((np.abs(values) <= LARGEST).all())


def is_pinhole(K: np.ndarray) -> bool:
    """True for `fx 0 cx / 0 fy cy / 0 0 1`, (3, 3), with focal lengths that a camera can have."""
    zeros = (K[0, 1], K[1, 0], K[2, 0], K[2, 1])
    return are_plausible(K) and not any(zeros) and bool(K[2, 2] == 1 and min(K[0, 0], K[1, 1]) >= SMALLEST_FOCAL_PX)


def is_rotation(R: np.ndarray, most_off: float) -> bool:
    """True for a matrix (3, 3) that turns: no element of `R R^T` is further than `most_off` from the unit matrix's."""
    return are_plausible(R) and bool(np.abs(R @ R.T - np.eye(3)).max() <= most_off and np.linalg.det(R) > 0)
