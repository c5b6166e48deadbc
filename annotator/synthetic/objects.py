"""Procedural objects: symmetric, jointed, hollow, thin, bent, very long.

Each family imitates a kind of construction, not a class: legs under a plate, parts on a long body with wheels, a chain
of joints, a vessel. All objects have x forward, y to the left, z up, and their lowest point at z = 0 before they are
placed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.synthetic.materials import Material, Palette, random_colour
from annotator.synthetic.mesh import Mesh, Parts, grounded, joined, turn, xyz

# Share of the axes along which a material's two colours alternate.
PATTERNED = 0.2


@dataclass(frozen=True)
class Colours:
    """The palette rows of one object's materials."""

    rows: tuple[int, ...]

    def pick(self, random: np.random.Generator) -> int:
        return int(random.choice(self.rows))


def random_material(random: np.random.Generator) -> Material:
    """A random material: pale or bright, dark or light, plain or patterned."""
    saturation, value = random.choice([0.1, 0.35, 0.7]), random.choice([0.2, 0.5, 0.8])
    x, y, z = np.where(random.random(3) < PATTERNED, random.uniform(0.02, 0.2, 3), np.inf).tolist()
    first, second = (random_colour(random, saturation, value) for _ in range(2))
    return Material(first, second, (x, y, z), random.uniform(0.02, 0.2), random.uniform(0.1, 1.0))


def random_object(palette: Palette, random: np.random.Generator, family: str | None = None) -> Mesh:
    """A random object with a longest side of 1 m, centred above the origin, with its lowest point at z = 0.

    Args:
        family: a key of `FAMILIES`; None = random.
    """
    names = list(FAMILIES)
    colours = Colours(tuple(palette.add(random_material(random)) for _ in range(int(random.integers(1, 5)))))
    name = family or names[int(random.choice(len(names), p=SHARES))]
    mesh = FAMILIES[name](colours, random)
    if random.random() < 0.3:
        mesh = mesh.moved(np.diag(random.uniform(0.6, 1.6, 3)))
    return grounded(mesh.scaled(1.0 / float(np.ptp(mesh.vertices, axis=0).max())))


def _add_part(
    parts: Parts, center: np.ndarray, size: np.ndarray, material: int, random: np.random.Generator, axes: np.ndarray
) -> None:
    """A box, a cushion or an ellipsoid, or a cylinder or a cone."""
    kind, (_, _, up) = int(random.integers(3)), axes.T
    if kind == 0:
        parts.slab(center, size, material, axes)
    elif kind == 1:
        parts.ball(center, size / 2, material, axes=axes, power=float(random.choice([2.0, 3.0, 6.0, 12.0])))
    else:
        radius, half = float(size[0]) / 2, float(size[2]) / 2 * up
        top = radius * random.uniform(0.1, 1.2)
        parts.rod(center - half, center + half, radius, material, end_radius=top, round_ends=False)


def _block(colours: Colours, random: np.random.Generator) -> Mesh:
    """One part of any proportions."""
    parts = Parts()
    _add_part(parts, np.zeros(3), _proportions(random), colours.pick(random), random, np.eye(3))
    return parts.mesh()


def _stack(colours: Colours, random: np.random.Generator) -> Mesh:
    """Two to five parts on one vertical axis: lamp, bottle, monitor, figurine."""
    parts, height = Parts(), 0.0
    for _ in range(int(random.integers(2, 6))):
        size = _proportions(random) * random.uniform(0.4, 1.0)
        _add_part(parts, xyz(0, 0, height + size[2] / 2), size, colours.pick(random), random, np.eye(3))
        height += float(size[2]) * random.uniform(0.85, 1.0)
    return parts.mesh()


