"""Arrangements of procedural objects: on a table, in a room, held in the air, along a street.

World frame: z up, metres, the floor at z = 0. Objects touch the floor, walls and each other, hide each other, and are
cut off by the image border; some lie on their side or lean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.oriented_box import aligned_box
from annotator.synthetic.materials import Lights, Material, Palette, random_colour, wood
from annotator.synthetic.mesh import Mesh, Parts, box_mesh, turn, xyz
from annotator.synthetic.objects import random_object
from annotator.synthetic.people import random_person
from annotator.types import OrientedBox

LABEL = "object"
TRIES = 30


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

    def box(self, T_camera_world: RigidTransform) -> OrientedBox:
        """The tightest box along the actor's own axes around all its vertices, camera frame."""
        return aligned_box(self.mesh.vertices.astype(np.float64), self.axes).transformed(T_camera_world)


@dataclass(frozen=True, eq=False)
class Placed:
    """An object at its place.

    Attributes:
        axes: columns = axes of the object and its box, world frame.
        origin_m: position of the object's origin, world frame.
    """

    mesh: Mesh
    axes: Float64[np.ndarray, "3 3"]
    origin_m: Float64[np.ndarray, "3"]
    radius_m: float
    label: str = LABEL

    @property
    def top_m(self) -> Float64[np.ndarray, "3"]:
        """The middle of its upper end, world frame."""
        moved = self.mesh.moved(self.axes, self.origin_m).vertices.astype(np.float64)
        low, high = moved.min(axis=0), moved.max(axis=0)
        return np.array([*(low + high)[:2] / 2, high[2]])

    def actor(self, track: int, yaw_rad: float = 0.0, shift_m: Float64[np.ndarray, "3"] | None = None) -> Actor:
        """The object with a track id, turned about the vertical and shifted."""
        axes = turn("z", yaw_rad) @ self.axes
        origin_m = self.origin_m if shift_m is None else self.origin_m + shift_m
        return Actor(track, self.label, self.mesh.moved(axes, origin_m).tracked(track), axes)


@dataclass(eq=False)
class Arrangement:
    """A scene without motion."""

    palette: Palette
    still: list[Mesh]
    lights: Lights
    T_world_camera: RigidTransform
    objects: list[Placed] = field(default_factory=list)

    @property
    def actors(self) -> tuple[Actor, ...]:
        """The objects, with tracks from 1."""
        return tuple(placed.actor(track) for track, placed in enumerate(self.objects, start=1))


def table_top(random: np.random.Generator) -> Arrangement:
    """Objects of 4 to 40 cm on a table, seen from nearby."""
    palette = Palette()
    height, size = random.uniform(0.5, 1.0), random.uniform(0.7, 2.0, 2)
    cover = palette.add(wood(random)) if random.random() < 0.5 else _plain(palette, random)
    still = [
        *_walls(palette, random, reach=random.uniform(1.5, 4.0)),
        box_mesh((0, 0, height - 0.02), (float(size[0]), float(size[1]), 0.04), cover),
    ]
    distance, rise, around = random.uniform(0.35, 1.5), random.uniform(0.1, 1.2), random.uniform(0, 2 * np.pi)
    target = np.array([*(random.uniform(-0.25, 0.25, 2) * size), height + 0.05])
    away = np.array([np.cos(around) * np.cos(rise), np.sin(around) * np.cos(rise), np.sin(rise)])
    scene = Arrangement(palette, still, _lamp(random), _look_at(target + distance * away, target, random))
    spread = min(0.5 * distance, 0.45 * float(size.min()))
    for _ in range(int(random.integers(2, 10))):
        longest = float(np.exp(random.uniform(np.log(0.04), np.log(0.4)))) * min(1.0, distance)
        _place(scene, random_object(palette, random).scaled(longest), target[:2], spread, height, random)
    return scene


def room(random: np.random.Generator) -> Arrangement:
    """Objects of 0.2 to 2.2 m and people on the floor of a room, at 1 to 6 m."""
    palette = Palette()
    eye = np.array([0.0, 0.0, random.uniform(0.4, 2.3)])
    distance = random.uniform(0.8, 5.0)
    target = np.array([0.0, distance, random.uniform(0.1, 1.2)])
    scene = Arrangement(
        palette,
        _walls(palette, random, reach=distance + random.uniform(0.7, 3.0)),
        _lamp(random),
        _look_at(eye, target, random),
    )
    for _ in range(int(random.integers(2, 9))):
        person = random.random() < 0.25
        longest = float(np.exp(random.uniform(np.log(0.2), np.log(2.2))))
        thing = random_person(palette, random) if person else random_object(palette, random).scaled(longest)
        _place(scene, thing, target[:2], 0.3 + 0.6 * distance, 0.0, random, "person" if person else LABEL)
    return scene


