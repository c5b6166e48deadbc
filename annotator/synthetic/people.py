"""People as blobs: their looks, their poses, and how they walk in a room, turn and gesture.

Body axes: x forward, y left, z up, origin on the floor below the hips. A *pose* is an array of `POSE` angles, radians:
lean of the trunk forward and its twist to the left; turn of the head to the left and its nod; of the left and then of
the right arm: forward, out, inward roll, elbow; of the left and then of the right leg: hip forward, knee backward.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.synthetic.materials import Colour, Material, Palette, random_colour
from annotator.synthetic.mesh import FORWARD, LEFT, UP, Mesh, Parts, grounded, turn, xyz

PERIOD_S = 0.1
POSE = 16
Pose = Float64[np.ndarray, "16"]
# From light to dark.
SKIN_TONES: tuple[Colour, ...] = ((0.88, 0.71, 0.61), (0.85, 0.66, 0.53), (0.67, 0.48, 0.36), (0.42, 0.29, 0.22))


@dataclass(frozen=True)
class Looks:
    """The build and clothes of one person; materials are rows of the palette."""

    height_m: float
    girth: float
    long_sleeves: bool
    long_hair: bool
    backpack: bool
    skin: int
    shirt: int
    trousers: int
    dark: int


def random_looks(palette: Palette, random: np.random.Generator) -> Looks:
    """A random person; their materials are added to the palette."""
    stripes = float(random.choice([np.inf, random.uniform(0.05, 0.1)]))
    cloth = colorsys.hsv_to_rgb(random.uniform(0.5, 1.1) % 1, random.uniform(0.15, 0.6), random.uniform(0.2, 0.55))
    hair = colorsys.hsv_to_rgb(random.uniform(0.04, 0.11), random.uniform(0.3, 0.7), random.uniform(0.08, 0.55))
    materials = (
        Material(SKIN_TONES[int(random.integers(len(SKIN_TONES)))], grain=0.04),
        Material(random_colour(random, 0.65, 0.65), random_colour(random, 0.5, 0.75), (np.inf, np.inf, stripes)),
        Material(cloth),
        Material(hair, grain=0.3, grain_m=0.1),
    )
    return Looks(
        random.uniform(1.56, 1.88),
        random.uniform(0.88, 1.18),
        *(random.random(3) < (0.5, 0.4, 0.3)).tolist(),
        *(palette.add(material) for material in materials),
    )


def posture(
    lean: float = 0.0,
    twist: float = 0.0,
    head: tuple[float, float] = (0.0, 0.0),
    left: tuple[float, float, float, float] = (0.0, 0.12, 0.0, 0.25),
    right: tuple[float, float, float, float] = (0.0, 0.12, 0.0, 0.25),
    legs: tuple[float, float, float, float] = (0.0, 0.06, 0.0, 0.06),
) -> Pose:
    """A pose; by default, of a person who stands upright."""
    return np.array([lean, twist, *head, *left, *right, *legs])


# Poses, and the arms' swing in them: talking, waving, pointing, phoning, hands on hips, stretching, crouching, bent.
_HIPS, _REACH, _DOWN = (-0.35, 0.75, 1.1, 1.55), (2.7, 0.3, 0.0, 0.4), (1.4, 0.15, 0.1, 0.3)
GESTURES = (
    (posture(left=(0.45, 0.2, 0.5, 1.5), right=(0.5, 0.2, 0.45, 1.6)), (0.2, 0.0, 0.0, 0.3)),
    (posture(head=(0.15, 0.0), right=(1.2, 1.4, -1.3, 1.3)), (0.0, 0.0, 0.5, 0.0)),
    (posture(twist=0.15, head=(0.2, 0.0), left=(1.35, 0.35, 0.0, 0.1)), (0.1, 0.0, 0.0, 0.0)),
    (posture(head=(-0.1, 0.12), right=(0.75, 0.55, 0.2, 2.35)), (0.0, 0.0, 0.0, 0.1)),
    (posture(left=_HIPS, right=_HIPS), (0.0, 0.1, 0.0, 0.0)),
    (posture(lean=-0.12, head=(0.0, -0.2), left=_REACH, right=_REACH), (0.15, 0.0, 0.0, 0.0)),
    (
        posture(0.35, 0.0, (0.0, 0.2), (0.9, 0.2, 0.2, 0.5), (0.9, 0.2, 0.2, 0.4), (1.75, 2.3, 1.25, 2.25)),
        (0.2, 0, 0, 0),
    ),
    (posture(1.0, 0.0, (0.0, 0.1), _DOWN, _DOWN, (0.25, 0.3, 0.25, 0.3)), (0.2, 0.0, 0.0, 0.0)),
)


def gesturing(kind: int, time_s: float) -> Pose:
    """The pose of a gesture (index into `GESTURES`) at a time."""
    pose, swing = GESTURES[kind]
    moved = pose.copy()
    moved[4:12] += np.tile(swing, 2) * np.sin(4 * time_s + np.repeat([0.0, 1.0], 4))
    return moved


def walking(phase: float, stride: float) -> Pose:
    """One moment of a gait; `phase` covers 2 pi in two steps, `stride` in 0..1 is their relative length."""
    phases = np.array([phase, phase + np.pi])
    swing, bend = np.sin(phases), np.maximum(np.cos(phases + 0.35), 0) ** 2
    # an arm swings opposite to its leg, whose knee is bent while it swings forward
    pose = posture(0.06 * stride, -0.12 * stride * swing[0])
    pose[[4, 8]], pose[[7, 11]] = -0.5 * stride * swing, 0.25 + 0.35 * stride * np.maximum(-swing, 0)
    pose[[12, 14]], pose[[13, 15]] = stride * (0.48 * swing + 0.06), 0.06 + stride * (0.12 + 0.95 * bend)
    return pose


# Shares of the body height.
HIP, TRUNK, SHOULDER_HALF = 0.52, 0.295, 0.108
THIGH, SHIN, UPPER_ARM, FOREARM = 0.245, 0.235, 0.172, 0.148


def body_mesh(looks: Looks, pose: Pose) -> Mesh:
    """The whole body in body coordinates, metres, with its lowest point on the floor."""
    parts, h = Parts(), looks.height_m
    armless_body(parts, looks, pose)
    for sign, (flex, out, roll, bend) in zip((1.0, -1.0), pose[4:12].reshape(2, 4), strict=True):
        upper = turn("yz", pose[0], pose[1]) @ turn("yxz", -flex, sign * out, -sign * roll)
        lower = upper @ turn("y", -bend)
        start = shoulder(looks, pose, sign)
        elbow = start - upper @ (UPPER_ARM * h * UP)
        wrist = elbow - lower @ (FOREARM * h * UP)
        arm(parts, looks, start, elbow, wrist)
        parts.blob(wrist, wrist - lower @ (0.09 * h * UP), (0.01 * h, 0.021 * h), looks.skin, side=lower @ LEFT)
    mesh = parts.mesh()
    return mesh.moved(np.eye(3), -float(mesh.vertices[:, 2].min()) * UP)


def shoulder(looks: Looks, pose: Pose, sign: float) -> Float64[np.ndarray, "3"]:
    """The start of the left (+1) or right (-1) upper arm, in body coordinates before the vertical shift."""
    across = turn("z", pose[1]) @ (sign * SHOULDER_HALF * LEFT)
    return np.asarray(looks.height_m * (HIP * UP + turn("y", pose[0]) @ ((TRUNK - 0.035) * UP + across)))


def arm(parts: Parts, looks: Looks, start: np.ndarray, elbow: np.ndarray, wrist: np.ndarray) -> None:
    """Adds upper arm and forearm between three points, with the shirt's sleeves."""
    h, g = looks.height_m, 0.5 + 0.5 * looks.girth
    parts.rod(start, elbow, 0.032 * h * g, looks.shirt, end_radius=0.025 * h)
    parts.rod(elbow, wrist, 0.024 * h, looks.shirt if looks.long_sleeves else looks.skin, end_radius=0.016 * h)


