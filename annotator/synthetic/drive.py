"""A generated drive: scans of a LiDAR on a car that goes round a block, past parked and moving cars and walkers.

World frame: z up, the ground at z = 0, origin in the middle of the block. The road is an oval: two straight pieces and
two half circles, driven counter-clockwise on the right. The LiDAR's frame: x ahead, y left, z up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.synthetic.arrangements import Placed
from annotator.synthetic.materials import Lights, Material, Palette, random_colour
from annotator.synthetic.mesh import Mesh, box_mesh, joined, turn, xyz
from annotator.synthetic.objects import random_object
from annotator.synthetic.people import GAIT_M, PERIOD_S, Walker, random_looks, walking
from annotator.synthetic.scene import Moment, Scene, as_actor

# Of the middle of the road: its straight pieces and the radius of its bends, metres.
STRAIGHT_M, RADIUS_M = 30.0, 20.0
HALF_M = STRAIGHT_M + np.pi * RADIUS_M
# Distance to the middle of the road, to the left, metres.
LANE_M, PARKED_M, PAVEMENT_M, WALL_M, BLOCK_M = 1.7, 4.7, 7.2, 11.0, 10.0
PARKED, WALKERS = 20, 5
# Our car: its LiDAR's height and its start, metres, and its speed. The others: how far ahead they are in our lane, and
# where those that come towards us begin.
LIDAR_M, START_M, SPEED_M_S = 1.8, 5.0, 6.0
AHEAD_M, TOWARDS_M = (-12.0, 13.0, 26.0), (40.0, 66.0, 92.0)
# Length, width and height of cars, from and to, metres.
CAR_M = ((3.9, 1.65, 1.4), (4.9, 1.9, 1.9))
WALK_M_S = 1.2


def on_road(way_m: float, left_m: float) -> tuple[Float64[np.ndarray, "3"], float]:
    """A place on the ground and its yaw, radians, by the way along the road and the distance to its left."""
    lap, along = divmod(way_m, HALF_M)
    yaw, radius = max(along - STRAIGHT_M, 0.0) / RADIUS_M, RADIUS_M - left_m
    x = min(along, STRAIGHT_M) - STRAIGHT_M / 2 + radius * np.sin(yaw)
    # the second half is the first one turned
    sign = -1.0 if lap % 2 else 1.0
    return xyz(sign * x, -sign * radius * np.cos(yaw), 0), yaw + np.pi * (lap % 2)


def drive_scene(random: np.random.Generator) -> Scene:
    """Twenty parked cars and six that drive, people who walk, walls and the ground, scanned from a car."""
    palette = Palette()
    still = [box_mesh((0, 0, -0.05), (160, 160, 0.1), palette.add(Material((0.35, 0.35, 0.37), grain=0.1)))]
    block = (STRAIGHT_M, 2 * (RADIUS_M - BLOCK_M), 8.0)
    still.append(box_mesh((0, 0, 4), block, palette.add(Material(random_colour(random, 0.3, 0.6)))))
    for way in np.arange(0, 2 * HALF_M, 8.0):
        if random.random() < 0.8:
            (x, y, _), yaw = on_road(float(way), -WALL_M - random.uniform(0, 1))
            tall, surface = random.uniform(2.5, 6), palette.add(Material(random_colour(random, 0.3, 0.6)))
            still.append(box_mesh((x, y, tall / 2), (8.0, 0.4, tall), surface, turn("z", yaw)))
    parked = []
    for number in range(PARKED):
        side = -1.0 if number % 2 else 1.0
        place, yaw = on_road(4.0 * (number - number % 2) + random.uniform(-0.6, 0.6), side * PARKED_M)
        axes = turn("z", yaw + random.normal(0, 0.03) + np.pi * (side > 0))
        parked.append(Placed(_car(palette, random), axes, place, 0.0, "car").actor(number + 1))
    cars = [_car(palette, random) for _ in (*AHEAD_M, *TOWARDS_M)]
    ways = [_along(gap, random) for gap in AHEAD_M] + [_towards(start) for start in TOWARDS_M]
    looks = [random_looks(palette, random) for _ in range(WALKERS)]
    walks = [(float(random.uniform(5, 85)), -1.0 if n % 2 else 1.0, random.choice([-1, 1])) for n in range(WALKERS)]

    def moments() -> Iterator[Moment]:
        time_s = 0.0
        while True:
            actors = list(parked)
            for mesh, way in zip(cars, ways, strict=True):
                place, yaw = way(time_s)
                actors.append(Placed(mesh, turn("z", yaw), place, 0.0, "car").actor(len(actors) + 1))
            for look, (start, side, ahead) in zip(looks, walks, strict=True):
                gone = WALK_M_S * time_s
                place, yaw = on_road(start + ahead * gone, side * PAVEMENT_M)
                pose = walking(2 * np.pi * gone / GAIT_M, 1.0)
                actors.append(as_actor(len(actors) + 1, Walker(place[:2], yaw + np.pi * (ahead < 0), pose), look))
            yield Moment(tuple(actors), (), _lidar(time_s))
            time_s += PERIOD_S

    return Scene(palette, joined(still), Lights((0.0, 0.0, 30.0)), _lidar(0.0), moments())


def _car(palette: Palette, random: np.random.Generator) -> Mesh:
    mesh = random_object(palette, random, "vehicle")
    return mesh.moved(np.diag(random.uniform(*CAR_M) / np.ptp(mesh.vertices, axis=0)))


def _our_way_m(time_s: float) -> float:
    return START_M + SPEED_M_S * time_s + 1.5 * float(np.sin(0.7 * time_s))


def _lidar(time_s: float) -> RigidTransform:
    place, yaw = on_road(_our_way_m(time_s), -LANE_M)
    return RigidTransform.from_components(place + xyz(0, 0, LIDAR_M), Rotation.from_euler("z", yaw))


def _along(gap_m: float, random: np.random.Generator) -> Callable[[float], tuple[np.ndarray, float]]:
    """The way of a car in our lane, whose distance to ours changes."""
    phase = random.uniform(0, 2 * np.pi)
    return lambda time_s: on_road(_our_way_m(time_s) + gap_m + 2 * np.sin(0.5 * time_s + phase), -LANE_M)


def _towards(start_m: float) -> Callable[[float], tuple[np.ndarray, float]]:
    def at(time_s: float) -> tuple[np.ndarray, float]:
        place, yaw = on_road(start_m - SPEED_M_S * time_s, LANE_M)
        return place, yaw + np.pi

    return at
