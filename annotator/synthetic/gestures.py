"""Simulation of hands in front of the camera: smooth translation, free rotation and changing gestures.

Each arm extends from a shoulder to a moving wrist. The elbow follows from the lengths of two bones and a swivel angle.
The hand bends and rolls relative to the forearm, so that all its sides become visible.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from annotator.synthetic.hands import GESTURES, JOINTS, HandPose, hand_pose
from annotator.synthetic.mesh import turn_x, turn_y, turn_z

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