def armless_body(parts: Parts, looks: Looks, pose: Pose) -> None:
    """Adds legs, trunk and head, with the hips at `HIP` body heights above the origin."""
    h, g = looks.height_m, looks.girth
    trunk, chest = turn("y", pose[0]), turn("yz", pose[0], pose[1])
    hips = HIP * h * UP

    def on_trunk(height: float) -> Float64[np.ndarray, "3"]:
        return np.asarray(hips + height * h * (trunk @ UP))

    for sign, (flex, bend) in zip((1.0, -1.0), pose[12:].reshape(2, 2), strict=True):
        hip = hips + sign * 0.052 * h * LEFT
        knee = hip - THIGH * h * (turn("y", -flex) @ UP)
        ankle = knee - SHIN * h * (turn("y", bend - flex) @ UP)
        parts.rod(hip, knee, 0.051 * h * g, looks.trousers, end_radius=0.034 * h)
        parts.rod(knee, ankle, 0.034 * h, looks.trousers, end_radius=0.025 * h)
        # the heel lifts when the shin leans back behind the body
        foot = turn("y", 0.8 * max(0.0, bend - flex - 0.35))
        heel, toe = (ankle + foot @ xyz(x * h, 0, z * h) for x, z in ((-0.02, -0.018), (0.095, -0.026)))
        parts.blob(heel, toe, (0.025 * h, 0.026 * h), looks.dark, end_radii=(0.026 * h, 0.016 * h), side=LEFT)
    parts.ball(on_trunk(0.015), (0.068 * h * g, 0.098 * h * g, 0.07 * h), looks.trousers, axes=trunk, power=2.4)
    waist, ribs = ((x * h * g, y * h * g, 0.07 * h) for x, y in ((0.066, 0.088), (0.07, 0.106)))
    front = chest @ FORWARD
    parts.blob(on_trunk(0.07), on_trunk(0.21), waist, looks.shirt, end_radii=ribs, side=front, power=2.5)
    across = 0.093 * h * (chest @ LEFT)
    top = on_trunk(TRUNK - 0.04)
    parts.blob(top - across, top + across, (0.048 * h, 0.036 * h), looks.shirt, side=front)
    if looks.backpack:
        at = on_trunk(0.17) - 0.105 * h * front
        parts.ball(at, (0.055 * h, 0.088 * h, 0.125 * h), looks.dark, axes=chest, power=4)
    head = turn("yzy", pose[0], pose[1] + pose[2], pose[3])
    middle = on_trunk(TRUNK) + head @ xyz(0.012 * h, 0, 0.102 * h)
    parts.rod(on_trunk(TRUNK - 0.02), middle, 0.03 * h, looks.skin)
    details = [
        ((0, 0, 0), (0.056, 0.045, 0.068), looks.skin),
        ((0.056, 0, -0.01), (0.012, 0.008, 0.014), looks.skin),  # the nose, so that front and back differ
        *(((0.052, side * 0.018, 0.012), (0.004, 0.006, 0.004), looks.dark) for side in (-1, 1)),
        ((-0.012, 0, 0.02), (0.055, 0.05, 0.058), looks.dark),
    ]
    if looks.long_hair:
        details.append(((-0.035, 0, -0.045), (0.026, 0.05, 0.08), looks.dark))
    for place, radii, material in details:
        parts.ball(middle + h * (head @ np.array(place, np.float64)), h * np.array(radii), material, axes=head)


