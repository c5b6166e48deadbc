"""The axes that a consensus step looks along: several at once, wide at first, then around the last fit."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from annotator.rcv.axes import UPRIGHT_SYMMETRIES, camera_frame, match_frames
from annotator.rcv.config import RcvConfig
from annotator.rcv.rotation_grid import spread_rotations, turns

DIAGONALS = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)


def wide_frames(up: Float64[np.ndarray, "3"] | None, config: RcvConfig) -> list[Float64[np.ndarray, "3 3"]]:
    """Frames spread over all orientations that a box can have: yaws of a quarter turn, or over SO(3)."""
    base = camera_frame(up)
    if up is not None:
        yaws = np.arange(config.consensus.upright_hypotheses) * (np.pi / 2 / config.consensus.upright_hypotheses)
        rotations = Rotation.from_rotvec(yaws[:, None] * up).as_matrix()
    else:
        rotations = spread_rotations(config.consensus.free_hypotheses)
    return _all_from_camera(base @ rotations.swapaxes(1, 2), up)


def near_frames(
    rotation: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None, config: RcvConfig
) -> list[Float64[np.ndarray, "3 3"]]:
    """Frames around a box rotation (columns = axes): its own, and others up to `refine_spread_rad` away.

    A fit learns little from more views along its own axes; views from beside them are what holds its rotation.
    """
    count, spread = config.consensus.refine_hypotheses, config.consensus.refine_spread_rad
    if up is not None:
        angles = np.linspace(-spread, spread, count) if count > 1 else np.zeros(1)
        offsets = angles[:, None] * up
    else:
        directions = _fibonacci_directions(max(count - 1, 1))
        offsets = np.concatenate([np.zeros((1, 3)), spread * directions])[:count]
    return _all_from_camera((Rotation.from_rotvec(offsets).as_matrix() @ rotation).swapaxes(1, 2), up)


def beside_frames(
    rotation: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None, step: int, config: RcvConfig
) -> list[Float64[np.ndarray, "3 3"]]:
    """Frames that hold a box by themselves, without a wide step before them, around a rotation that is nearly right.

    Along its own axes a box's width does not tell which way it is turned; turned about a diagonal, every axis of a view
    tells of two turns. So free boxes are looked at from about the diagonals, to the other side in the next step.

    Args:
        rotation: columns = box axes.
        step: number of the step, from 0.
    """
    if up is not None:
        return near_frames(rotation, up, config)
    count, spread = config.consensus.refine_hypotheses, config.warm.spread_rad
    side = 1.0 if step % 2 == 0 else -1.0
    return _all_from_camera((rotation @ turns(side * spread * _diagonals(count))).swapaxes(1, 2), up)


def _diagonals(count: int) -> Float64[np.ndarray, "k 3"]:
    """Unit vectors: four diagonals of a cube, no two opposite; directions spread evenly where more are asked for."""
    if count > len(DIAGONALS):
        return _fibonacci_directions(count)
    return DIAGONALS[:count]


def look_from_camera(
    frame: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None
) -> Float64[np.ndarray, "3 3"]:
    """A frame relabelled to look as nearly as possible along the camera's axes, level where `up` is given.

    Every object is then seen from the side that the sensor saw, and right way up, whatever its own axes are called.
    """
    return _all_from_camera(frame[None], up)[0]


def _all_from_camera(
    frames: Float64[np.ndarray, "k 3 3"], up: Float64[np.ndarray, "3"] | None
) -> list[Float64[np.ndarray, "3 3"]]:
    reference = camera_frame(up)
    matched = match_frames(frames, reference)
    return list(matched if up is None else match_frames(matched, reference, UPRIGHT_SYMMETRIES))


def _fibonacci_directions(count: int) -> Float64[np.ndarray, "k 3"]:
    """Unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5.0)) * index
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
