"""The furniture of the room, each piece with its footprint on the floor."""

from __future__ import annotations

import colorsys
from itertools import pairwise

import numpy as np

from annotator.synthetic.materials import Material, Palette, Pattern, darker, random_colour
from annotator.synthetic.mesh import Blobs, Mesh, box_mesh, joined, turn_z

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
    blobs = Blobs()
    for _ in range(4):
        thing = palette.add(Material(random_colour(random), gloss=0.3, grain=0.03))
        at = np.array([x + random.uniform(-0.3, 0.3), y + random.uniform(-0.55, 0.55), top])
        tall = random.uniform(0.04, 0.13)
        blobs.add(at, at + np.array([0, 0, tall]), (0.04, 0.04, 0.01), thing, power=4)
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
    blobs = Blobs()
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
    blobs = Blobs()
    blobs.add(base, base + np.array([0, 0, 0.28]), (0.13, 0.13, 0.02), pot, end_radii=(0.17, 0.17, 0.02))
    for _ in range(26):
        leaf = palette.add(
            Material(colorsys.hsv_to_rgb(random.uniform(0.25, 0.38), 0.7, random.uniform(0.3, 0.55)), gloss=0.1)
        )
        angle, reach = random.uniform(0, 2 * np.pi), random.uniform(0.1, 0.36)
        tip = base + np.array([reach * np.cos(angle), reach * np.sin(angle), random.uniform(0.55, 1.25)])
        root = base + (tip - base) * [0.3, 0.3, 0.6]
        blobs.add(root, tip, (0.05, 0.008), leaf, side=np.array([-np.sin(angle), np.cos(angle), 0.0]))
    return blobs.mesh(), (base[0] - 0.35, base[1] - 0.35, base[0] + 0.35, base[1] + 0.35)


def floor_lamp(palette: Palette, side: float) -> tuple[Mesh, Footprint]:
    """A standing lamp behind the table."""
    base = np.array([side * 1.2, FAR_Y_M - 0.3, 0.0])
    metal = palette.add(Material((0.25, 0.25, 0.27), gloss=0.4, grain=0.02))
    shade = palette.add(Material((0.95, 0.88, 0.7), glow=0.5, grain=0.03))
    blobs = Blobs()
    blobs.add(base, base + np.array([0, 0, 0.02]), (0.14, 0.14, 0.01), metal)
    blobs.add(base, base + np.array([0, 0, 1.5]), (0.014, 0.014), metal)
    blobs.add(
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