def _legged(colours: Colours, random: np.random.Generator) -> Mesh:
    """A plate on legs: table, stool, chair, bed, shelf, trolley."""
    parts = Parts()
    length, width, height = random.uniform(0.4, 1.6), random.uniform(0.4, 1.0), random.uniform(0.25, 1.1)
    thick, leg = random.uniform(0.02, 0.15), random.uniform(0.015, 0.06)
    main, other = colours.pick(random), colours.pick(random)
    parts.slab(np.array([0, 0, height - thick / 2]), np.array([length, width, thick]), main)
    if random.random() < 0.2:  # one central leg with a foot
        parts.rod(np.zeros(3), np.array([0, 0, height]), leg * 1.5, other)
        parts.slab(np.array([0, 0, 0.02]), np.array([0.6 * length, 0.6 * width, 0.04]), other)
    else:
        splay, square = random.uniform(0, 0.06), random.random() < 0.5
        for x in (-1, 1):
            for y in (-1, 1):
                top = np.array([x * (length / 2 - 2 * leg), y * (width / 2 - 2 * leg), height])
                foot = top + np.array([x * splay, y * splay, -height])
                parts.rod(foot, top, leg, other, power=8 if square else 2, round_ends=False)
    if random.random() < 0.35:  # boards below
        for z in np.linspace(0.1, height, int(random.integers(1, 4)), endpoint=False):
            parts.slab(np.array([0, 0, z]), np.array([length * 0.95, width * 0.95, 0.02]), main)
    if random.random() < 0.5:  # a back, sometimes arms
        rise, lean = random.uniform(0.3, 0.8), random.uniform(-0.2, 0.02)
        axes = turn("y", lean)
        center = np.array([-length / 2 + thick / 2, 0, height]) + axes @ np.array([0, 0, rise / 2])
        parts.slab(center, np.array([thick, width, rise]), main, axes)
        if random.random() < 0.5:
            for y in (-1, 1):
                at = np.array([0, y * (width / 2 - 0.03), height + 0.1])
                parts.slab(at, np.array([length, 0.06, 0.2]), other)
    return parts.mesh()


def _vehicle(colours: Colours, random: np.random.Generator) -> Mesh:
    """A long body with a cabin and wheels: car, van, lorry, cart, toy."""
    parts = Parts()
    length, width = random.uniform(1.6, 3.4), random.uniform(0.8, 1.2)
    wheel = random.uniform(0.16, 0.24)
    low, body = wheel * random.uniform(0.6, 1.2), random.uniform(0.3, 0.55)
    paint, glass, rubber = colours.pick(random), colours.pick(random), colours.pick(random)
    power = float(random.choice([4.0, 6.0, 10.0]))
    parts.ball(np.array([0, 0, low + body / 2]), np.array([length / 2, width / 2, body / 2]), paint, power=power)
    kind = random.random()
    cabin = random.uniform(0.25, 0.45) if kind < 0.6 else random.uniform(0.5, 1.1)
    share = random.uniform(0.4, 0.65) if kind < 0.6 else random.uniform(0.75, 1.0)
    shift = random.uniform(-0.5, 0.5) * (1 - share) * length
    top = np.array([share * length / 2, width / 2 * random.uniform(0.8, 0.98), cabin / 2 + 0.05])
    parts.ball(np.array([shift, 0, low + body + cabin / 2 - 0.05]), top, glass, power=float(random.choice([3, 6, 10])))
    for x in (-0.32, 0.32):
        for y in (-1, 1):
            hub = np.array([x * length, y * (width / 2 - 0.06), wheel])
            parts.rod(hub - xyz(0, 0.07, 0), hub + xyz(0, 0.07, 0), wheel, rubber, round_ends=False)
    if random.random() < 0.4:
        for y in (-1, 1):
            parts.ball(
                np.array([0.2 * length, y * (width / 2 + 0.06), low + body]), np.array([0.05, 0.09, 0.06]), glass
            )
    return parts.mesh()


