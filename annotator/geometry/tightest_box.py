"""The box of least volume around points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import aligned_box
from annotator.types import OrientedBox

# The rotations of a grid that are refined, by turns of `FIRST_TURN_RAD` that are halved down to `LAST_TURN_RAD`.
STARTS = 8
FIRST_TURN_RAD, LAST_TURN_RAD = float(np.deg2rad(8)), 1e-3


def tightest_box(
    xyz_m: Float64[np.ndarray, "n 3"],
    rotations: Float64[np.ndarray, "k 3 3"],
    up: Float64[np.ndarray, "3"] | None = None,
) -> OrientedBox:
    """The box of least volume that contains all points, found by local search.

    Args:
        xyz_m: camera frame.
        rotations: where the search starts; columns = box axes.
        up: unit vector; if given, boxes turn about it only.
    """
    outer = _hull(xyz_m)
    best = rotations[np.argsort(_volumes(outer, rotations))[:STARTS]]
    turns = np.concatenate([np.eye(3), -np.eye(3)]) if up is None else np.stack([up, -up])
    refined = [_refined(outer, start, turns) for start in best]
    return aligned_box(outer, refined[int(np.argmin(_volumes(outer, np.stack(refined))))])


def _refined(
    outer: Float64[np.ndarray, "n 3"], rotation: Float64[np.ndarray, "3 3"], turns: Float64[np.ndarray, "t 3"]
) -> Float64[np.ndarray, "3 3"]:
    least, turn_rad = _volumes(outer, rotation[None])[0], FIRST_TURN_RAD
    while turn_rad > LAST_TURN_RAD:
        turned = Rotation.from_rotvec(turn_rad * turns).as_matrix() @ rotation
        volumes = _volumes(outer, turned)
        if volumes.min() < least:
            rotation, least = turned[int(volumes.argmin())], volumes.min()
        else:
            turn_rad /= 2
    return rotation


def _volumes(outer: Float64[np.ndarray, "n 3"], rotations: Float64[np.ndarray, "k 3 3"]) -> Float64[np.ndarray, "k"]:
    along = np.einsum("nd,kdi->kni", outer, rotations)
    return np.asarray(np.ptp(along, axis=1).prod(axis=1))


def _hull(xyz_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "h 3"]:
    """The corners of the convex hull; all points if they are too few or flat."""
    try:
        return xyz_m[ConvexHull(xyz_m).vertices]
    except (QhullError, ValueError):
        return xyz_m
