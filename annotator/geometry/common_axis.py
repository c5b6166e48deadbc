"""The axis that many boxes share, about which they turn: of upright boxes, the vertical."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

# Steps in which an axis moves to the mean of the boxes' nearest axes.
MEAN_STEPS = 5
# Share of the boxes within `CommonAxis.spread_rad`.
WITHIN = 0.9


@dataclass(frozen=True, eq=False)
class CommonAxis:
    """An axis that is near to an axis of most boxes.

    Attributes:
        axis: unit vector (3,); its sign has no meaning.
        spread_rad: nine of ten boxes have an axis within this angle of it.
        alike: how alike the boxes' headings about the axis are, modulo a quarter turn: 0 = all headings, 1 = one.
    """

    axis: Float64[np.ndarray, "3"]
    spread_rad: float
    alike: float


def common_axis(rotations: Float64[np.ndarray, "n 3 3"]) -> CommonAxis:
    """The axis with the smallest spread, among those that start from an axis of a box.

    Args:
        rotations: of at least one box; the columns are its axes.
    """
    best, spread = rotations[0, :, 0], np.inf
    for axis in rotations.transpose(0, 2, 1).reshape(-1, 3):
        for _ in range(MEAN_STEPS):
            axis = _nearest(rotations, axis).mean(axis=0)
            axis = axis / np.linalg.norm(axis)
        angles = np.arccos(np.clip((_nearest(rotations, axis) * axis).sum(axis=1), -1, 1))
        if (reached := float(np.quantile(angles, WITHIN))) < spread:
            best, spread = axis, reached
    return CommonAxis(best, spread, _alike(rotations, best))


def _nearest(rotations: Float64[np.ndarray, "n 3 3"], axis: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "n 3"]:
    """The axis of each box that is nearest to the given one, with its sign."""
    each, along = np.arange(len(rotations)), axis @ rotations
    nearest = np.abs(along).argmax(axis=1)
    return np.asarray(rotations[each, :, nearest] * np.sign(along[each, nearest])[:, None])


def _alike(rotations: Float64[np.ndarray, "n 3 3"], axis: Float64[np.ndarray, "3"]) -> float:
    """Length of the mean of the headings' unit vectors (mean resultant length; Mardia and Jupp, Directional Statistics,
    2000), of four times the heading, since a box looks the same after a quarter turn."""
    x = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    y = np.cross(axis, x)
    across = (np.abs(axis @ rotations).argmax(axis=1) + 1) % 3
    side = rotations[np.arange(len(rotations)), :, across]
    return float(np.abs(np.exp(4j * np.arctan2(side @ y, side @ x)).mean()))