def _two_wheeler(colours: Colours, random: np.random.Generator) -> Mesh:
    """Two wheels in line and a frame, with or without a rider: bicycle, motorbike, scooter, pram."""
    parts = Parts()
    base, wheel = random.uniform(0.9, 1.3), random.uniform(0.18, 0.35)
    frame, rubber, cloth, skin = (colours.pick(random) for _ in range(4))
    heavy = random.uniform(0.02, 0.12)
    rear, front = np.array([-base / 2, 0, wheel]), np.array([base / 2, 0, wheel])
    for hub in (rear, front):
        parts.ring(hub, 1, wheel - 0.03, random.uniform(0.02, 0.05), rubber)
        if random.random() < 0.4:
            parts.rod(hub - xyz(0, 0.02, 0), hub + xyz(0, 0.02, 0), 0.9 * wheel, rubber, round_ends=False)
    seat = np.array([-0.2 * base, 0, wheel + random.uniform(0.3, 0.6)])
    bar = np.array([0.38 * base, 0, seat[2] + random.uniform(0.0, 0.3)])
    for start, end in (
        (rear, seat),
        (seat, bar),
        (bar, front),
        (rear, (rear + front) / 2 + xyz(0, 0, 0.1)),
        (seat, front),
    ):
        parts.rod(np.asarray(start), np.asarray(end), heavy * random.uniform(0.5, 1.0), frame)
    grip = random.uniform(0.2, 0.35)
    parts.rod(bar - xyz(0, grip, 0), bar + xyz(0, grip, 0), 0.02, frame)
    if random.random() < 0.7:
        _rider(parts, seat, bar, grip, cloth, skin, random)
    return parts.mesh()


def _rider(
    parts: Parts, seat: np.ndarray, bar: np.ndarray, grip: float, cloth: int, skin: int, random: np.random.Generator
) -> None:
    lean = random.uniform(0.0, 0.7)
    spine = np.array([np.sin(lean), 0, np.cos(lean)])
    neck = seat + 0.55 * spine
    parts.rod(seat + 0.05 * spine, neck, 0.15, cloth, end_radius=0.17, side=np.array([1.0, 0, 0]), flatness=0.7)
    parts.ball(neck + 0.2 * spine, np.array([0.11, 0.09, 0.13]), skin)
    for y in (-1, 1):
        hip, hand = seat + xyz(0, y * 0.1, 0), bar + xyz(0, y * grip * 0.9, 0)
        foot = np.array([random.uniform(-0.1, 0.3), y * 0.12, random.uniform(0.1, 0.4)])
        knee = (hip + foot) / 2 + np.array([0.18, y * 0.05, 0.08])
        parts.rod(hip, knee, 0.08, cloth, end_radius=0.06)
        parts.rod(knee, foot, 0.06, cloth, end_radius=0.04)
        elbow = (neck + hand) / 2 + np.array([-0.03, y * 0.1, -0.12])
        parts.rod(neck + xyz(0, y * 0.17, -0.04), elbow, 0.05, cloth)
        parts.rod(elbow, hand, 0.04, skin)


def _animal(colours: Colours, random: np.random.Generator) -> Mesh:
    """A body on four legs, with neck, head and tail."""
    parts, skin = Parts(), colours.pick(random)
    length, thick, leg = random.uniform(0.5, 1.0), random.uniform(0.1, 0.25), random.uniform(0.15, 0.7)
    z = leg + thick
    rear, front = np.array([-length / 2, 0, z]), np.array([length / 2, 0, z + random.uniform(-0.05, 0.1)])
    parts.rod(rear, front, thick, skin, end_radius=thick * random.uniform(0.8, 1.2))
    for start in (rear, front):
        for y in (-1, 1):
            foot = np.array([start[0] + random.uniform(-0.15, 0.15), y * thick * 0.8, 0.0])
            parts.rod(
                foot, start + xyz(0, y * thick * 0.6, 0), 0.25 * thick, colours.pick(random), end_radius=0.5 * thick
            )
    turn = random.uniform(-0.8, 0.8)
    head = front + random.uniform(0.2, 0.6) * np.array([np.cos(turn), np.sin(turn), random.uniform(0.0, 1.2)])
    parts.rod(front, head, 0.6 * thick, skin, end_radius=0.4 * thick)
    nose = head + random.uniform(0.1, 0.25) * np.array([np.cos(turn), np.sin(turn), -0.3])
    parts.rod(head, nose, 0.5 * thick, skin, end_radius=0.3 * thick)
    tail = rear + np.array([-random.uniform(0.1, 0.5), random.uniform(-0.2, 0.2), random.uniform(-0.4, 0.3)])
    parts.rod(rear, tail, 0.15 * thick, skin)
    return parts.mesh()