def in_the_air(random: np.random.Generator) -> Arrangement:
    """Objects of 8 to 60 cm in any rotation in front of the camera, held by arms or free; something behind them."""
    palette = Palette()
    eye = np.array([0.0, 0.0, random.uniform(0.8, 1.8)])
    scene = Arrangement(
        palette,
        _walls(palette, random, reach=random.uniform(1.2, 4.0)),
        _lamp(random),
        _look_at(eye, eye + np.array([0.0, 1.0, random.uniform(-0.3, 0.2)]), random),
    )
    distance = random.uniform(0.35, 1.3)
    if random.random() < 0.7:
        behind = random_person(palette, random)
        place = np.array([random.uniform(-0.3, 0.3), distance + random.uniform(0.3, 0.6), eye[2] - 1.45])
        scene.still.append(behind.moved(turn("z", -np.pi / 2 + random.uniform(-0.4, 0.4)), place))
    for _ in range(int(random.integers(1, 5))):
        longest = float(random.uniform(0.08, 0.6)) * min(1.0, 1.2 * distance)
        mesh = random_object(palette, random).scaled(longest)
        mesh = mesh.moved(np.eye(3), xyz(0, 0, -float(mesh.vertices[:, 2].max()) / 2))
        axes = Rotation.random(rng=random).as_matrix()
        depth = distance * random.uniform(0.8, 1.4)
        at = eye + np.array([random.uniform(-0.4, 0.4) * depth, depth, random.uniform(-0.3, 0.25) * depth])
        radius = longest / 2
        if any(np.linalg.norm(at - other.origin_m) < radius + other.radius_m for other in scene.objects):
            continue
        scene.objects.append(Placed(mesh, axes, at, radius))
        if random.random() < 0.6:  # an arm that holds it
            parts, reach = Parts(), random.uniform(0.3, 0.6)
            axis = axes @ np.array([-1.0, 0.0, 0.0])
            end = at + reach * (axis + np.array([0.0, 0.7, -0.5])) / 1.3
            start = at + 0.42 * axis * float(np.ptp(mesh.vertices[:, 0]))
            parts.rod(start, end, random.uniform(0.02, 0.05), _plain(palette, random), end_radius=0.06)
            scene.still.append(parts.mesh())
    return scene


