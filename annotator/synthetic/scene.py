"""Generated scenes, and their presets: people in a furnished room, the hands of a person, and moving objects.

World frame of the room: z up, origin on the floor at the camera's end, y into the room. The side of the table, the
colours and the books on the shelf depend on the seed.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.synthetic.arrangements import LABEL, Arrangement, Placed, room, table_top, with_track
from annotator.synthetic.crowd import Zone, crowd_moments
from annotator.synthetic.hands import HandMotion, Reach, elbow_m, hand_mesh, hand_moments
from annotator.synthetic.materials import (
    HAIR_STYLES,
    Lights,
    Looks,
    Material,
    Palette,
    Pattern,
    darker,
    random_looks,
    wood_colour,
)
from annotator.synthetic.mesh import Mesh, Parts, box_mesh, joined, turn_z
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
from annotator.synthetic.people import Arm, Pose, armless_body, body_mesh, posed_arm, shoulder, sleeved_arm


@dataclass(frozen=True, eq=False)
class Room:
    """The static part of a scene.

    Attributes:
        mesh: room and furniture, world frame.
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


PERIOD_S = 0.1
UPPER_ARM_M, FOREARM_M = 0.31, 0.26


@dataclass(frozen=True, eq=False)
class Actor:
    """One labelled object at one moment.

    Attributes:
        track: track id within the recording, from 1.
        mesh: the complete mesh, world frame.
        axes: columns = axes of the object and its box in the world frame.
    """

    track: int
    label: str
    mesh: Mesh
    axes: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Moment:
    """The moving meshes at one moment: labelled actors and unlabelled meshes."""

    actors: tuple[Actor, ...]
    rest: tuple[Mesh, ...]


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


def people_scene(random: np.random.Generator) -> Scene:
    """Three or four people in a furnished room."""
    palette = Palette()
    room = furnished_room(palette, random)
    styles = random.permutation(HAIR_STYLES)
    looks = [random_looks(palette, random, str(style)) for style in styles[: int(random.integers(3, 5))]]
    zone = Zone(2.45, 4.5, 0.5, 0.3, room.obstacles)
    pose = _camera_pose(np.array([0.0, 0.0, random.uniform(1.5, 1.8)]), pitch=-0.2, roll=random.uniform(-0.03, 0.03))
    return Scene(palette, room.mesh, room.lights, pose, _people(zone, looks, random))


def hands_scene(random: np.random.Generator) -> Scene:
    """One or two gesturing hands of a person who faces the camera."""
    palette = Palette()
    room = furnished_room(palette, random)
    looks = random_looks(palette, random, str(random.choice(HAIR_STYLES)))
    skin = palette.materials[looks.skin]
    nail = palette.add(Material(_paler(skin.colour), gloss=0.25, grain=0.02))
    camera = np.array([0.0, 1.0, random.uniform(1.2, 1.3)])
    pose = _camera_pose(camera, pitch=random.uniform(-0.12, 0.0), roll=random.uniform(-0.03, 0.03))
    lights = Lights((random.uniform(-0.9, 0.9), 0.9, 2.5), key=0.8)
    both = random.random() < 0.6
    return Scene(palette, room.mesh, lights, pose, _hands(looks, nail, camera, both, random))


def _people(zone: Zone, looks: list[Looks], random: np.random.Generator) -> Iterator[Moment]:
    for walkers in crowd_moments(zone, len(looks), random, PERIOD_S):
        actors = []
        for track, (walker, person) in enumerate(zip(walkers, looks, strict=True), start=1):
            axes = turn_z(walker.yaw)
            mesh = body_mesh(person, walker.pose, track).moved(axes, np.array([*walker.place, 0.0]))
            actors.append(Actor(track, "person", mesh, axes))
        yield Moment(tuple(actors), ())


def _hands(looks: Looks, nail: int, camera: np.ndarray, both: bool, random: np.random.Generator) -> Iterator[Moment]:
    """The person stands 0.95 m in front of the camera and faces it, so their left is on the image's right, world +x."""
    stand = np.array([0.0, camera[1] + 0.95, 0.0])
    height = (camera[2] - 0.17, camera[2] + 0.05)
    depth = (camera[1] + 0.48, camera[1] + 0.68)
    sides = [1.0, -1.0] if both else [1.0]
    # from the image's left to its right: the right hand, then the left
    spans = {1.0: (-0.17, -0.02), -1.0: (0.02, 0.17)} if both else {1.0: (-0.16, 0.08)}
    reaches = [Reach(spans[side], depth, height) for side in sides]
    size = random.uniform(0.9, 1.06)
    turned = turn_z(-np.pi / 2)
    # tall and short people have their shoulders at the same height on the image
    lift = np.array([0.0, 0.0, camera[2] - 0.12 - 0.775 * looks.height_m])
    for i, motions in enumerate(hand_moments(reaches, random, PERIOD_S)):
        sway = Pose(twist=0.06 * np.sin(0.11 * i), lean=0.02 * np.sin(0.07 * i), head_turn=0.2 * np.sin(0.05 * i))
        body = Parts()
        armless_body(body, looks, sway)
        if not both:
            posed_arm(body, looks, shoulder(looks, sway, 1.0), np.eye(3), Arm(), 1.0)
        rest, actors = [body.mesh().moved(turned, stand + lift)], []
        for track, (motion, side) in enumerate(zip(motions, sides, strict=True), start=1):
            start = turned @ shoulder(looks, sway, -side) + stand + lift
            forearm, axes = _arm(motion, start, looks, side)
            rest.append(forearm)
            mesh = hand_mesh(motion.fingers, size, looks.skin, nail, track, left=side < 0)
            actors.append(Actor(track, "hand", mesh.moved(axes, motion.wrist_m), axes))
        yield Moment(tuple(actors), tuple(rest))


