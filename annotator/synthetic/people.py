"""A person's body as blobs, from looks and a pose: joint angles, radians.

Body axes: x forward, y left, z up, origin on the floor below the hips. The body is shifted vertically so that its
lowest point is on the floor.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from annotator.synthetic.materials import Looks
from annotator.synthetic.mesh import Mesh, Parts, Triple, turn_x, turn_y, turn_z


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


FORWARD, LEFT, UP = np.eye(3)

# Shares of the body height.
HIP, TRUNK, NECK = 0.52, 0.295, 0.05
HIP_HALF, SHOULDER_HALF = 0.052, 0.108
THIGH, SHIN, FOOT_LENGTH = 0.245, 0.235, 0.15
UPPER_ARM, FOREARM, HAND = 0.172, 0.148, 0.1


def body_mesh(looks: Looks, pose: Pose, track: int) -> Mesh:
    """The whole body in body coordinates, metres."""
    blobs = Parts(track)
    armless_body(blobs, looks, pose)
    chest = turn_y(pose.lean) @ turn_z(pose.twist)
    for sign, arm in ((1.0, pose.left_arm), (-1.0, pose.right_arm)):
        posed_arm(blobs, looks, shoulder(looks, pose, sign), chest, arm, sign)
    mesh = blobs.mesh()
    return mesh.moved(np.eye(3), np.array([0.0, 0.0, -float(mesh.vertices[:, 2].min())]))


def armless_body(blobs: Parts, looks: Looks, pose: Pose) -> None:
    """Adds legs, trunk and head, with the hips at `HIP` body heights above the origin."""
    h = looks.height_m
    hips, trunk = HIP * h * UP, turn_y(pose.lean)
    for sign, leg in ((1.0, pose.left_leg), (-1.0, pose.right_leg)):
        _leg(blobs, looks, hips + sign * HIP_HALF * h * LEFT, leg)
    _trunk(blobs, looks, hips, trunk, pose)
    neck = hips + trunk @ (TRUNK * h * UP)
    _head(blobs, looks, neck, trunk @ turn_z(pose.twist + pose.head_turn) @ turn_y(pose.head_nod))


def shoulder(looks: Looks, pose: Pose, sign: float) -> np.ndarray:
    """The start of the left (+1) or right (-1) upper arm, in body coordinates before the vertical shift."""
    h = looks.height_m
    trunk = turn_y(pose.lean)
    offset = turn_z(pose.twist) @ (sign * SHOULDER_HALF * h * LEFT)
    return np.asarray(HIP * h * UP + trunk @ ((TRUNK - 0.035) * h * UP + offset))


def _leg(blobs: Parts, looks: Looks, hip: np.ndarray, leg: Leg) -> None:
    h, g = looks.height_m, looks.girth
    thigh, shin = turn_y(-leg.hip), turn_y(leg.knee - leg.hip)
    knee = hip - thigh @ (THIGH * h * UP)
    ankle = knee - shin @ (SHIN * h * UP)
    cloth = looks.trousers
    blobs.blob(
        hip,
        knee,
        (0.052 * h * g, 0.05 * h * g),
        cloth if not looks.skirt else looks.skin,
        end_radii=(0.034 * h, 0.034 * h),
        side=thigh @ FORWARD,
    )
    covered = looks.long_trousers and not looks.skirt
    blobs.blob(
        knee,
        ankle,
        (0.034 * h, 0.033 * h),
        cloth if covered else looks.skin,
        end_radii=(0.026 * h, 0.024 * h) if covered else (0.02 * h, 0.02 * h),
        side=shin @ FORWARD,
    )
    # the heel lifts when the shin leans back behind the body
    tip = max(0.0, leg.knee - leg.hip - 0.35)
    foot = turn_y(0.8 * tip)
    heel = ankle + foot @ np.array([-0.02 * h, 0, -0.018 * h])
    toe = ankle + foot @ np.array([(FOOT_LENGTH - 0.055) * h, 0, -0.026 * h])
    blobs.blob(heel, toe, (0.024 * h, 0.026 * h), looks.shoes, end_radii=(0.026 * h, 0.016 * h), side=LEFT, power=2.6)


def _trunk(blobs: Parts, looks: Looks, hips: np.ndarray, trunk: np.ndarray, pose: Pose) -> None:
    h, g = looks.height_m, looks.girth
    chest = trunk @ turn_z(pose.twist)
    up = trunk @ UP
    blobs.ball(hips + 0.015 * h * up, (0.068 * h * g, 0.098 * h * g, 0.07 * h), looks.trousers, axes=trunk, power=2.4)
    if looks.skirt:
        blobs.blob(
            hips + 0.03 * h * up,
            hips - 0.17 * h * UP,
            (0.07 * h * g, 0.1 * h * g, 0.02 * h),
            looks.trousers,
            end_radii=(0.115 * h * g, 0.14 * h * g, 0.015 * h),
            side=trunk @ FORWARD,
        )
    waist, ribs = hips + 0.07 * h * up, hips + 0.21 * h * up
    blobs.blob(
        waist,
        ribs,
        (0.066 * h * g, 0.088 * h * g, 0.07 * h),
        looks.shirt,
        end_radii=(0.07 * h * g, 0.106 * h * g, 0.07 * h),
        side=chest @ FORWARD,
        power=2.5,
    )
    across = SHOULDER_HALF * 0.86 * h * (chest @ LEFT)
    top = hips + (TRUNK - 0.04) * h * up
    blobs.blob(top - across, top + across, (0.048 * h, 0.036 * h), looks.shirt, side=chest @ FORWARD)
    if looks.backpack:
        at = hips + 0.17 * h * up - 0.105 * h * (chest @ FORWARD)
        blobs.ball(at, (0.055 * h, 0.088 * h, 0.125 * h), looks.bag, axes=chest, power=4)


def _head(blobs: Parts, looks: Looks, neck: np.ndarray, turn: np.ndarray) -> None:
    """Adds neck, head and a face, so that front and back differ."""
    h = looks.height_m
    middle = neck + turn @ np.array([0.012 * h, 0, (NECK + 0.052) * h])
    blobs.blob(neck - 0.02 * h * UP, middle - turn @ (0.03 * h * UP), (0.031 * h, 0.03 * h), looks.skin)

    for place, (rx, ry, rz), material, power in _head_parts(looks):
        at = middle + turn @ (np.array(place) * h)
        blobs.ball(at, (rx * h, ry * h, rz * h), material, axes=turn, power=power)


def _head_parts(looks: Looks) -> list[tuple[Triple, Triple, int, float]]:
    """Position and radii (body heights, from the head's centre), material and power of each part of a head."""
    parts: list[tuple[Triple, Triple, int, float]] = [
        ((0, 0, 0), (0.056, 0.045, 0.068), looks.skin, 2.2),
        ((0.056, 0, -0.01), (0.012, 0.008, 0.014), looks.skin, 2.0),  # nose
        ((0.05, 0, -0.036), (0.005, 0.016, 0.003), looks.dark, 2.0),  # mouth
    ]
    for side in (-1, 1):
        parts += [
            ((0.048, side * 0.018, 0.01), (0.006, 0.009, 0.005), looks.dark, 2.0),  # eye
            ((0.049, side * 0.019, 0.022), (0.006, 0.012, 0.0025), looks.hair, 2.0),  # brow
            ((-0.004, side * 0.046, 0), (0.009, 0.005, 0.016), looks.skin, 2.0),  # ear
        ]
    on_top = looks.bag if looks.hair_style == "cap" else looks.hair
    if looks.hair_style != "bald":
        parts.append(((-0.012, 0, 0.02), (0.055, 0.05, 0.058), on_top, 2.2))
    if looks.hair_style == "long":
        parts.append(((-0.035, 0, -0.045), (0.026, 0.05, 0.08), looks.hair, 2.4))
    if looks.hair_style == "bun":
        parts.append(((-0.068, 0, 0.035), (0.026, 0.028, 0.026), looks.hair, 2.0))
    if looks.hair_style == "cap":
        parts.append(((0.05, 0, 0.034), (0.046, 0.043, 0.006), on_top, 2.0))
    return parts


def posed_arm(blobs: Parts, looks: Looks, start: np.ndarray, chest: np.ndarray, arm: Arm, sign: float) -> None:
    """Adds an arm from the shoulder `start`, with a simple hand; `chest` = axes of the trunk, `sign` +1 = left."""
    h = looks.height_m
    upper = chest @ turn_y(-arm.flex) @ turn_x(sign * arm.out) @ turn_z(-sign * arm.turn)
    lower = upper @ turn_y(-arm.elbow)
    elbow = start - upper @ (UPPER_ARM * h * UP)
    wrist = elbow - lower @ (FOREARM * h * UP)
    sleeved_arm(blobs, looks, start, elbow, wrist)
    palm = wrist - lower @ (0.035 * h * UP)
    tips = wrist - lower @ ((HAND - 0.012) * h * UP)
    blobs.blob(wrist - lower @ (0.012 * h * UP), palm, (0.011 * h, 0.021 * h), looks.skin, side=lower @ LEFT, power=2.4)
    blobs.blob(palm, tips, (0.009 * h, 0.021 * h), looks.skin, end_radii=(0.005 * h, 0.014 * h), side=lower @ LEFT)
    thumb = palm + lower @ np.array([0.03 * h, 0, -0.012 * h])
    blobs.blob(wrist - lower @ (0.015 * h * UP), thumb, (0.008 * h, 0.008 * h), looks.skin, side=lower @ LEFT)


def sleeved_arm(blobs: Parts, looks: Looks, start: np.ndarray, elbow: np.ndarray, wrist: np.ndarray) -> None:
    """Adds upper arm and forearm between three points, with the shirt's sleeves."""
    h, g = looks.height_m, 0.5 + 0.5 * looks.girth
    sleeve = looks.shirt if looks.long_sleeves else looks.skin
    blobs.blob(start, elbow, (0.031 * h * g, 0.031 * h * g), sleeve, end_radii=(0.024 * h, 0.024 * h))
    if not looks.long_sleeves:
        blobs.blob(
            start,
            start + 0.5 * (elbow - start),
            (0.036 * h * g, 0.036 * h * g, 0.03 * h),
            looks.shirt,
            end_radii=(0.034 * h * g, 0.034 * h * g, 0.01 * h),
        )
    blobs.blob(elbow, wrist, (0.024 * h, 0.024 * h), sleeve, end_radii=(0.016 * h, 0.015 * h))
