"""Generated scenes, and their presets: people in a room, the hands of a person, moving objects, and a tour of a room.

World frame of the room: z up, origin on the floor at the camera's end, y into the room.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.synthetic.arrangements import Actor, Arrangement, Placed, room, table_top
from annotator.synthetic.hands import hand_mesh, moving
from annotator.synthetic.materials import Lights, Material, Palette, random_colour, wood
from annotator.synthetic.mesh import Mesh, Parts, box_mesh, joined, turn, xyz
from annotator.synthetic.objects import random_object
from annotator.synthetic.people import (
    PERIOD_S,
    Looks,
    Walker,
    arm,
    armless_body,
    body_mesh,
    pacing,
    posture,
    random_looks,
    shoulder,
)

# Middle and size of floor, ceiling, far and near wall, and side walls of the room, metres.
SHELL = (
    ((0, 2.2, -0.05), (6.2, 6.8, 0.1)),
    ((0, 2.2, 2.75), (6.2, 6.8, 0.1)),
    ((0, 5.65, 1.35), (6.2, 0.1, 2.7)),
    ((0, -1.25, 1.35), (6.2, 0.1, 2.7)),
    ((-3.15, 2.2, 1.35), (0.1, 6.8, 2.7)),
    ((3.15, 2.2, 1.35), (0.1, 6.8, 2.7)),
)
# Places of a chair's legs along x, and their heights; heights of a shelf's boards.
CHAIR = ((1.47, 0.92), (1.83, 0.42))
SHELVES = (0.06, 0.43, 0.8, 1.16, 1.53, 1.9)
# Middle and size of the furniture's parts, by what they are made of, metres; half of the rooms are mirrored.
FURNITURE = {
    "wood": (
        # a table, two chairs and a shelf
        ((2.25, 4.0, 0.72), (0.95, 1.5, 0.04)),
        *(((2.25 + dx, 4.0 + dy, 0.35), (0.06, 0.06, 0.7)) for dx in (-0.42, 0.42) for dy in (-0.69, 0.69)),
        *(((1.65, y, 0.44), (0.42, 0.42, 0.04)) for y in (3.6, 4.4)),
        *(((x, y + dy, h / 2), (0.04, 0.04, h)) for x, h in CHAIR for y in (3.6, 4.4) for dy in (-0.18, 0.18)),
        *(((1.47, y, z), (0.025, 0.38, 0.07)) for y in (3.6, 4.4) for z in (0.6, 0.74, 0.88)),
        *(((x, 5.43, 0.95), (0.03, 0.3, 1.9)) for x in (-3.03, -2.07)),
        *(((-2.55, 5.43, z), (0.95, 0.3, 0.03)) for z in SHELVES),
    ),
    "cloth": (
        # a sofa
        ((-0.9, 5.08, 0.24), (2.0, 0.9, 0.34)),
        ((-0.9, 5.42, 0.5), (2.0, 0.28, 0.72)),
        *(((x, 5.08, 0.34), (0.24, 0.9, 0.56)) for x in (-1.88, 0.08)),
        *(((x, 5.04, 0.45), (0.86, 0.76, 0.16)) for x in (-1.34, -0.46)),
    ),
    "cardboard": (((-2.0, 3.7, 0.2), (0.55, 0.45, 0.4)), ((-1.97, 3.72, 0.55), (0.42, 0.4, 0.3))),
    "rug": (((0.0, 3.3, 0.006), (2.1, 1.7, 0.012)),),
    "frames": (*(((x, 5.59, 1.7), (0.75, 0.024, 0.55)) for x in (-1.5, -0.5)), ((2.1, 5.59, 1.6), (1.2, 0.03, 1.2))),
    "pictures": tuple(((x, 5.58, 1.7), (0.65, 0.03, 0.45)) for x in (-1.5, -0.5)),
    "sky": (((2.1, 5.58, 1.6), (1.08, 0.04, 1.08)),),
}
# Depths between which people pace, and their reach to the sides: share of the depth, and a margin, metres.
NEAR_M, FAR_M, SIDEWAYS, MARGIN_M = 2.6, 4.4, 0.42, 0.3


@dataclass(frozen=True, eq=False)
class Moment:
    """The moving meshes at one moment: labelled actors and unlabelled meshes; and the camera, if it moves."""

    actors: tuple[Actor, ...]
    rest: tuple[Mesh, ...] = ()
    T_world_camera: RigidTransform | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene from a preset and a seed.

    Attributes:
        moments: an endless sequence, one every `PERIOD_S`.
    """

    palette: Palette
    still: Mesh
    lights: Lights
    T_world_camera: RigidTransform
    moments: Iterator[Moment]


