"""An articulated hand as blobs, and its motion: smooth translation, free rotation and changing gestures.

Hand axes: origin at the wrist, x along the fingers, y towards the thumb, z out of the back of the hand. The left hand
is the mirror image in y. A *state* of a hand is an array: x, y, z of the wrist, metres, world frame; roll, flexion and
sideways bend relative to the forearm, radians; and its fingers, each 0..1: bending of index, middle, ring and little
finger (1 = fist), their spread, the thumb across the palm, the bending of the thumb.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from annotator.synthetic.mesh import Mesh, Parts, turn, xyz

# For each finger from index to little: knuckle x, y; the three bones' lengths; base radius; spread. Metres and radians,
# an adult's hand.
FINGERS = (
    (0.092, 0.028, (0.042, 0.026, 0.020), 0.0092, 0.16),
    (0.096, 0.008, (0.046, 0.030, 0.021), 0.0095, 0.04),
    (0.091, -0.012, (0.042, 0.028, 0.021), 0.0090, -0.08),
    (0.083, -0.030, (0.033, 0.020, 0.018), 0.0080, -0.22),
)
THUMB_BONES = (0.046, 0.036, 0.027)
# Bending angles of the joints of a finger in a full fist, and of the thumb, radians.
FINGER_BEND, THUMB_BEND = (1.45, 1.75, 1.1), (0.15, 0.7, 0.9)

# open, relaxed, fist, point, victory, thumb up, pinch, claw
GESTURES = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
        [0.25, 0.3, 0.33, 0.35, 0.3, 0.35, 0.2],
        [1.0, 1.0, 1.0, 1.0, 0.0, 0.95, 0.7],
        [0.0, 0.95, 1.0, 1.0, 0.2, 0.8, 0.6],
        [0.0, 0.0, 1.0, 1.0, 1.0, 0.9, 0.6],
        [0.95, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
        [0.55, 0.15, 0.15, 0.1, 0.7, 0.75, 0.45],
        [0.5, 0.5, 0.5, 0.5, 0.9, 0.3, 0.5],
    ]
)


def hand_mesh(fingers: Float64[np.ndarray, "7"], scale: float, skin: int, *, left: bool) -> Mesh:
    """The hand in hand coordinates, metres; `scale` 1 is an adult's hand of 0.19 m."""
    parts = Parts()
    *bends, spread, thumb, thumb_bend = fingers.tolist()
    for (x, y, bones, radius, aside), bend in zip(FINGERS, bends, strict=True):
        # the bone within the hand, visible as a tendon
        knuckle, wide = xyz(x, y, 0), (radius + 0.0035, radius + 0.002)
        parts.blob(xyz(0.006, 0.4 * y, 0), knuckle, (0.0135, 0.0125), skin, end_radii=wide, side=xyz(0, 1, 0))
        axes = turn("z", aside * spread * (1 - 0.7 * bend))
        _finger(parts, knuckle, axes, bones, radius, bend * np.array(FINGER_BEND), skin)
    parts.ball(xyz(0.052, 0, -0.003), (0.042, 0.034, 0.0125), skin, power=2.6)
    parts.ball(xyz(0.045, -0.024, -0.010), (0.034, 0.013, 0.011), skin)
    parts.ball(xyz(0.040, 0.023, -0.010 - 0.006 * thumb), (0.029, 0.015, 0.013), skin, axes=turn("z", 0.45))
    # across the palm, the thumb rotates down and inward
    axes = turn("zyx", 0.75 - 0.45 * thumb, 0.25 + 0.75 * thumb, -0.9 - 0.5 * thumb)
    _finger(parts, xyz(0.020, 0.024, -0.006), axes, THUMB_BONES, 0.0125, thumb_bend * np.array(THUMB_BEND), skin)
    return parts.mesh().scaled(scale).moved(np.diag([1.0, -1.0 if left else 1.0, 1.0]))


def _finger(
    parts: Parts,
    at: np.ndarray,
    axes: np.ndarray,
    bones: tuple[float, ...],
    radius: float,
    bends: np.ndarray,
    skin: int,
) -> None:
    for bone, bend, shrink in zip(bones, bends, (1.0, 0.9, 0.8), strict=True):
        axes = axes @ turn("y", bend)
        end = at + axes @ xyz(bone, 0, 0)
        parts.rod(at, end, radius * shrink, skin, end_radius=0.9 * radius * shrink)
        at = end


# Share of the way to its goal by which each of two low-pass filters moves a hand in a period; two keep it steady.
FOLLOWS = 0.4


def moving(low: np.ndarray, high: np.ndarray, random: np.random.Generator) -> Iterator[Float64[np.ndarray, "13"]]:
    """The states of a hand that moves from one random gesture to the next, endlessly.

    Args:
        low, high: (6,) limits of the wrist's position and of the hand's angles.
    """
    now = half_way = _random_goal(low, high, random)
    while True:
        goal = _random_goal(low, high, random)
        for _ in range(int(random.integers(6, 14))):
            half_way = half_way + FOLLOWS * (goal - half_way)
            now = now + FOLLOWS * (half_way - now)
            yield now


def _random_goal(low: np.ndarray, high: np.ndarray, random: np.random.Generator) -> Float64[np.ndarray, "13"]:
    fingers = np.clip(GESTURES[int(random.integers(len(GESTURES)))] + random.normal(0, 0.08, 7), 0, 1)
    return np.concatenate([random.uniform(low, high), fingers])
