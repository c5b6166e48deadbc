"""Procedural objects (symmetric, jointed, hollow, thin, bent, very long), and a room's furniture.

Each family imitates a kind of construction, not a class: legs under a plate, parts on a long body with wheels, a chain
of joints, a vessel. All objects have x forward, y to the left, z up, and their lowest point at z = 0 before they are
placed.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.synthetic.materials import Material, Palette, Pattern, darker, random_colour
from annotator.synthetic.mesh import Mesh, Parts, box_mesh, joined, mirrored, scaled, stretched, turn_z, xyz

PATTERNS = (Pattern.PLAIN, Pattern.PLAIN, Pattern.PLAIN, Pattern.STRIPES, Pattern.CHECKS, Pattern.SPOTS)


@dataclass(frozen=True)
class Colours:
    """The palette rows of one object's materials."""

    rows: tuple[int, ...]

    def pick(self, random: np.random.Generator) -> int:
        return int(random.choice(self.rows))


def random_colours(palette: Palette, random: np.random.Generator) -> Colours:
    """One to four random materials."""
    rows = []
    for _ in range(int(random.integers(1, 5))):
        saturation, value = random.choice([0.1, 0.35, 0.7]), random.choice([0.2, 0.5, 0.8])
        rows.append(
            palette.add(
                Material(
                    random_colour(random, saturation, value),
                    random_colour(random, saturation, value),
                    Pattern(int(random.choice(PATTERNS))),
                    float(random.uniform(0.02, 0.2)),
                    int(random.integers(3)),
                    grain=float(random.uniform(0.02, 0.2)),
                    gloss=float(random.choice([0.0, 0.1, 0.4])),
                )
            )
        )
    return Colours(tuple(rows))


def random_object(palette: Palette, random: np.random.Generator, family: str | None = None) -> Mesh:
    """A random object with a longest side of 1 m, centred above the origin, with its lowest point at z = 0.

    Args:
        family: a key of `FAMILIES`; None = random.
    """
    names = list(FAMILIES)
    name = family or names[int(random.choice(len(names), p=SHARES))]
    mesh = FAMILIES[name](random_colours(palette, random), random)
    if random.random() < 0.3:
        mesh = stretched(mesh, random.uniform(0.6, 1.6, 3))
    return grounded(scaled(mesh, 1.0 / float(np.ptp(mesh.vertices, axis=0).max())))


def grounded(mesh: Mesh) -> Mesh:
    """The mesh moved so that its box is centred above the origin and starts at z = 0."""
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    middle = (low + high) / 2
    return mesh.moved(np.eye(3), -np.array([middle[0], middle[1], low[2]]))


def _block(colours: Colours, random: np.random.Generator) -> Mesh:
    """One part: a box, a cushion, a cylinder, a cone or an ellipsoid of any proportions."""
    parts, size = Parts(), _proportions(random)
    kind = int(random.integers(4))
    if kind == 0:
        parts.slab(np.zeros(3), size, colours.pick(random))
    elif kind == 1:
        parts.ball(np.zeros(3), size / 2, colours.pick(random), power=float(random.choice([2.0, 3.0, 6.0, 12.0])))
    else:
        top = random.uniform(0.1, 1.0) if kind == 3 else 1.0
        axis = np.array([0.0, 0.0, size[2]])
        radius = float(size[0]) / 2
        parts.rod(np.zeros(3), axis, radius, colours.pick(random), end_radius=radius * top, round_ends=False)
    return parts.mesh()


def _stack(colours: Colours, random: np.random.Generator) -> Mesh:
    """Two to five parts on one vertical axis: lamp, bottle, monitor, figurine."""
    parts, height = Parts(), 0.0
    for _ in range(int(random.integers(2, 6))):
        size = _proportions(random) * random.uniform(0.4, 1.0)
        base, center = np.array([0.0, 0.0, height]), np.array([0.0, 0.0, height + size[2] / 2])
        kind, material = int(random.integers(3)), colours.pick(random)
        if kind == 0:
            parts.slab(center, size, material)
        elif kind == 1:
            top = float(size[0]) / 2 * random.uniform(0.3, 1.2)
            end = base + np.array([0.0, 0.0, size[2]])
            parts.rod(base, end, float(size[0]) / 2, material, end_radius=top, round_ends=False)
        else:
            parts.ball(center, size / 2, material, power=float(random.choice([2.0, 4.0])))
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
        axes = Rotation.from_euler("y", lean).as_matrix()
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
            axes = Rotation.from_euler("y", -random.uniform(0.3, 1.8)).as_matrix()
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
        axes = Rotation.from_euler("y", -random.uniform(0.6, 2.2)).as_matrix()
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
        kind = random.random()
        if kind < 0.35:
            parts.slab(at, random.uniform(1.5 * radius, 0.35, 3), colours.pick(random))
        elif kind < 0.6:
            parts.ball(at, random.uniform(1.5 * radius, 0.2, 3), colours.pick(random))
    return parts.mesh()


