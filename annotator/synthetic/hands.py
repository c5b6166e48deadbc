"""An articulated hand as blobs, and its motion: smooth translation, free rotation and changing gestures.

Hand axes: origin at the wrist, x along the fingers, y towards the thumb, z out of the back of the hand. The left hand
is the mirror image in y.

Each arm extends from a shoulder to a moving wrist. The elbow follows from the lengths of two bones and a swivel angle.
The hand bends and rolls relative to the forearm, so that all its sides become visible.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from annotator.synthetic.mesh import Mesh, Parts, turn_x, turn_y, turn_z

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
    blobs = Parts(track)
    _palm(blobs, skin, pose)
    for (x, y, bones, radius), bend, spread in zip(FINGERS, pose.bend, FINGER_SPREAD, strict=True):
        turn = turn_z(spread * pose.spread * (1 - 0.7 * bend))
        _finger(blobs, np.array([x, y, 0.0]), turn, bones, radius, bend, skin, nail)
    _thumb(blobs, pose, skin, nail)
    mirror = np.diag([1.0, -1.0 if left else 1.0, 1.0])
    mesh = blobs.mesh()
    return replace(mesh, vertices=mesh.vertices * np.float32(scale)).moved(mirror, np.zeros(3))


def _palm(blobs: Parts, skin: int, pose: HandPose) -> None:
    """Adds one flat blob per finger (its bone within the hand, visible as a tendon), the palm and the two pads."""
    for (x, y, _, radius), at in zip(FINGERS, (0.013, 0.005, -0.005, -0.013), strict=True):
        wrist, knuckle = np.array([0.006, at, 0.0]), np.array([x, y, 0.0])
        blobs.blob(
            wrist, knuckle, (0.0135, 0.0125), skin, end_radii=(radius + 0.0035, radius + 0.002), side=np.eye(3)[1]
        )
    middle = np.array([0.052, 0.0, -0.003])
    blobs.ball(middle, (0.042, 0.034, 0.0125), skin, power=2.6)
    blobs.ball(np.array([0.045, -0.024, -0.010]), (0.034, 0.013, 0.011), skin)
    pad = np.array([0.040, 0.023, -0.010 - 0.006 * pose.thumb])
    blobs.ball(pad, (0.029, 0.015, 0.013), skin, axes=turn_z(0.45))


def _finger(
    blobs: Parts,
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
        blobs.blob(at, end, (r, r), skin, end_radii=(0.92 * r, 0.88 * r), side=turn[:, 1])
        at = end
    _nail(blobs, at, turn, radius * 0.8, nail)


def _thumb(blobs: Parts, pose: HandPose, skin: int, nail: int) -> None:
    """Adds the three bones of the thumb; across the palm it rotates down and inward."""
    away, across = 0.75 - 0.45 * pose.thumb, 0.25 + 0.75 * pose.thumb
    turn = turn_z(away) @ turn_y(across) @ turn_x(-0.9 - 0.5 * pose.thumb)
    at = THUMB_BASE
    for bone, full, r in zip(THUMB_BONES, (0.15, 0.7, 0.9), (0.0135, 0.0108, 0.0098), strict=True):
        turn = turn @ turn_y(full * pose.thumb_bend)
        end = at + turn @ np.array([bone, 0.0, 0.0])
        blobs.blob(at, end, (r, r), skin, end_radii=(0.9 * r, 0.86 * r), side=turn[:, 1])
        at = end
    _nail(blobs, at, turn, 0.0092, nail)


def _nail(blobs: Parts, tip: np.ndarray, turn: np.ndarray, radius: float, nail: int) -> None:
    at = tip + turn @ np.array([-0.001, 0.0, 0.62 * radius])
    blobs.ball(at, (0.0062, 0.62 * radius, 0.0034), nail, axes=turn)


STEP_S = 1 / 60
DELAY_S = 0.17
LEAST_GAP_M = 0.16


@dataclass(frozen=True)
class Reach:
    """Limits (low, high) of a hand's position, metres, and angles, radians.

    Attributes:
        x_m, y_m, z_m: position of the wrist, world frame.
        swivel: angle of the elbow about the line from shoulder to wrist.
        roll, flex, aside: angles of the hand relative to the forearm.
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    z_m: tuple[float, float]
    swivel: tuple[float, float] = (-0.3, 1.0)
    roll: tuple[float, float] = (-2.4, 2.4)
    flex: tuple[float, float] = (-1.0, 1.1)
    aside: tuple[float, float] = (-0.35, 0.35)

    @property
    def limits(self) -> np.ndarray:
        """(7, 2) limits in the order of the values of `HandMotion.now`."""
        return np.array([self.x_m, self.y_m, self.z_m, self.swivel, self.roll, self.flex, self.aside])