def _chain(colours: Colours, random: np.random.Generator) -> Mesh:
    """A chain of joints: robot arm, excavator arm, bent pipe, desk lamp, tool."""
    parts = Parts()
    at, direction = np.zeros(3), np.array([0.0, 0.0, 1.0])
    radius = random.uniform(0.03, 0.12)
    flat, planar = random.random() < 0.6, random.random() < 0.6
    if flat:
        parts.slab(np.array([0, 0, 0.03]), np.array([*random.uniform(0.15, 0.5, 2), 0.06]), colours.pick(random))
    for _ in range(int(random.integers(2, 6))):
        axis = np.array([0.0, 1.0, 0.0]) if planar else random.standard_normal(3)
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * random.uniform(-1.2, 1.2))
        direction = turn.apply(direction)
        end = at + direction * random.uniform(0.15, 0.5)
        parts.rod(at, end, radius, colours.pick(random), end_radius=radius * 0.85, power=float(random.choice([2, 8])))
        at, radius = end, radius * random.uniform(0.7, 1.0)
    if random.random() < 0.5:
        parts.ball(at, random.uniform(0.05, 0.2, 3), colours.pick(random), power=4)
    return parts.mesh()


def _branched(colours: Colours, random: np.random.Generator) -> Mesh:
    """A flat palm with bendable branches: gripper, glove, plant, cactus."""
    parts, material = Parts(), colours.pick(random)
    palm = np.array([random.uniform(0.3, 0.5), random.uniform(0.25, 0.45), random.uniform(0.08, 0.2)])
    parts.ball(np.zeros(3), palm / 2, material, power=4)
    count, curl = int(random.integers(2, 6)), random.uniform(-0.2, 1.0)
    for k in range(count):
        y = (k / (count - 1) - 0.5) * palm[1] * 0.85
        at, angle = np.array([palm[0] / 2 - 0.02, y, 0.0]), curl * random.uniform(0.4, 1.3)
        spread, radius = 0.5 * y / palm[1], 0.4 * palm[1] / count
        pitch = 0.0
        for _ in range(int(random.integers(1, 4))):
            pitch += angle * 0.7
            step = np.array([np.cos(pitch) * np.cos(spread), np.sin(spread), -np.sin(pitch)])
            end = at + random.uniform(0.1, 0.2) * step
            parts.rod(at, end, radius, material, end_radius=radius * 0.9)
            at = end
    if random.random() < 0.4:  # a wrist or a stem
        parts.rod(np.array([-palm[0] / 2, 0, 0]), np.array([-palm[0] - 0.2, 0, 0]), 0.3 * palm[1], colours.pick(random))
    return parts.mesh()


def _vessel(colours: Colours, random: np.random.Generator) -> Mesh:
    """A hollow object: open box, drawer, mug, bucket, basket, with or without a handle."""
    parts, material = Parts(), colours.pick(random)
    wall = random.uniform(0.01, 0.04)
    if random.random() < 0.5:
        x, y, z = _proportions(random)
        parts.slab(np.array([0, 0, wall / 2]), np.array([x, y, wall]), material)
        for sign in (-1, 1):
            parts.slab(np.array([sign * (x - wall) / 2, 0, z / 2]), np.array([wall, y, z]), material)
            parts.slab(np.array([0, sign * (y - wall) / 2, z / 2]), np.array([x, wall, z]), material)
        if random.random() < 0.3:  # an open lid
            axes = turn("y", -random.uniform(0.3, 1.8))
            hinge = np.array([-x / 2, 0, z])
            parts.slab(hinge + axes @ np.array([x / 2, 0, 0]), np.array([x, y, wall]), material, axes)
    else:
        radius, height = random.uniform(0.2, 0.5), random.uniform(0.2, 1.0)
        parts.tube(np.zeros(3), height, radius, radius * random.uniform(0.8, 1.4), wall, material)
        parts.rod(np.zeros(3), np.array([0, 0, wall]), radius, material, round_ends=False)
        if random.random() < 0.5:
            parts.ring(np.array([radius * 1.2, 0, height / 2]), 1, min(0.3, 0.3 * height), wall, colours.pick(random))
    return parts.mesh()