def _compound(colours: Colours, random: np.random.Generator) -> Mesh:
    """Several random parts that touch, mirrored or not: machines, bags, engines, toys."""
    parts, at = Parts(), np.zeros(3)
    for _ in range(int(random.integers(2, 7))):
        size = _proportions(random) * random.uniform(0.3, 0.8)
        axes = np.eye(3) if random.random() < 0.6 else Rotation.random(rng=random).as_matrix()
        if random.random() < 0.5:
            parts.slab(at, size, colours.pick(random), axes)
        else:
            parts.ball(at, size / 2, colours.pick(random), axes=axes, power=float(random.choice([2, 4, 8])))
        at = at + random.uniform(-0.5, 0.5, 3) * size
    mesh = parts.mesh()
    return mirrored(mesh) if random.random() < 0.6 else mesh


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


HALF_WIDTH_M = 3.1
NEAR_Y_M = -1.2
FAR_Y_M = 5.6
HEIGHT_M = 2.7

# x_min, y_min, x_max, y_max on the floor
Footprint = tuple[float, float, float, float]


def table_group(palette: Palette, random: np.random.Generator, wood: int, side: float) -> tuple[Mesh, Footprint]:
    """A dining table with three chairs and some objects on it."""
    x, y = side * 2.05, 3.9 + random.uniform(-0.1, 0.2)
    top = 0.74
    meshes = [box_mesh((x, y, top - 0.02), (0.95, 1.5, 0.04), wood)]
    for dx in (-0.42, 0.42):
        for dy in (-0.69, 0.69):
            meshes.append(box_mesh((x + dx, y + dy, (top - 0.04) / 2), (0.06, 0.06, top - 0.04), wood))
    meshes.append(_chair(wood, x - side * 0.62, y - 0.35, np.pi * (side > 0) + random.uniform(-0.3, 0.3)))
    meshes.append(_chair(wood, x - side * 0.66, y + 0.38, np.pi * (side > 0) + random.uniform(-0.3, 0.3)))
    meshes.append(_chair(wood, x, y - 0.98, -np.pi / 2 + random.uniform(-0.3, 0.3)))
    blobs = Parts()
    for _ in range(4):
        thing = palette.add(Material(random_colour(random), gloss=0.3, grain=0.03))
        at = np.array([x + random.uniform(-0.3, 0.3), y + random.uniform(-0.55, 0.55), top])
        tall = random.uniform(0.04, 0.13)
        blobs.blob(at, at + np.array([0, 0, tall]), (0.04, 0.04, 0.01), thing, power=4)
    meshes.append(blobs.mesh())
    edges = sorted((x - side * 0.85, x + side * 0.5))
    return joined(meshes), (edges[0], y - 1.2, edges[1], y + 0.78)


def _chair(wood: int, x: float, y: float, yaw: float) -> Mesh:
    """A chair whose back points in the direction `yaw`, measured from +x, radians."""
    meshes = [box_mesh((0, 0, 0.44), (0.42, 0.42, 0.04), wood)]
    for dx in (-0.18, 0.18):
        for dy in (-0.18, 0.18):
            height = 0.92 if dx > 0 else 0.42
            meshes.append(box_mesh((dx, dy, height / 2), (0.04, 0.04, height), wood))
    for z in (0.6, 0.74, 0.88):
        meshes.append(box_mesh((0.18, 0, z), (0.025, 0.38, 0.07), wood))
    return joined(meshes).moved(turn_z(yaw), np.array([x, y, 0.0]))


