"""The furnished room, which is static.

World frame: z up, origin on the floor at the camera's end of the room, y into the room. The side of the table, the
colours and the books on the shelf depend on the seed.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

from annotator.synthetic.materials import Lights, Material, Palette, Pattern, darker, wood_colour
from annotator.synthetic.mesh import Mesh, box_mesh, joined
from annotator.synthetic.objects import (
    FAR_Y_M,
    HALF_WIDTH_M,
    HEIGHT_M,
    NEAR_Y_M,
    Footprint,
    cardboard,
    floor_lamp,
    pictures,
    plant,
    rug,
    shelf,
    sofa,
    table_group,
    window,
)


@dataclass(frozen=True, eq=False)
class Room:
    """The static part of a scene.

    Attributes:
        mesh: room and furniture, world frame.
        obstacles: footprints of the furniture.
        lights: lights of the room.
    """

    mesh: Mesh
    obstacles: tuple[Footprint, ...]
    lights: Lights


def furnished_room(palette: Palette, random: np.random.Generator) -> Room:
    """A living room with a table and chairs on one side, a sofa and a shelf at the far wall, and cardboard boxes."""
    side = 1.0 if random.random() < 0.5 else -1.0
    wood = palette.add(Material(wood_colour(random), darker(wood_colour(random)), Pattern.PLANKS, 0.3, 1, gloss=0.08))
    meshes = [_shell(palette, random)]
    obstacles: list[Footprint] = []
    for mesh, footprint in (
        table_group(palette, random, wood, side),
        sofa(palette, random, -side),
        shelf(palette, random, wood, -side),
        cardboard(palette, random, -side),
        plant(palette, random, side),
        floor_lamp(palette, side),
    ):
        meshes.append(mesh)
        obstacles.append(footprint)
    meshes += [pictures(palette, random, -side), window(palette, side), rug(palette, random)]
    lights = Lights((0.5 * side, 2.1, HEIGHT_M - 0.12))
    return Room(joined(meshes), tuple(obstacles), lights)


def _shell(palette: Palette, random: np.random.Generator) -> Mesh:
    """Floor, walls, ceiling, skirting boards."""
    floor_colour = wood_colour(random)
    floor = palette.add(Material(floor_colour, darker(floor_colour, 0.55), Pattern.PLANKS, 0.14, 0, gloss=0.1))
    tint = colorsys.hsv_to_rgb(random.random(), random.uniform(0.05, 0.2), random.uniform(0.78, 0.9))
    wall = palette.add(Material(tint, grain=0.025, grain_m=0.8))
    accent = palette.add(Material(darker(tint, random.uniform(0.65, 0.9)), grain=0.03, grain_m=0.8))
    white = palette.add(Material((0.92, 0.92, 0.9), grain=0.02))
    length, middle = FAR_Y_M - NEAR_Y_M, (FAR_Y_M + NEAR_Y_M) / 2
    up = HEIGHT_M / 2
    meshes = [
        box_mesh((0, middle, -0.05), (2 * HALF_WIDTH_M, length, 0.1), floor),
        box_mesh((0, middle, HEIGHT_M + 0.05), (2 * HALF_WIDTH_M, length, 0.1), white),
        box_mesh((0, FAR_Y_M + 0.05, up), (2 * HALF_WIDTH_M, 0.1, HEIGHT_M), accent),
        box_mesh((0, FAR_Y_M - 0.01, 0.05), (2 * HALF_WIDTH_M, 0.02, 0.1), white),
        box_mesh((0, NEAR_Y_M - 0.05, up), (2 * HALF_WIDTH_M, 0.1, HEIGHT_M), wall),
    ]
    for x in (-HALF_WIDTH_M, HALF_WIDTH_M):
        outward = np.sign(x)
        meshes.append(box_mesh((x + 0.05 * outward, middle, up), (0.1, length, HEIGHT_M), wall))
        meshes.append(box_mesh((x - 0.01 * outward, middle, 0.05), (0.02, length, 0.1), white))
    return joined(meshes)