def random_person(palette: Palette, random: np.random.Generator) -> Mesh:
    """A person of any age and build, in light or thick clothes, in the middle of a step or a gesture."""
    looks = random_looks(palette, random)
    if random.random() < 0.5:
        pose = walking(random.uniform(0, 2 * np.pi), random.uniform(0, 1))
    else:
        pose = gesturing(int(random.integers(len(GESTURES))), random.uniform(0, 3))
    broad = np.diag([random.uniform(0.9, 1.6), random.uniform(0.9, 1.3), 1.0])
    return grounded(body_mesh(looks, pose).moved(broad).scaled(random.uniform(0.65, 1.05)))


# Metres walked per gait cycle of 2 pi (two steps), and the largest turn of a body, radians per second.
GAIT_M, TURN_RAD_S = 1.35, 2.6
# Share of the way to its next pose that a body moves in each period, so that motion is continuous.
FOLLOWS = 0.6


@dataclass(frozen=True)
class Walker:
    """A person at one moment: the place (x, y) on the floor, metres, and the yaw from +x towards +y, radians."""

    place: Float64[np.ndarray, "2"]
    yaw: float
    pose: Pose


def pacing(place: float, y_m: float, reach_m: float, random: np.random.Generator) -> Iterator[Walker]:
    """A person who paces along x within `reach_m` of the middle, at a depth of `y_m`, and stops to gesture; endless.

    Args:
        place: where they begin, -1 to 1: share of the reach.
    """
    x, yaw, pose = place * reach_m, random.uniform(-np.pi, np.pi), posture()
    phase, pace = random.uniform(0, 2 * np.pi), random.uniform(0.7, 1.2)
    while True:
        goal, gesture = random.uniform(-reach_m, reach_m), int(random.integers(len(GESTURES)))
        steps = int(abs(goal - x) / (pace * PERIOD_S))
        stands, facing = int(random.uniform(1.2, 3.0) / PERIOD_S), random.uniform(-np.pi, np.pi)
        for step in range(steps + stands):
            if step < steps:
                x += np.sign(goal - x) * pace * PERIOD_S
                phase += 2 * np.pi * pace * PERIOD_S / GAIT_M
                wish, ahead = walking(phase, pace / 1.2), 0.0 if goal > x else np.pi
            else:
                wish, ahead = gesturing(gesture, step * PERIOD_S), facing
            pose = pose + FOLLOWS * (wish - pose)
            off = (ahead - yaw + np.pi) % (2 * np.pi) - np.pi
            yaw += float(np.clip(0.4 * off, -TURN_RAD_S * PERIOD_S, TURN_RAD_S * PERIOD_S))
            yield Walker(np.array([x, y_m]), yaw, pose)
