"""The preset `objects`: an arrangement of procedural objects, of which some turn or slide slowly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.synthetic.arrangements import LABEL, Arrangement, Placed, room, table_top, with_track
from annotator.synthetic.mesh import joined, turn_z
from annotator.synthetic.scene import PERIOD_S, Actor, Moment, Scene

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