@dataclass
class HandMotion:
    """One hand's goal and current state; two low-pass filters keep the velocity continuous."""

    reach: Reach
    goal: np.ndarray
    half_way: np.ndarray
    now: np.ndarray
    until_s: float

    @property
    def wrist_m(self) -> np.ndarray:
        return self.now[:3]

    @property
    def swivel(self) -> float:
        return float(self.now[3])

    @property
    def bend(self) -> np.ndarray:
        """(3, 3) rotation of the hand relative to the forearm."""
        roll, flex, aside = self.now[4:7]
        return np.asarray(turn_x(roll) @ turn_y(flex) @ turn_z(aside))

    @property
    def fingers(self) -> HandPose:
        return hand_pose(self.now[7:])


def hand_moments(reaches: list[Reach], random: np.random.Generator, period_s: float) -> Iterator[list[HandMotion]]:
    """Yields the hands every `period_s` seconds, endlessly; the list is reused."""
    motions = []
    for reach in reaches:
        start = _random_goal(reach, random)
        motions.append(HandMotion(reach, start, start, start, 0.0))
    now = 0.0
    while True:
        yield motions
        for _ in range(round(period_s / STEP_S)):
            for motion in motions:
                _advance(motion, random, now)
            _keep_apart(motions)
            now += STEP_S


def _random_goal(reach: Reach, random: np.random.Generator) -> np.ndarray:
    low, high = reach.limits.T
    fingers = np.clip(GESTURES[int(random.integers(len(GESTURES)))] + random.normal(0, 0.08, JOINTS), 0, 1)
    return np.concatenate([random.uniform(low, high), fingers])


def _advance(motion: HandMotion, random: np.random.Generator, now: float) -> None:
    if now >= motion.until_s:
        motion.goal = _random_goal(motion.reach, random)
        motion.until_s = now + random.uniform(0.6, 1.3)
    share = 1 - np.exp(-STEP_S / DELAY_S)
    motion.half_way = motion.half_way + (motion.goal - motion.half_way) * share
    motion.now = motion.now + (motion.half_way - motion.now) * share


def _keep_apart(motions: list[HandMotion]) -> None:
    """Pushes two wrists that are too close apart, sideways."""
    for one, other in pairwise(motions):
        offset = other.wrist_m - one.wrist_m
        gap = float(np.linalg.norm(offset))
        if gap < LEAST_GAP_M:
            push = 0.5 * (LEAST_GAP_M - gap) * np.sign(offset[0] or 1.0)
            for motion, sign in ((one, -1.0), (other, 1.0)):
                motion.now = motion.now.copy()
                motion.now[0] += sign * push


def elbow_m(
    shoulder: np.ndarray, wrist: np.ndarray, upper_m: float, lower_m: float, swivel: float, outward: np.ndarray
) -> np.ndarray:
    """The position of the elbow (3,), metres, from the ends of the arm, the lengths of its bones and a swivel angle.

    Args:
        shoulder, wrist: (3,) metres, z up; the arm is straight and stretched for a wrist out of reach.
        upper_m, lower_m: lengths of the bones.
        swivel: radians; 0 = the elbow points down, pi/2 = it points `outward`.
        outward: (3,) direction away from the body.
    """
    ahead = wrist - shoulder
    distance = float(np.linalg.norm(ahead))
    axis = ahead / distance
    along = (distance**2 + upper_m**2 - lower_m**2) / (2 * distance)
    aside = np.sqrt(max(upper_m**2 - along**2, 0.0))
    down = -np.eye(3)[2] + axis * axis[2]
    down /= np.linalg.norm(down)
    side = outward - axis * (axis @ outward)
    side = side - down * (down @ side)
    side /= np.linalg.norm(side)
    return np.asarray(shoulder + along * axis + aside * (np.cos(swivel) * down + np.sin(swivel) * side))