def _furnished_room(palette: Palette, random: np.random.Generator) -> Mesh:
    walls = palette.add(Material(random_colour(random, 0.12, 0.75), grain=0.03, grain_m=0.8))
    surfaces = [palette.add(wood(random)), *[walls] * (len(SHELL) - 1)]
    shell = [box_mesh(*place, surface) for place, surface in zip(SHELL, surfaces, strict=True)]
    made_of = {
        "wood": wood(random),
        "cloth": Material(random_colour(random, 0.4, 0.5), grain=0.2),
        "cardboard": Material((0.68, 0.52, 0.35)),
        "rug": Material(random_colour(random, 0.45, 0.55), random_colour(random, 0.45, 0.4), (0.5, 0.5, np.inf)),
        "frames": Material((0.2, 0.17, 0.15)),
        "pictures": Material(random_colour(random), grain=0.4, grain_m=0.6),
        "sky": Material((0.85, 0.93, 1.0), grain=0.05),
    }
    parts = Parts()
    for name, boxes in FURNITURE.items():
        material = palette.add(made_of[name])
        for center, size in boxes:
            if name == "cloth":
                parts.ball(np.array(center), 0.5 * np.array(size), material, power=8)
            else:
                parts.slab(np.array(center), np.array(size), material)
    for z in SHELVES[:-1]:
        # books
        for x in np.arange(-2.98, -2.12, 0.07):
            colour, tall = random_colour(random, 0.55, 0.6), random.uniform(0.2, 0.32)
            parts.slab(
                xyz(x, 5.45, z + 0.015 + tall / 2),
                xyz(random.uniform(0.03, 0.07), 0.2, tall),
                palette.add(Material(colour)),
            )
    side = random.choice([-1.0, 1.0])
    return joined([*shell, parts.mesh().moved(np.diag([side, 1.0, 1.0]))])


def people_scene(random: np.random.Generator) -> Scene:
    """Three or four people in a furnished room, who pace at different depths, turn and gesture."""
    palette = Palette()
    depths = np.linspace(NEAR_M, FAR_M, 3 if random.random() < 0.5 else 4)
    still = _furnished_room(palette, random.spawn(1)[0])
    looks = [random_looks(palette, random) for _ in depths]
    # side by side at first
    places = np.linspace(-0.8, 0.8, len(depths))
    walks = [
        pacing(float(x), float(y), float(SIDEWAYS * y - MARGIN_M), random)
        for x, y in zip(places, random.permutation(depths), strict=True)
    ]
    pose = _camera_pose(xyz(0, 0, random.uniform(1.5, 1.8)), pitch=-0.2, roll=random.uniform(-0.03, 0.03))

    def moments() -> Iterator[Moment]:
        for walkers in zip(*walks, strict=True):
            both = enumerate(zip(walkers, looks, strict=True), start=1)
            yield Moment(tuple(as_actor(track, walker, person) for track, (walker, person) in both))

    return Scene(palette, still, Lights((0.5, 2.1, 2.6)), pose, moments())


# Rows of objects in the room of a tour, and those between them in which people pace, metres along y.
OBJECT_ROWS, PEOPLE_ROWS, PER_ROW = (1.6, 2.8, 4.0), (2.2, 3.4, 4.6), 4
# Of the camera's way: to the sides, to and fro, metres; time for it, seconds; and where it looks.
WAY_M, WAY_S, LOOKS_AT = (1.7, 0.5), 20.0, (0.0, 3.2)