def sofa(palette: Palette, random: np.random.Generator, side: float) -> tuple[Mesh, Footprint]:
    """A sofa with cushions at the far wall."""
    x, y = side * 0.9, FAR_Y_M - 0.52
    cloth = palette.add(Material(random_colour(random, 0.4, 0.5), grain=0.2, grain_m=0.15))
    blobs = Parts()
    blobs.ball(np.array([x, y, 0.24]), (1.0, 0.45, 0.17), cloth, power=9)
    blobs.ball(np.array([x, y + 0.34, 0.5]), (1.0, 0.14, 0.36), cloth, power=9)
    for dx in (-0.98, 0.98):
        blobs.ball(np.array([x + dx, y, 0.34]), (0.12, 0.45, 0.28), cloth, power=7)
    for dx in (-0.44, 0.44):
        blobs.ball(np.array([x + dx, y - 0.04, 0.45]), (0.43, 0.38, 0.08), cloth, power=6)
    for dx in (-0.62, 0.55):
        cushion = palette.add(
            Material(random_colour(random, 0.7), random_colour(random, 0.3), Pattern.STRIPES, 0.09, 0, grain=0.2)
        )
        tilt = turn_z(random.uniform(-0.3, 0.3))
        blobs.ball(np.array([x + dx, y + 0.12, 0.66]), (0.19, 0.09, 0.18), cushion, axes=tilt, power=3.5)
    return blobs.mesh(), (x - 1.1, y - 0.45, x + 1.1, FAR_Y_M)


def shelf(palette: Palette, random: np.random.Generator, wood: int, side: float) -> tuple[Mesh, Footprint]:
    """A book shelf at the far wall."""
    x, y, height, length = side * 2.55, FAR_Y_M - 0.17, 1.9, 0.95
    levels = np.linspace(0.06, height, 6)
    meshes = [box_mesh((x + dx, y, height / 2), (0.03, 0.3, height), wood) for dx in (-length / 2, length / 2)]
    meshes += [box_mesh((x, y, z), (length, 0.3, 0.03), wood) for z in levels]
    for z, above in pairwise(levels):
        at = x - length / 2 + 0.03
        while True:
            thick, tall, deep = random.uniform(0.02, 0.06), random.uniform(0.55, 0.88), random.uniform(0.16, 0.24)
            if random.random() < 0.12:  # a gap
                at += random.uniform(0.05, 0.2)
            if at + thick > x + length / 2 - 0.03:
                break
            book = palette.add(Material(random_colour(random, 0.55, 0.6), grain=0.08))
            tall *= above - z
            center = (at + thick / 2, y + 0.12 - deep / 2, z + 0.015 + tall / 2)
            meshes.append(box_mesh(center, (thick, deep, tall), book))
            at += thick + 0.002
    return joined(meshes), (x - length / 2, y - 0.2, x + length / 2, FAR_Y_M)


def cardboard(palette: Palette, random: np.random.Generator, side: float) -> tuple[Mesh, Footprint]:
    """A stack of three cardboard boxes with tape."""
    x, y = side * 1.95, 3.75
    card = palette.add(Material((0.68, 0.52, 0.35), grain=0.06))
    tape = palette.add(Material((0.8, 0.72, 0.52), gloss=0.3, grain=0.02))
    meshes, z = [], 0.0
    for size in ((0.55, 0.45, 0.4), (0.42, 0.4, 0.3), (0.3, 0.25, 0.22)):
        yaw = random.uniform(-0.3, 0.3)
        at = (x + random.uniform(-0.05, 0.05), y + random.uniform(-0.05, 0.05), z + size[2] / 2)
        meshes.append(box_mesh(at, size, card, yaw))
        meshes.append(box_mesh(at, (size[0] + 0.004, 0.05, size[2] + 0.004), tape, yaw))
        z += size[2]
    return joined(meshes), (x - 0.33, y - 0.3, x + 0.33, y + 0.3)


