"""Joint angles of a person: standing, walking, gesturing. Radians."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Arm:
    """One arm: `flex` swings the upper arm forward, `out` away from the body, and `turn` rolls it inward."""

    flex: float = 0.0
    out: float = 0.12
    turn: float = 0.0
    elbow: float = 0.25


@dataclass(frozen=True)
class Leg:
    """One leg: flexion of the hip (forward) and of the knee (backward)."""

    hip: float = 0.0
    knee: float = 0.06


@dataclass(frozen=True)
class Pose:
    """All joint angles of a person.

    Attributes:
        lean: forward tilt of the trunk.
        twist: rotation of the shoulders relative to the hips, to the left.
        head_turn, head_nod: rotation of the head to the left, and downwards.
        left_arm, right_arm, left_leg, right_leg: the limbs.
    """

    lean: float = 0.0
    twist: float = 0.0
    head_turn: float = 0.0
    head_nod: float = 0.0
    left_arm: Arm = Arm()
    right_arm: Arm = Arm()
    left_leg: Leg = Leg()
    right_leg: Leg = Leg()


def to_vector(pose: Pose) -> np.ndarray:
    """All angles in one array, in the order of the fields."""
    numbers: list[float] = []
    for field in fields(pose):
        value = getattr(pose, field.name)
        numbers += [value] if isinstance(value, float) else [getattr(value, part.name) for part in fields(value)]
    return np.array(numbers)


def from_vector(vector: np.ndarray) -> Pose:
    """The inverse of `to_vector`."""
    v = [float(value) for value in vector]
    left, right = Arm(v[4], v[5], v[6], v[7]), Arm(v[8], v[9], v[10], v[11])
    return Pose(v[0], v[1], v[2], v[3], left, right, Leg(v[12], v[13]), Leg(v[14], v[15]))


def walking(phase: float, stride: float) -> Pose:
    """One moment of a gait; `phase` covers 2 pi in two steps, `stride` in 0..1 is their relative length."""
    swing = float(np.sin(phase))
    return Pose(
        lean=0.06 * stride,
        twist=-0.12 * stride * swing,
        head_turn=0.1 * stride * swing,
        left_arm=_walking_arm(phase, stride),
        right_arm=_walking_arm(phase + np.pi, stride),
        left_leg=_walking_leg(phase, stride),
        right_leg=_walking_leg(phase + np.pi, stride),
    )


def _walking_leg(phase: float, stride: float) -> Leg:
    """A leg that swings forward, with the knee bent, while sin(phase) rises."""
    bend = max(0.0, float(np.cos(phase + 0.35))) ** 2
    return Leg(hip=stride * (0.48 * float(np.sin(phase)) + 0.06), knee=0.06 + stride * (0.12 + 0.95 * bend))


def _walking_arm(phase: float, stride: float) -> Arm:
    """An arm that swings opposite to the leg."""
    back = -float(np.sin(phase))
    return Arm(flex=0.5 * stride * back, out=0.12, elbow=0.25 + 0.35 * stride * max(0.0, back))


def _talk(t: float) -> Pose:
    left = Arm(0.45 + 0.2 * np.sin(3.1 * t), 0.2, 0.5, 1.5 + 0.3 * np.sin(4.3 * t))
    right = Arm(0.5 + 0.25 * np.sin(2.7 * t + 1), 0.2, 0.45, 1.6 + 0.3 * np.sin(3.7 * t + 2))
    return Pose(twist=0.1 * np.sin(1.3 * t), head_nod=0.1 * np.sin(2.2 * t), left_arm=left, right_arm=right)


def _wave(t: float) -> Pose:
    return Pose(head_turn=0.15, right_arm=Arm(1.2, 1.4, -1.3 + 0.5 * np.sin(6 * t), 1.3))


def _point(t: float) -> Pose:
    return Pose(twist=0.15, left_arm=Arm(1.35 + 0.1 * np.sin(1.5 * t), 0.35, 0.0, 0.1), head_turn=0.2)


def _phone(t: float) -> Pose:
    return Pose(head_nod=0.12, head_turn=-0.1 + 0.2 * np.sin(0.9 * t), right_arm=Arm(0.75, 0.55, 0.2, 2.35))


def _hands_on_hips(t: float) -> Pose:
    arm = Arm(-0.35, 0.75, 1.1, 1.55)
    return Pose(twist=0.1 * np.sin(0.8 * t), left_arm=arm, right_arm=arm)


def _arms_folded(t: float) -> Pose:
    lean = 0.03 * np.sin(0.7 * t)
    return Pose(lean=lean, left_arm=Arm(0.5, 0.15, 1.15, 1.55), right_arm=Arm(0.6, 0.15, 1.15, 1.65))


def _stretch(t: float) -> Pose:
    reach = 2.7 + 0.15 * np.sin(1.1 * t)
    return Pose(lean=-0.12, head_nod=-0.2, left_arm=Arm(reach, 0.3, 0.0, 0.4), right_arm=Arm(reach, 0.3, 0.0, 0.4))


def _crouch(t: float) -> Pose:
    leg, other = Leg(1.75, 2.3), Leg(1.25, 2.25)
    reach = 0.9 + 0.2 * np.sin(2 * t)
    return Pose(0.35, 0.0, 0.0, 0.2, Arm(reach, 0.2, 0.2, 0.5), Arm(reach, 0.2, 0.2, 0.4), leg, other)


def _bend(t: float) -> Pose:
    leg = Leg(0.25, 0.3)
    return Pose(1.0, 0.0, 0.0, 0.1, Arm(1.5, 0.15, 0.1, 0.25), Arm(1.4 + 0.2 * np.sin(2 * t), 0.15, 0.1, 0.3), leg, leg)


GESTURES = (_talk, _wave, _point, _phone, _hands_on_hips, _arms_folded, _stretch, _crouch, _bend)


def gesturing(kind: int, t: float) -> Pose:
    """The pose of gesture `kind` (index into `GESTURES`) at `t` seconds."""
    return GESTURES[kind](t)