def street(random: np.random.Generator) -> Arrangement:
    """Vehicles, riders, people and other objects of 0.4 to 12 m at 3 to 60 m; buildings, poles and bushes.

    The camera is on a vehicle, 1.2 to 2.2 m above the ground, and looks along y.
    """
    palette = Palette()
    eye = np.array([0.0, 0.0, random.uniform(1.2, 2.2)])
    asphalt = palette.add(Material((0.35, 0.35, 0.37), grain=0.1, grain_m=2.0))
    tilt = Rotation.from_euler("xy", random.normal(0, 0.012, 2)).as_matrix()
    still = [box_mesh((0, 60, -0.25), (160, 160, 0.5), asphalt).moved(tilt)]
    for side in (-1.0, 1.0):
        edge = side * random.uniform(4, 18)
        if random.random() < 0.6:  # pavement
            still.append(box_mesh((edge + side * 3, 60, 0.05), (6, 160, 0.14), _plain(palette, random)))
        for _ in range(int(random.integers(0, 5))):
            depth, wide, tall = random.uniform(4, 14), random.uniform(6, 30), random.uniform(2.5, 12)
            middle = (edge + side * (random.uniform(1, 10) + depth / 2), random.uniform(0, 80), tall / 2)
            still.append(box_mesh(middle, (depth, wide, tall), _plain(palette, random)))
        for _ in range(int(random.integers(0, 8))):
            at = np.array([edge + side * random.uniform(-1.5, 3), random.uniform(3, 60), 0.0])
            parts = Parts()
            if random.random() < 0.5:
                parts.rod(at, at + xyz(0, 0, random.uniform(2, 7)), random.uniform(0.04, 0.2), _plain(palette, random))
            else:
                for _ in range(int(random.integers(2, 6))):
                    center = at + random.normal(0, 0.4, 3) + xyz(0, 0, random.uniform(0.3, 2.0))
                    parts.ball(center, random.uniform(0.3, 1.2, 3), _plain(palette, random))
            still.append(parts.mesh())
    level = RigidTransform.from_components(eye, Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
    sway = Rotation.from_euler("xyz", random.normal(0, 0.015, 3))
    scene = Arrangement(palette, still, _lamp(random), level * RigidTransform.from_rotation(sway))
    for _ in range(int(random.integers(4, 16))):
        depth = float(np.exp(random.uniform(np.log(3.5), np.log(60))))
        kind, label = random.random(), LABEL
        if kind < 0.35:
            longest = random.uniform(3.2, 5.5) * float(random.choice([1, 1, 2]))
            mesh = random_object(palette, random, "vehicle").scaled(longest)
        elif kind < 0.55:
            mesh = random_object(palette, random, "two_wheeler").scaled(random.uniform(1.5, 2.2))
        elif kind < 0.8:
            mesh, label = random_person(palette, random), "person"
        else:
            mesh = random_object(palette, random)
            mesh = mesh.scaled(float(np.exp(random.uniform(np.log(0.4), np.log(5)))))
        center = np.array([random.uniform(-0.7, 0.7) * depth, depth])
        _place(scene, mesh, center, 1.0, 0.0, random, label, along_street=kind < 0.55)
    return scene


INDOORS: tuple[Callable[[np.random.Generator], Arrangement], ...] = (table_top, room, in_the_air)


def _place(
    scene: Arrangement,
    mesh: Mesh,
    center: np.ndarray,
    spread: float,
    ground_m: float,
    random: np.random.Generator,
    label: str = LABEL,
    along_street: bool = False,
) -> None:
    """Puts an object on the ground near `center`, or on or against another object; leaves it out without room."""
    choice, tilt = random.random(), np.eye(3)
    if label == LABEL and not along_street:
        if choice < 0.2:  # on its side
            tilt = turn("xy"[int(random.integers(2))], np.pi / 2)
        elif choice < 0.32:  # tilted in any direction
            tilt = Rotation.random(rng=random).as_matrix()
    yaw = turn(
        "z",
        random.choice([0.5, -0.5, 0.0]) * np.pi + random.normal(0, 0.25)
        if along_street
        else random.uniform(0, 2 * np.pi),
    )
    axes = yaw @ tilt
    turned = mesh.moved(axes).vertices.astype(np.float64)
    low, high = turned.min(axis=0), turned.max(axis=0)
    radius = 0.5 * float(np.hypot(*(high - low)[:2])) * 0.85
    middle = (low + high) / 2
    for _ in range(TRIES):
        place, base = center + random.uniform(-spread, spread, 2), ground_m
        if scene.objects and random.random() < 0.25:
            other = scene.objects[int(random.integers(len(scene.objects)))]
            if random.random() < 0.3 and radius < other.radius_m:  # on top
                place, base = other.origin_m[:2], float(other.top_m[2]) - 0.002
            else:  # in contact
                angle = random.uniform(0, 2 * np.pi)
                gap = (radius + other.radius_m) * random.uniform(0.75, 1.0)
                place = other.origin_m[:2] + gap * np.array([np.cos(angle), np.sin(angle)])
        origin = np.array([place[0] - middle[0], place[1] - middle[1], base - low[2]])
        camera = scene.T_world_camera.translation
        if np.linalg.norm(place - camera[:2]) < radius + 0.15 and base + high[2] - low[2] > camera[2] - 0.3:
            continue
        if base > ground_m or all(
            np.linalg.norm(place - other.top_m[:2]) > 0.72 * (radius + other.radius_m) for other in scene.objects
        ):
            scene.objects.append(Placed(mesh, axes, origin, radius, label))
            return


def _plain(palette: Palette, random: np.random.Generator) -> int:
    colour = random_colour(random, float(random.choice([0.08, 0.3, 0.6])), float(random.choice([0.3, 0.6, 0.85])))
    return palette.add(Material(colour, grain=float(random.uniform(0.02, 0.15)), grain_m=float(random.uniform(0.1, 1))))


def _walls(palette: Palette, random: np.random.Generator, reach: float) -> list[Mesh]:
    """A floor, and walls at `reach` metres or none."""
    meshes = [box_mesh((0, 0, -0.05), (20, 20, 0.1), _plain(palette, random))]
    for yaw in np.arange(4) * np.pi / 2 + random.normal(0, 0.1):
        if random.random() < 0.75:
            wall = box_mesh((0, reach + 0.05, 1.4), (2 * reach + 2, 0.1, 2.8), _plain(palette, random))
            meshes.append(wall.moved(turn("z", float(yaw))))
    return meshes


def _lamp(random: np.random.Generator) -> Lights:
    x, y = random.uniform(-1.5, 1.5, 2)
    return Lights((float(x), float(y), 2.6), key=float(random.uniform(0.4, 1.3)), ambient=float(random.uniform(0.5, 1)))


def _look_at(eye: np.ndarray, target: np.ndarray, random: np.random.Generator) -> RigidTransform:
    """The pose of a camera at `eye` that looks at `target`, nearly level: x right, y down, z forward."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    rotation = Rotation.from_matrix(axes) * Rotation.from_euler("z", random.normal(0, 0.05))
    return RigidTransform.from_components(eye, rotation)