def plant(palette: Palette, random: np.random.Generator, side: float) -> tuple[Mesh, Footprint]:
    """A potted plant in the far corner."""
    base = np.array([side * (HALF_WIDTH_M - 0.42), FAR_Y_M - 0.45, 0.0])
    pot = palette.add(Material((0.62, 0.35, 0.25), grain=0.1))
    blobs = Parts()
    blobs.blob(base, base + np.array([0, 0, 0.28]), (0.13, 0.13, 0.02), pot, end_radii=(0.17, 0.17, 0.02))
    for _ in range(26):
        leaf = palette.add(
            Material(colorsys.hsv_to_rgb(random.uniform(0.25, 0.38), 0.7, random.uniform(0.3, 0.55)), gloss=0.1)
        )
        angle, reach = random.uniform(0, 2 * np.pi), random.uniform(0.1, 0.36)
        tip = base + np.array([reach * np.cos(angle), reach * np.sin(angle), random.uniform(0.55, 1.25)])
        root = base + (tip - base) * [0.3, 0.3, 0.6]
        blobs.blob(root, tip, (0.05, 0.008), leaf, side=np.array([-np.sin(angle), np.cos(angle), 0.0]))
    return blobs.mesh(), (base[0] - 0.35, base[1] - 0.35, base[0] + 0.35, base[1] + 0.35)


def floor_lamp(palette: Palette, side: float) -> tuple[Mesh, Footprint]:
    """A standing lamp behind the table."""
    base = np.array([side * 1.2, FAR_Y_M - 0.3, 0.0])
    metal = palette.add(Material((0.25, 0.25, 0.27), gloss=0.4, grain=0.02))
    shade = palette.add(Material((0.95, 0.88, 0.7), glow=0.5, grain=0.03))
    blobs = Parts()
    blobs.blob(base, base + np.array([0, 0, 0.02]), (0.14, 0.14, 0.01), metal)
    blobs.blob(base, base + np.array([0, 0, 1.5]), (0.014, 0.014), metal)
    blobs.blob(
        base + np.array([0, 0, 1.42]),
        base + np.array([0, 0, 1.68]),
        (0.2, 0.2, 0.01),
        shade,
        end_radii=(0.13, 0.13, 0.01),
    )
    return blobs.mesh(), (base[0] - 0.16, base[1] - 0.16, base[0] + 0.16, base[1] + 0.16)


def window(palette: Palette, side: float) -> Mesh:
    """A bright window in the far wall."""
    glass = palette.add(Material((0.75, 0.87, 1.0), (0.95, 0.97, 1.0), Pattern.SPOTS, 2.5, grain=0.05, glow=0.7))
    frame = palette.add(Material((0.95, 0.95, 0.93), grain=0.01))
    x, y, z, wide, tall = side * 2.1, FAR_Y_M - 0.01, 1.6, 1.1, 1.1
    meshes = [box_mesh((x, y, z), (wide, 0.02, tall), glass)]
    for dx in (-wide / 2, 0.0, wide / 2):
        meshes.append(box_mesh((x + dx, y, z), (0.06, 0.06, tall + 0.12), frame))
    for dz in (-tall / 2, tall / 2):
        meshes.append(box_mesh((x, y, z + dz), (wide + 0.06, 0.06, 0.06), frame))
    return joined(meshes)


def pictures(palette: Palette, random: np.random.Generator, side: float) -> Mesh:
    """Framed pictures on the far wall."""
    frame = palette.add(Material((0.2, 0.17, 0.15), gloss=0.2))
    meshes = []
    for at in (1.5, 0.45, -0.6):
        x = side * (at + random.uniform(-0.12, 0.12))
        wide, tall = random.uniform(0.5, 0.85), random.uniform(0.4, 0.6)
        z = random.uniform(1.6, 1.8)
        picture = palette.add(
            Material(random_colour(random), random_colour(random, 0.4, 0.8), Pattern.SPOTS, 0.9, grain=0.4, grain_m=0.6)
        )
        meshes.append(box_mesh((x, FAR_Y_M - 0.012, z), (wide + 0.08, 0.024, tall + 0.08), frame))
        meshes.append(box_mesh((x, FAR_Y_M - 0.02, z), (wide, 0.03, tall), picture))
    return joined(meshes)


def rug(palette: Palette, random: np.random.Generator) -> Mesh:
    colour = random_colour(random, 0.45, 0.55)
    rug = palette.add(Material(colour, darker(colour, 0.75), Pattern.CHECKS, 0.25, 0, grain=0.25, grain_m=0.12))
    border = palette.add(Material(darker(colour, 0.5), grain=0.25, grain_m=0.12))
    return joined(
        [box_mesh((0, 3.3, 0.006), (2.1, 1.7, 0.012), border), box_mesh((0, 3.3, 0.009), (1.9, 1.5, 0.012), rug)]
    )
