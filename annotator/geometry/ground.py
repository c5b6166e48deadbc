"""The ground below a scene, as heights on a grid: a floor, a road that climbs, a table top that fills the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy import ndimage

# Number of points for the grid.
SAMPLE = 20_000
# Cells of the grid along its longer side, and the smallest cell, metres.
CELLS, LEAST_CELL_M = 100, 0.05
# The grid covers the points between these percentiles along both of its axes.
LOW_PERCENT, HIGH_PERCENT = 0.5, 99.5
# The ground rises by at most this slope, over this number of cells; what stands on it is steeper.
SLOPE, REACH_CELLS = 0.15, 8
# The lowest points of a cell, without its outliers, are at this share of its heights.
LOW_SHARE = 0.05
# Ground of the scene's middle: that of this number of cells.
NEAREST_CELLS = 20
# Points up to this height belong to the ground: a share of the grid's side, for noise grows with distance; limits.
NOISE_SHARE, NOISE_M = 0.004, (0.03, 0.2)


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights of the ground along the up direction, on a grid across it.

    Attributes:
        axes: rows: ahead and left along the ground, and up; unit vectors, camera frame.
        low_m, high_m: the grid's corners along its first two axes.
        height_m: of each cell along `axes[2]`.
        level_m: the height below the camera.
        thickness_m: points up to this height above the ground belong to it.
    """

    axes: Float64[np.ndarray, "3 3"]
    low_m: Float64[np.ndarray, "2"]
    high_m: Float64[np.ndarray, "2"]
    height_m: Float32[np.ndarray, "rows columns"]
    level_m: float
    thickness_m: float

    def above_m(self, xyz_m: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n"]:
        """The height of each point (camera frame) above the ground below it, metres."""
        ahead, left, up = (xyz_m @ self.axes.T.astype(np.float32)).T
        rows, columns = _cells(ahead, left, self.low_m, self.high_m, self.height_m.shape)
        return up - self.height_m[rows, columns]


def ground_axes(up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Ahead (the camera's viewing direction, or its upper edge if that is upright), left and up; rows, camera frame."""
    ahead = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([0.0, -1.0, 0.0])
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead), up])


def find_ground(xyz_m: Float32[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"]) -> Ground:
    """The ground below points: their lower envelope, which rises no faster than a road.

    Args:
        up: unit vector against gravity, camera frame.
    """
    axes = ground_axes(up)
    if len(xyz_m) == 0:
        return Ground(axes, np.zeros(2), np.ones(2), np.zeros((1, 1), np.float32), 0.0, NOISE_M[0])
    some = xyz_m[:: max(1, len(xyz_m) // SAMPLE)]
    ahead, left, height = (some @ axes.T.astype(np.float32)).T
    low, high = np.percentile(np.stack([ahead, left]), [LOW_PERCENT, HIGH_PERCENT], axis=1)
    cell_m = max(float((high - low).max()) / CELLS, LEAST_CELL_M)
    shape = tuple((np.ceil((high - low) / cell_m).astype(int) + 1).tolist())
    high = low + np.array(shape) * cell_m
    rows, columns = _cells(ahead, left, low, high, shape)
    lowest = np.full(shape, np.inf, np.float32)
    cell = rows * shape[1] + columns
    order = np.lexsort([height, cell])
    seen, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    lowest.reshape(-1)[seen] = height[order][first + (LOW_SHARE * count).astype(int)]
    # one or two cells that are lower than all around them are echoes from below the ground
    lowest = np.maximum(lowest, ndimage.rank_filter(lowest, 2, 3, mode="constant", cval=np.inf))
    distance = np.hypot(*np.ogrid[-REACH_CELLS : REACH_CELLS + 1, -REACH_CELLS : REACH_CELLS + 1])
    rise = SLOPE * cell_m * distance
    ground = ndimage.grey_erosion(lowest, structure=-rise, mode="nearest").astype(np.float32)
    known = np.argwhere(np.isfinite(ground))
    if not len(known):
        ground[:], known = np.float32(height.min()), np.zeros((1, 2), int)
    nearest = known[np.argsort(np.linalg.norm(low + (known + 0.5) * cell_m, axis=1))[:NEAREST_CELLS]]
    level_m = float(np.median(ground[tuple(nearest.T)]))
    ground[~np.isfinite(ground)] = level_m
    thickness_m = float(np.clip(NOISE_SHARE * cell_m * CELLS, *NOISE_M))
    return Ground(axes, low, high, ground, level_m, thickness_m)


def _cells(
    ahead: Float32[np.ndarray, "n"],
    left: Float32[np.ndarray, "n"],
    low_m: Float64[np.ndarray, "2"],
    high_m: Float64[np.ndarray, "2"],
    shape: tuple[int, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """The cell of each point; points beside the grid belong to its border."""
    share = (np.array(shape) / (high_m - low_m)).astype(np.float32)
    rows, columns = (
        np.clip(((along - np.float32(low_m[i])) * share[i]).astype(np.int64), 0, shape[i] - 1)
        for i, along in enumerate((ahead, left))
    )
    return rows, columns
