"""Simulation of people in a room: they walk to targets, turn, stop, gesture, and avoid each other.

The simulation runs in fixed time steps and is deterministic. Every joint follows its target through a low-pass filter,
so that motion is continuous.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from annotator.synthetic.objects import Footprint
from annotator.synthetic.people import GESTURES, Pose, from_vector, gesturing, to_vector, walking

STEP_S = 1 / 60
BODY_RADIUS_M = 0.3
PERSONAL_SPACE_M = 0.62
# Metres walked per gait cycle of 2 pi (two steps).
GAIT_M = 1.35
GESTURE_DELAY_S, GAIT_DELAY_S = 0.16, 0.07
JOINT_RATE_RAD_S = 8.0
WALK_LIMIT_S = 7.0
TURN_RATE_RAD_S = 2.6


@dataclass(frozen=True)
class Zone:
    """The area for people: the part of the floor on which the camera sees them completely.

    Attributes:
        near_y_m, far_y_m: limits in depth.
        slope, inset_m: |x| <= slope * y - inset.
        obstacles: footprints of furniture.
    """

    near_y_m: float
    far_y_m: float
    slope: float
    inset_m: float
    obstacles: tuple[Footprint, ...]

    def contains(self, place: np.ndarray) -> bool:
        """True if a person can stand at (x, y)."""
        x, y = place
        if not self.near_y_m <= y <= self.far_y_m or abs(x) > self.slope * y - self.inset_m:
            return False
        return all(_outside_distance(place, box) >= BODY_RADIUS_M for box in self.obstacles)

    def random_place(self, random: np.random.Generator) -> np.ndarray:
        """A random free position, uniformly distributed."""
        reach = self.slope * self.far_y_m - self.inset_m
        while True:
            place = np.array([random.uniform(-reach, reach), random.uniform(self.near_y_m, self.far_y_m)])
            if self.contains(place):
                return place

    def pushed_inside(self, place: np.ndarray) -> np.ndarray:
        """Approximately the nearest allowed position: out of the furniture, then into the zone."""
        for box in self.obstacles:
            place = _pushed_out(place, box)
        y = float(np.clip(place[1], self.near_y_m, self.far_y_m))
        reach = self.slope * y - self.inset_m
        return np.array([np.clip(place[0], -reach, reach), y])


@dataclass
class Walker:
    """One person's state in the simulation.

    Attributes:
        place, speed: (2,) position and velocity on the floor, m and m/s.
        yaw: direction of the body, from +x towards +y, radians.
        phase: phase of the gait, radians.
        target: (2,) destination of the walk, metres.
        until_s: end time of the current walk or gesture.
        gesture: index of the gesture, or -1 while walking.
        started_s: start time of the gesture.
        facing: yaw to turn to while standing, radians.
        pace: walking speed, m/s.
        joints: filtered joint angles, radians.
    """

    place: np.ndarray
    speed: np.ndarray
    yaw: float
    phase: float
    target: np.ndarray
    until_s: float
    gesture: int
    started_s: float
    facing: float
    pace: float
    joints: np.ndarray

    @property
    def pose(self) -> Pose:
        return from_vector(self.joints)


def crowd_moments(zone: Zone, count: int, random: np.random.Generator, period_s: float) -> Iterator[list[Walker]]:
    """Yields the walkers every `period_s` seconds, endlessly; the list is reused."""
    walkers = _initial_walkers(zone, count, random)
    steps = round(period_s / STEP_S)
    now = 0.0
    for _ in range(round(1.5 / STEP_S)):  # skips the transients at the start
        now = _advance(walkers, zone, random, now)
    while True:
        yield walkers
        for _ in range(steps):
            now = _advance(walkers, zone, random, now)


def _initial_walkers(zone: Zone, count: int, random: np.random.Generator) -> list[Walker]:
    walkers: list[Walker] = []
    while len(walkers) < count:
        place = zone.random_place(random)
        if all(np.linalg.norm(place - other.place) > 1.5 * PERSONAL_SPACE_M for other in walkers):
            yaw = random.uniform(-np.pi, np.pi)
            target = zone.random_place(random)
            pace, phase = random.uniform(0.7, 1.2), random.uniform(0, 2 * np.pi)
            walkers.append(
                Walker(place, np.zeros(2), yaw, phase, target, WALK_LIMIT_S, -1, 0.0, yaw, pace, to_vector(Pose()))
            )
    return walkers


def _advance(walkers: list[Walker], zone: Zone, random: np.random.Generator, now: float) -> float:
    for walker in walkers:
        _decide(walker, walkers, zone, random, now)
        _step(walker, walkers)
    _keep_apart(walkers, zone)
    for walker in walkers:
        _move_joints(walker, now)
    return now + STEP_S


def _decide(walker: Walker, walkers: list[Walker], zone: Zone, random: np.random.Generator, now: float) -> None:
    """Switches from walking to a gesture on arrival or timeout, and from the gesture to the next walk."""
    if walker.gesture < 0:
        if np.linalg.norm(walker.target - walker.place) < 0.2 or now > walker.until_s:
            walker.gesture = int(random.integers(len(GESTURES)))
            walker.started_s, walker.until_s = now, now + random.uniform(1.2, 3.0)
            others = [other for other in walkers if other is not walker]
            if others and random.random() < 0.6:
                offset = others[int(random.integers(len(others)))].place - walker.place
                walker.facing = float(np.arctan2(offset[1], offset[0]))
            else:
                walker.facing = random.uniform(-np.pi, np.pi)
    elif now > walker.until_s:
        walker.gesture = -1
        walker.target = zone.random_place(random)
        walker.until_s = now + WALK_LIMIT_S


def _step(walker: Walker, walkers: list[Walker]) -> None:
    wish = np.zeros(2)
    if walker.gesture < 0:
        ahead = walker.target - walker.place
        wish = walker.pace * ahead / max(float(np.linalg.norm(ahead)), 0.4)
        for other in walkers:
            away = walker.place - other.place
            gap = float(np.linalg.norm(away))
            if 0 < gap < 1.2:  # pushed away, and slightly to the right
                push = (1.2 - gap) * away / gap
                wish = wish + 0.9 * push + 0.7 * np.array([push[1], -push[0]])
    walker.speed = walker.speed + (wish - walker.speed) * (1 - np.exp(-STEP_S / 0.25))
    walker.place = walker.place + walker.speed * STEP_S
    pace = float(np.linalg.norm(walker.speed))
    walker.phase += 2 * np.pi * pace * STEP_S / GAIT_M
    goal = float(np.arctan2(walker.speed[1], walker.speed[0])) if walker.gesture < 0 and pace > 0.15 else walker.facing
    off = (goal - walker.yaw + np.pi) % (2 * np.pi) - np.pi
    limit = TURN_RATE_RAD_S * STEP_S
    walker.yaw += float(np.clip(off * (1 - np.exp(-STEP_S / 0.22)), -limit, limit))
    if walker.gesture < 0:
        walker.facing = walker.yaw


def _keep_apart(walkers: list[Walker], zone: Zone) -> None:
    for i, one in enumerate(walkers):
        for other in walkers[i + 1 :]:
            offset = other.place - one.place
            gap = float(np.linalg.norm(offset))
            if gap < PERSONAL_SPACE_M:
                push = 0.5 * (PERSONAL_SPACE_M - gap) * offset / max(gap, 1e-6)
                one.place, other.place = one.place - push, other.place + push
    for walker in walkers:
        walker.place = zone.pushed_inside(walker.place)


def _move_joints(walker: Walker, now: float) -> None:
    stride = min(1.0, float(np.linalg.norm(walker.speed)) / 0.9)
    goal = walking(walker.phase, stride)
    if walker.gesture >= 0:
        goal = gesturing(walker.gesture, now - walker.started_s)
    # less filtering while walking, so that the legs keep up with the gait
    delay = GESTURE_DELAY_S if walker.gesture >= 0 else GAIT_DELAY_S
    change = (to_vector(goal) - walker.joints) * (1 - np.exp(-STEP_S / delay))
    limit = JOINT_RATE_RAD_S * STEP_S
    walker.joints = walker.joints + np.clip(change, -limit, limit)


def _outside_distance(place: np.ndarray, box: Footprint) -> float:
    """Distance to a rectangle; negative inside."""
    dx = max(box[0] - place[0], place[0] - box[2])
    dy = max(box[1] - place[1], place[1] - box[3])
    if dx > 0 and dy > 0:
        return float(np.hypot(dx, dy))
    return float(max(dx, dy))


def _pushed_out(place: np.ndarray, box: Footprint) -> np.ndarray:
    """The position moved along the shortest way out of a rectangle with its margin."""
    if _outside_distance(place, box) >= BODY_RADIUS_M:
        return place
    x, y = place
    ways = [
        (x - box[0] + BODY_RADIUS_M, np.array([-1.0, 0.0])),
        (box[2] + BODY_RADIUS_M - x, np.array([1.0, 0.0])),
        (y - box[1] + BODY_RADIUS_M, np.array([0.0, -1.0])),
        (box[3] + BODY_RADIUS_M - y, np.array([0.0, 1.0])),
    ]
    distance, direction = min(ways, key=lambda way: way[0])
    return np.asarray(place + max(distance, 0.0) * direction)
