"""An articulated hand as blobs.

Hand axes: origin at the wrist, x along the fingers, y towards the thumb, z out of the back of the hand. The left hand
is the mirror image in y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from annotator.synthetic.mesh import Blobs, Mesh, turn_x, turn_y, turn_z

# For each finger from index to little: knuckle x, y; the three bones' lengths; base radius. Metres, an adult's hand.
FINGERS = (
    (0.092, 0.028, (0.042, 0.026, 0.020), 0.0092),
    (0.096, 0.008, (0.046, 0.030, 0.021), 0.0095),
    (0.091, -0.012, (0.042, 0.028, 0.021), 0.0090),
    (0.083, -0.030, (0.033, 0.020, 0.018), 0.0080),
)
THUMB_BONES = (0.046, 0.036, 0.027)
THUMB_BASE = np.array([0.020, 0.024, -0.006])
# Bending angle of a finger's joints in a full fist, radians.
FULL_BEND = (1.45, 1.75, 1.1)
FINGER_SPREAD = (0.16, 0.04, -0.08, -0.22)
JOINTS = 7


@dataclass(frozen=True)
class HandPose:
    """The pose of the fingers, every value 0..1.

    Attributes:
        bend: bending of index, middle, ring and little finger; 0 = straight, 1 = fist.
        spread: sideways spread of the fingers.
        thumb: 0 = away from the palm, 1 = across it.
        thumb_bend: bending of the thumb's joints.
    """

    bend: tuple[float, float, float, float]
    spread: float
    thumb: float
    thumb_bend: float


def hand_pose(values: np.ndarray) -> HandPose:
    """A pose from its `JOINTS` values in the order of the fields."""
    v = [float(value) for value in np.clip(values, 0, 1)]
    return HandPose((v[0], v[1], v[2], v[3]), v[4], v[5], v[6])


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


def hand_mesh(pose: HandPose, scale: float, skin: int, nail: int, track: int, *, left: bool) -> Mesh:
    """The hand in hand coordinates, metres; `scale` 1 is an adult's hand of 0.19 m."""
    blobs = Blobs(track)
    _palm(blobs, skin, pose)
    for (x, y, bones, radius), bend, spread in zip(FINGERS, pose.bend, FINGER_SPREAD, strict=True):
        turn = turn_z(spread * pose.spread * (1 - 0.7 * bend))
        _finger(blobs, np.array([x, y, 0.0]), turn, bones, radius, bend, skin, nail)
    _thumb(blobs, pose, skin, nail)
    mirror = np.diag([1.0, -1.0 if left else 1.0, 1.0])
    mesh = blobs.mesh()
    grown = Mesh(
        mesh.vertices * np.float32(scale),
        mesh.normals,
        mesh.texture,
        mesh.material,
        mesh.track,
        mesh.triangles,
        mesh.parts,
    )
    return grown.moved(mirror, np.zeros(3))


def _palm(blobs: Blobs, skin: int, pose: HandPose) -> None:
    """Adds one flat blob per finger (its bone within the hand, visible as a tendon), the palm and the two pads."""
    for (x, y, _, radius), at in zip(FINGERS, (0.013, 0.005, -0.005, -0.013), strict=True):
        wrist, knuckle = np.array([0.006, at, 0.0]), np.array([x, y, 0.0])
        blobs.add(
            wrist, knuckle, (0.0135, 0.0125), skin, end_radii=(radius + 0.0035, radius + 0.002), side=np.eye(3)[1]
        )
    middle = np.array([0.052, 0.0, -0.003])
    blobs.ball(middle, (0.042, 0.034, 0.0125), skin, power=2.6)
    blobs.ball(np.array([0.045, -0.024, -0.010]), (0.034, 0.013, 0.011), skin)
    pad = np.array([0.040, 0.023, -0.010 - 0.006 * pose.thumb])
    blobs.ball(pad, (0.029, 0.015, 0.013), skin, axes=turn_z(0.45))


def _finger(
    blobs: Blobs,
    at: np.ndarray,
    turn: np.ndarray,
    bones: tuple[float, ...],
    radius: float,
    bend: float,
    skin: int,
    nail: int,
) -> None:
    for bone, full, shrink in zip(bones, FULL_BEND, (1.0, 0.9, 0.8), strict=True):
        turn = turn @ turn_y(full * bend)
        end = at + turn @ np.array([bone, 0.0, 0.0])
        r = radius * shrink
        blobs.add(at, end, (r, r), skin, end_radii=(0.92 * r, 0.88 * r), side=turn[:, 1])
        at = end
    _nail(blobs, at, turn, radius * 0.8, nail)


def _thumb(blobs: Blobs, pose: HandPose, skin: int, nail: int) -> None:
    """Adds the three bones of the thumb; across the palm it rotates down and inward."""
    away, across = 0.75 - 0.45 * pose.thumb, 0.25 + 0.75 * pose.thumb
    turn = turn_z(away) @ turn_y(across) @ turn_x(-0.9 - 0.5 * pose.thumb)
    at = THUMB_BASE
    for bone, full, r in zip(THUMB_BONES, (0.15, 0.7, 0.9), (0.0135, 0.0108, 0.0098), strict=True):
        turn = turn @ turn_y(full * pose.thumb_bend)
        end = at + turn @ np.array([bone, 0.0, 0.0])
        blobs.add(at, end, (r, r), skin, end_radii=(0.9 * r, 0.86 * r), side=turn[:, 1])
        at = end
    _nail(blobs, at, turn, 0.0092, nail)


def _nail(blobs: Blobs, tip: np.ndarray, turn: np.ndarray, radius: float, nail: int) -> None:
    at = tip + turn @ np.array([-0.001, 0.0, 0.62 * radius])
    blobs.ball(at, (0.0062, 0.62 * radius, 0.0034), nail, axes=turn)