def tour_scene(random: np.random.Generator) -> Scene:
    """Twelve objects that stand in a room, and three people who pace between them, seen on a way along the room."""
    palette = Palette()
    walls = []
    for middle, size in SHELL:
        surface = palette.add(Material(random_colour(random, 0.3, 0.6), grain=0.05))
        walls.append(box_mesh(middle, size, surface))
    looks = [random_looks(palette, random) for _ in PEOPLE_ROWS]
    walks = [pacing(float(x), y, SIDEWAYS * y, random) for x, y in zip((-0.8, 0.1, 0.9), PEOPLE_ROWS, strict=True)]
    objects = []
    for y in OBJECT_ROWS:
        for x in np.linspace(-1.8, 1.8, PER_ROW):
            mesh = random_object(palette, random).scaled(random.uniform(0.3, 0.6))
            place = xyz(float(x + random.uniform(-0.25, 0.25)), y, -float(mesh.vertices[:, 2].min()))
            objects.append(Placed(mesh, turn("z", random.uniform(0, 2 * np.pi)), place, 0.3))
    still = tuple(placed.actor(track) for track, placed in enumerate(objects, start=1))
    height, tilt, phase = random.uniform(1.5, 1.7), (-0.3, random.uniform(-0.03, 0.03)), random.uniform(0, 2 * np.pi)

    def camera(time_s: float) -> RigidTransform:
        angle = 2 * np.pi * time_s / WAY_S + phase
        place = xyz(WAY_M[0] * np.sin(angle), WAY_M[1] * np.sin(2 * angle) - 0.4, height)
        yaw = -np.arctan2(*(np.array(LOOKS_AT) - place[:2]))
        level = _camera_pose(xyz(0, 0, 0), *tilt)
        return RigidTransform.from_components(place, Rotation.from_euler("z", yaw) * level.rotation)

    def moments() -> Iterator[Moment]:
        for number, walkers in enumerate(zip(*walks, strict=True)):
            people = tuple(
                as_actor(track, walker, person)
                for track, (walker, person) in enumerate(zip(walkers, looks, strict=True), start=len(still) + 1)
            )
            yield Moment((*still, *people), (), camera(number * PERIOD_S))

    return Scene(palette, joined(walls), Lights((0.3, 2.1, 2.6)), camera(0.0), moments())


def as_actor(track: int, walker: Walker, looks: Looks) -> Actor:
    """A person at one moment, as an actor."""
    axes = turn("z", walker.yaw)
    mesh = body_mesh(looks, walker.pose).moved(axes, xyz(walker.place[0], walker.place[1], 0)).tracked(track)
    return Actor(track, "person", mesh, axes)


def hands_scene(random: np.random.Generator) -> Scene:
    """One or two gesturing hands of a person who stands 0.95 m in front of the camera and faces it."""
    palette, both = Palette(), random.random() < 0.6
    still = _furnished_room(palette, random.spawn(1)[0])
    looks = random_looks(palette, random)
    camera = xyz(0, 1, random.uniform(1.2, 1.3))
    pose = _camera_pose(camera, pitch=random.uniform(-0.12, 0.0), roll=random.uniform(-0.03, 0.03))
    lights = Lights((random.uniform(-0.9, 0.9), 0.9, 2.5), key=0.8)
    # from the image's left to its right: the right hand, then the left; they do not touch
    spans = {1.0: (-0.22, -0.08), -1.0: (0.08, 0.22)} if both else {1.0: (-0.16, 0.08)}
    return Scene(palette, still, lights, pose, _hands(looks, camera, spans, random))