def _arm(motion: HandMotion, start: np.ndarray, looks: Looks, side: float) -> tuple[Mesh, np.ndarray]:
    """The arm from the shoulder to the wrist, and the axes of the hand; `side` +1 is the right arm."""
    wrist = motion.wrist_m
    outward = np.array([-side, 0.0, 0.0])
    elbow = elbow_m(start, wrist, UPPER_ARM_M, FOREARM_M, motion.swivel, outward)
    blobs = Parts()
    ahead = wrist - elbow
    ahead /= np.linalg.norm(ahead)
    sleeved_arm(blobs, looks, start, elbow, wrist - 0.004 * ahead)
    # the forearm's axes: x to the wrist, y towards the other arm
    y = -outward - ahead * (ahead @ -outward)
    y /= np.linalg.norm(y)
    forearm = np.stack([ahead, y, np.cross(ahead, y)], axis=1)
    mirror = np.diag([1.0, side, 1.0])
    return blobs.mesh(), np.asarray(forearm @ mirror @ motion.bend @ mirror)


def _camera_pose(place: np.ndarray, pitch: float, roll: float) -> RigidTransform:
    """The pose of a camera that looks along world y, tilted up by `pitch` and rolled by `roll`, radians."""
    level = Rotation.from_matrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
    turn = level * Rotation.from_euler("xz", [pitch, roll])
    return RigidTransform.from_components(place, turn)


def _paler(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    return (colour[0] * 0.7 + 0.3, colour[1] * 0.7 + 0.25, colour[2] * 0.7 + 0.25)


# Objects have an axis within this angle of the vertical, so that upright boxes fit them.
UPRIGHT_RAD = 0.06
MIN_OBJECTS = 3


@dataclass(frozen=True)
class Motion:
    """The periodic motion of an object that stays on its support.

    Attributes:
        reach_m: (3,) largest displacement.
        rate_rad_s: of the displacement.
        turn_rad_s: rotation about the vertical.
    """

    reach_m: Float64[np.ndarray, "3"]
    rate_rad_s: float
    turn_rad_s: float


def objects_scene(random: np.random.Generator) -> Scene:
    """Upright objects on a table or on the floor; some stand still, some turn, some slide."""
    arrange = (table_top, room)[int(random.integers(2))]
    scene = arrange(random)
    while sum(map(_is_upright, scene.objects)) < MIN_OBJECTS:
        scene = arrange(random)
    objects = [placed for placed in scene.objects if _is_upright(placed)]
    motions = [_motion(placed, objects, random) for placed in objects]
    return Scene(
        scene.palette, joined(scene.still), scene.lights, scene.T_world_camera, _moments(scene, objects, motions)
    )


def _is_upright(placed: Placed) -> bool:
    return bool(np.abs(placed.axes[2]).max() > np.cos(UPRIGHT_RAD))


def _motion(placed: Placed, objects: list[Placed], random: np.random.Generator) -> Motion:
    """A random motion; an object slides only as far as it cannot touch another one, and turns only without contact."""
    gaps = [
        float(np.linalg.norm(placed.origin_m[:2] - other.origin_m[:2])) - placed.radius_m - other.radius_m
        for other in objects
        if other is not placed
    ]
    room_m = min(gaps, default=0.0)
    kind = random.random()
    if room_m <= 0 or kind < 0.4:
        return Motion(np.zeros(3), 0.0, 0.0)
    turn = float(random.uniform(-0.8, 0.8)) if kind < 0.8 else 0.0
    angle = random.uniform(0, 2 * np.pi)
    reach = 0.5 * min(room_m, 0.5) * np.array([np.cos(angle), np.sin(angle), 0.0])
    return Motion(reach, float(random.uniform(0.4, 1.2)), turn)


def _moments(scene: Arrangement, objects: list[Placed], motions: list[Motion]) -> Iterator[Moment]:
    count = 0
    while True:
        time_s = count * PERIOD_S
        actors = []
        for track, (placed, motion) in enumerate(zip(objects, motions, strict=True), start=1):
            axes = turn_z(motion.turn_rad_s * time_s) @ placed.axes
            place = placed.origin_m + motion.reach_m * np.sin(motion.rate_rad_s * time_s)
            mesh = with_track(placed.mesh.moved(axes, place), track)
            actors.append(Actor(track, LABEL, mesh, axes))
        yield Moment(tuple(actors), ())
        count += 1