def _flat(colours: Colours, random: np.random.Generator) -> Mesh:
    """A thin plate, with or without a stand or a second plate at an angle: screen, book, laptop, sign."""
    parts, material = Parts(), colours.pick(random)
    x, y, thick = random.uniform(0.3, 1.0), random.uniform(0.3, 1.0), random.uniform(0.01, 0.06)
    kind = random.random()
    if kind < 0.4:
        parts.slab(np.zeros(3), np.array([x, y, thick]), material)
    elif kind < 0.7:  # hinged
        parts.slab(np.zeros(3), np.array([x, y, thick]), material)
        axes = turn("y", -random.uniform(0.6, 2.2))
        center = np.array([-x / 2, 0, thick / 2]) + axes @ np.array([x / 2, 0, 0])
        parts.slab(center, np.array([x, y, thick]), colours.pick(random), axes)
    else:  # on a stand
        rise = random.uniform(0.1, 0.8)
        parts.slab(np.array([0, 0, rise + x / 2]), np.array([thick, y, x]), material)
        parts.rod(np.zeros(3), np.array([0, 0, rise + 0.1]), random.uniform(0.015, 0.04), colours.pick(random))
        parts.slab(np.array([0, 0, 0.01]), np.array([0.25, 0.35 * y + 0.1, 0.02]), colours.pick(random))
    return parts.mesh()


def _long(colours: Colours, random: np.random.Generator) -> Mesh:
    """A rod with something at one or both ends: hammer, broom, bottle, pole, dumb-bell."""
    parts, main = Parts(), colours.pick(random)
    radius = random.uniform(0.01, 0.06)
    start, end = np.zeros(3), np.array([1.0, 0, 0])
    parts.rod(start, end, radius, main, end_radius=radius * random.uniform(0.5, 1.2))
    for at in (start, end):
        if random.random() < 0.6:
            size = random.uniform(1.5 * radius, 0.35, 3)
            _add_part(parts, at, size, colours.pick(random), random, np.eye(3))
    return parts.mesh()


def _compound(colours: Colours, random: np.random.Generator) -> Mesh:
    """Several random parts that touch, mirrored or not: machines, bags, engines, toys."""
    parts, at = Parts(), np.zeros(3)
    for _ in range(int(random.integers(2, 7))):
        size = _proportions(random) * random.uniform(0.3, 0.8)
        axes = np.eye(3) if random.random() < 0.6 else Rotation.random(rng=random).as_matrix()
        _add_part(parts, at, size, colours.pick(random), random, axes)
        at = at + random.uniform(-0.5, 0.5, 3) * size
    mesh = parts.mesh()
    return joined([mesh, mesh.moved(np.diag([1.0, -1.0, 1.0]))]) if random.random() < 0.6 else mesh


def _proportions(random: np.random.Generator) -> np.ndarray:
    """Three sides in random proportions, (3,); flat, long and cubic ones alike."""
    return np.asarray(np.exp(random.uniform(np.log(0.15), 0.0, 3)))


FAMILIES: dict[str, Callable[[Colours, np.random.Generator], Mesh]] = {
    "block": _block,
    "stack": _stack,
    "legged": _legged,
    "vehicle": _vehicle,
    "two_wheeler": _two_wheeler,
    "animal": _animal,
    "chain": _chain,
    "branched": _branched,
    "vessel": _vessel,
    "flat": _flat,
    "long": _long,
    "compound": _compound,
}
_WEIGHTS = np.array([0.7, 1, 1.4, 1.6, 1.4, 1, 0.8, 1, 0.8, 0.7, 0.6, 1])
SHARES = _WEIGHTS / _WEIGHTS.sum()