def _hands(
    looks: Looks, camera: np.ndarray, spans: dict[float, tuple[float, float]], random: np.random.Generator
) -> Iterator[Moment]:
    """`spans`: where each wrist may be along x, metres; +1 is the right hand, on the image's left."""
    limits = {
        side: (
            np.array([low, camera[1] + 0.48, camera[2] - 0.17, -2.4, -1.0, -0.35]),
            np.array([high, camera[1] + 0.68, camera[2] + 0.05, 2.4, 1.1, 0.35]),
        )
        for side, (low, high) in spans.items()
    }
    states = [moving(*limits[side], random) for side in spans]
    size, turned = random.uniform(0.9, 1.06), turn("z", -np.pi / 2)
    # tall and short people have their shoulders at the same height on the image
    place = camera + xyz(0, 0.95, -0.12 - 0.775 * looks.height_m)
    for i, hands in enumerate(zip(*states, strict=True)):
        sway = posture(0.02 * np.sin(0.07 * i), 0.06 * np.sin(0.11 * i), (0.2 * np.sin(0.05 * i), 0.0))
        body, arms, actors = Parts(), Parts(), []
        armless_body(body, looks, sway)
        for track, (state, side) in enumerate(zip(hands, spans, strict=True), start=1):
            start, wrist = turned @ shoulder(looks, sway, -side) + place, state[:3]
            elbow = (start + wrist) / 2 + xyz(-0.12 * side, 0, -0.15)
            arm(arms, looks, start, elbow, wrist)
            # the forearm's axes: x to the wrist, y towards the other arm
            ahead = (wrist - elbow) / np.linalg.norm(wrist - elbow)
            inward = xyz(side, 0, 0) - ahead * ahead[0] * side
            inward /= np.linalg.norm(inward)
            mirror = np.diag([1.0, side, 1.0])
            forearm = np.stack([ahead, inward, np.cross(ahead, inward)], axis=1)
            axes = forearm @ mirror @ turn("xyz", *state[3:6]) @ mirror
            mesh = hand_mesh(state[6:], size, looks.skin, left=side < 0).moved(axes, wrist).tracked(track)
            actors.append(Actor(track, "hand", mesh, axes))
        yield Moment(tuple(actors), (body.mesh().moved(turned, place), arms.mesh()))


def _camera_pose(place: np.ndarray, pitch: float, roll: float) -> RigidTransform:
    """The pose of a camera that looks along world y, tilted up by `pitch` and rolled by `roll`, radians."""
    level = Rotation.from_matrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
    return RigidTransform.from_components(place, level * Rotation.from_euler("xz", [pitch, roll]))


# Objects have an axis within this angle of the vertical, so that upright boxes fit them.
UPRIGHT_RAD = 0.06
MIN_OBJECTS = 3


def objects_scene(random: np.random.Generator) -> Scene:
    """Upright objects on a table or on the floor; some stand still, some turn, some slide."""
    arrange = (table_top, room)[int(random.integers(2))]
    objects: list[Placed] = []
    while len(objects) < MIN_OBJECTS:
        scene = arrange(random)
        objects = [each for each in scene.objects if np.abs(each.axes[2]).max() > np.cos(UPRIGHT_RAD)]
    return Scene(
        scene.palette, joined(scene.still), scene.lights, scene.T_world_camera, _sliding(scene, objects, random)
    )


def _sliding(scene: Arrangement, objects: list[Placed], random: np.random.Generator) -> Iterator[Moment]:
    """Objects slide to and fro only as far as they cannot touch another one, and turn only without contact."""
    motions = []
    for placed in objects:
        others = [other for other in objects if other is not placed]
        gap = min(
            float(np.linalg.norm((placed.origin_m - o.origin_m)[:2])) - placed.radius_m - o.radius_m for o in others
        )
        kind, angle = random.random(), random.uniform(0, 2 * np.pi)
        moves = gap > 0 and kind >= 0.4
        reach = 0.5 * min(gap, 0.5) * xyz(np.cos(angle), np.sin(angle), 0) if moves else np.zeros(3)
        motions.append((reach, random.uniform(0.4, 1.2), random.uniform(-0.8, 0.8) if moves and kind < 0.8 else 0.0))
    time_s = 0.0
    while True:
        actors = [
            placed.actor(track, yaw_rate * time_s, reach * np.sin(rate * time_s))
            for track, (placed, (reach, rate, yaw_rate)) in enumerate(zip(objects, motions, strict=True), start=1)
        ]
        yield Moment(tuple(actors))
        time_s += PERIOD_S
