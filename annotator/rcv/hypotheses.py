"""The axis hypotheses of a consensus step: first spread widely, then close to the last fit.

*Axes* are a (3, 3) matrix with rows a1, a2, a3, as in `axes`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from annotator.rcv.axes import UPRIGHT_SYMMETRIES, camera_axes, match_all_axes
from annotator.rcv.config import RcvConfig
from annotator.rcv.rotation_search import rotation_matrices, spread_rotations

# Rivals share the hypotheses of a wide step, but each has at least this number, or all.
LEAST_SHARE = 4
DIAGONALS = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)


def wide_axes(
    up: Float64[np.ndarray, "3"] | None, config: RcvConfig, rivals: int = 1
) -> list[Float64[np.ndarray, "3 3"]]:
    """Axes spread over all orientations of a box: over a quarter turn of yaw with `up`, else over SO(3).

    Args:
        rivals: number of states of the same object that share the hypotheses.
    """
    base = camera_axes(up)
    count = config.consensus.free_hypotheses if up is None else config.consensus.upright_hypotheses
    count = min(count, max(count // rivals, LEAST_SHARE))
    if up is not None:
        yaws = np.arange(count) * (np.pi / 2 / count)
        rotations = Rotation.from_rotvec(yaws[:, None] * up).as_matrix()
    else:
        rotations = spread_rotations(count)
    return _all_facing_camera(base @ rotations.swapaxes(1, 2), up)


def near_axes(
    rotation: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None, config: RcvConfig
) -> list[Float64[np.ndarray, "3 3"]]:
    """The axes of a box rotation (columns = axes), and others up to `refine_spread_rad` away.

    More views along a box's own axes hardly improve a fit; views from slightly other directions determine its rotation.
    """
    count, spread = config.consensus.refine_hypotheses, config.consensus.refine_spread_rad
    if up is not None:
        angles = np.linspace(-spread, spread, count) if count > 1 else np.zeros(1)
        offsets = angles[:, None] * up
    else:
        directions = _fibonacci_directions(max(count - 1, 1))
        offsets = np.concatenate([np.zeros((1, 3)), spread * directions])[:count]
    return _all_facing_camera((Rotation.from_rotvec(offsets).as_matrix() @ rotation).swapaxes(1, 2), up)


def warm_axes(
    rotation: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None, step: int, config: RcvConfig
) -> list[Float64[np.ndarray, "3 3"]]:
    """Axes around a nearly correct rotation, which determine a box without a previous wide step.

    In views along a free box's own axes, its extent is the same for a small rotation in either direction. If a view is
    rotated about a diagonal, the extent along each of its axes depends on two rotations. So the hypotheses are rotated
    about the diagonals, and in the opposite direction in the next step. An upright box gets `near_axes`.

    Args:
        rotation: columns = box axes.
        step: number of the step, from 0.
    """
    if up is not None:
        return near_axes(rotation, up, config)
    count, spread = config.consensus.refine_hypotheses, config.warm.spread_rad
    sign = 1.0 if step % 2 == 0 else -1.0
    return _all_facing_camera((rotation @ rotation_matrices(sign * spread * _diagonals(count))).swapaxes(1, 2), up)


def _diagonals(count: int) -> Float64[np.ndarray, "k 3"]:
    """`count` unit vectors: up to four diagonals of a cube, no two opposite; evenly spread directions for more."""
    if count > len(DIAGONALS):
        return _fibonacci_directions(count)
    return DIAGONALS[:count]


def face_camera(axes: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None) -> Float64[np.ndarray, "3 3"]:
    """The relabelling of axes that is nearest to the camera's axes; level if `up` is given.

    Every object is then viewed from the sensor's side and the right way up, independent of the labelling of its axes.
    """
    return _all_facing_camera(axes[None], up)[0]


def _all_facing_camera(
    axes: Float64[np.ndarray, "k 3 3"], up: Float64[np.ndarray, "3"] | None
) -> list[Float64[np.ndarray, "3 3"]]:
    reference = camera_axes(up)
    matched = match_all_axes(axes, reference)
    return list(matched if up is None else match_all_axes(matched, reference, UPRIGHT_SYMMETRIES))


def _fibonacci_directions(count: int) -> Float64[np.ndarray, "k 3"]:
    """Unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5.0)) * index
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
