"""Single frames of random arrangements with exact ground truth, in memory: for training and for validation.

A snapshot is seen either by a depth camera or by a LiDAR beside a camera. Field of view, resolution, noise, range and
colours vary.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int16
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.projection import pixel_colors, project, unproject_depth
from annotator.synthetic.arrangements import INDOORS, Actor, Arrangement, street
from annotator.synthetic.mesh import Mesh, joined
from annotator.synthetic.render import Sensor, colour_image, depth_image, random_lidar, render, scan
from annotator.synthetic.scene import Scene, hands_scene
from annotator.types import Camera, Frame, OrientedBox, PointCloud

MIN_POINTS = 20
LIDAR_SHARE, HANDS_SHARE = 0.33, 0.1


@dataclass(frozen=True, eq=False)
class SnapshotObject:
    """An object of a snapshot.

    Attributes:
        box: around its whole surface, along its own axes; camera frame.
        points: mask of its points in the frame's cloud.
    """

    label: str
    box: OrientedBox
    points: Bool[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A frame and its objects with at least `MIN_POINTS` points."""

    frame: Frame
    objects: tuple[SnapshotObject, ...]


def snapshot(seed: int, version: int = 1) -> Snapshot:
    """The random frame of a seed; a frame of a depth camera or of a LiDAR.

    Args:
        seed: 0 or more; the same seed and version give the same frame.
        version: a second number of the seed, for example for validation frames.
    """
    random = np.random.default_rng([version, seed])
    choice = random.random()
    if choice < LIDAR_SHARE:
        return _lidar_snapshot(seed, street(random), random)
    if choice < LIDAR_SHARE + HANDS_SHARE:
        return _hands_snapshot(seed, random)
    arrange = INDOORS[int(random.integers(len(INDOORS)))]
    return _depth_snapshot(seed, arrange(random), random)


def _depth_snapshot(seed: int, scene: Arrangement, random: np.random.Generator) -> Snapshot:
    camera = _random_camera(random, 45.0, 95.0)
    return _depth_frame(seed, camera, scene, joined(scene.still), scene.actors, random)


def _hands_snapshot(seed: int, random: np.random.Generator) -> Snapshot:
    scene = hands_scene(random)
    for _ in range(int(random.integers(1, 12))):
        moment = next(scene.moments)
    still = joined([scene.still, *moment.rest])
    return _depth_frame(seed, _random_camera(random, 45.0, 75.0), scene, still, moment.actors, random)


def _depth_frame(
    seed: int,
    camera: Camera,
    scene: Scene | Arrangement,
    still: Mesh,
    actors: tuple[Actor, ...],
    random: np.random.Generator,
) -> Snapshot:
    sensor = _random_sensor(random)
    up = scene.T_world_camera.rotation.inv().apply([0.0, 0.0, 1.0])
    mesh = joined([still, *(actor.mesh for actor in actors)])
    ideal = render(camera, scene.T_world_camera, mesh, scene.palette, scene.lights)
    depth = depth_image(ideal, sensor, random).astype(np.float32) / 1000
    rgb = colour_image(ideal, random)
    xyz, pixel = unproject_depth(camera, depth)
    cloud = PointCloud(xyz, pixel_colors(rgb, pixel), pixel_index=pixel)
    frame = Frame(str(seed), 0, camera, rgb, cloud, depth, up)
    return Snapshot(frame, _seen(actors, scene.T_world_camera, ideal.track.ravel()[pixel]))


def _lidar_snapshot(seed: int, scene: Arrangement, random: np.random.Generator) -> Snapshot:
    actors = scene.actors
    camera = _random_camera(random, 55.0, 95.0, aspect=float(random.choice([0.3, 0.56, 0.75])))
    eye = scene.T_world_camera.translation + random.normal(0, 0.2, 3) + np.array([0.0, 0.0, 0.15])
    mesh = joined([*scene.still, *(actor.mesh for actor in actors)])
    half = np.arctan(camera.width_px / 2 / camera.fx) * 1.05
    pose = RigidTransform.from_components(eye, Rotation.identity())
    points = scan(random_lidar(random), pose, float(half), mesh, scene.palette, scene.lights, random)
    T_camera_world = scene.T_world_camera.inv()
    xyz = T_camera_world.apply(points.xyz_m).astype(np.float32)
    kind = random.random()
    cloud = PointCloud(
        xyz,
        points.rgb if kind < 0.2 else None,
        points.reflectance if kind < 0.9 else None,
    )
    u, v = project(camera, xyz).T
    # as readers do: points beyond the image are of no use, except near its border
    keep = (u > -0.1 * camera.width_px) & (u < 1.1 * camera.width_px) & (v > -0.1 * camera.height_px)
    keep &= v < 1.1 * camera.height_px
    up = T_camera_world.rotation.apply([0.0, 0.0, 1.0])
    blank = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    frame = Frame(str(seed), 0, camera, blank, cloud.select(keep), None, up)
    return Snapshot(frame, _seen(actors, scene.T_world_camera, points.track[keep]))


def _seen(
    actors: tuple[Actor, ...], T_world_camera: RigidTransform, track: Int16[np.ndarray, "n"]
) -> tuple[SnapshotObject, ...]:
    T_camera_world = T_world_camera.inv()
    objects = []
    for actor in actors:
        points = track == actor.track
        if points.sum() >= MIN_POINTS:
            objects.append(SnapshotObject(actor.label, actor.box(T_camera_world), points))
    return tuple(objects)


def _random_camera(random: np.random.Generator, least_deg: float, most_deg: float, aspect: float = 0.75) -> Camera:
    width = int(random.choice([240, 320, 400]))
    height = round(width * aspect)
    focal = width / 2 / np.tan(np.deg2rad(random.uniform(least_deg, most_deg)) / 2)
    return Camera(width, height, float(focal), float(focal), (width - 1) / 2, (height - 1) / 2)


def _random_sensor(random: np.random.Generator) -> Sensor:
    """From an ideal sensor to a poor one."""
    quality = random.uniform(0, 1.5)
    return Sensor(
        noise_floor_m=0.0008 * quality,
        noise_per_m2=0.0012 * quality,
        nearest_m=0.2,
        farthest_m=float(random.uniform(4, 10)),
        edge_loss=float(random.uniform(0, 0.8)),
        dropout=float(random.choice([0.0, 0.004, 0.05])),
    )
