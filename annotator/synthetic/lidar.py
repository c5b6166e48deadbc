"""Simulation of a spinning LiDAR that measures the part of a scene that a camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int16
from scipy.spatial.transform import RigidTransform

from annotator.synthetic.materials import Lights, Palette, shaded, tone_mapped
from annotator.synthetic.mesh import Mesh
from annotator.synthetic.raycast import RayScene
from annotator.synthetic.render import surface_at


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR.

    Attributes:
        rings: number of lasers.
        lowest_rad, highest_rad: elevation of the first and the last laser.
        step_rad: angle between two measurements of a laser.
        noise_m: standard deviation of the distance.
        nearest_m, farthest_m: range.
        dropout: share of measurements that are lost.
    """

    rings: int = 64
    lowest_rad: float = -0.43
    highest_rad: float = 0.035
    step_rad: float = 0.0031
    noise_m: float = 0.015
    nearest_m: float = 2.0
    farthest_m: float = 70.0
    dropout: float = 0.03


@dataclass(frozen=True, eq=False)
class LidarPoints:
    """The measured points of one turn.

    Attributes:
        xyz_m: (n, 3) world frame.
        rgb: (n, 3) colours, 0..255, as a camera would see them.
        reflectance: (n,) 0..1.
        track: (n,) track id of the labelled object, 0 elsewhere.
    """

    xyz_m: Float32[np.ndarray, "n 3"]
    rgb: Float32[np.ndarray, "n 3"]
    reflectance: Float32[np.ndarray, "n"]
    track: Int16[np.ndarray, "n"]


def random_lidar(random: np.random.Generator) -> Lidar:
    """A LiDAR with 16 to 128 rings."""
    rings = int(random.choice([16, 32, 64, 64, 128]))
    return Lidar(
        rings,
        lowest_rad=float(random.uniform(-0.45, -0.26)),
        highest_rad=float(random.uniform(0.02, 0.26)),
        step_rad=float(random.choice([0.0015, 0.0031, 0.0035, 0.007])),
        noise_m=float(random.uniform(0.005, 0.03)),
        dropout=float(random.uniform(0.0, 0.15)),
    )


def scan(
    lidar: Lidar,
    T_world_lidar: RigidTransform,
    half_width_rad: float,
    mesh: Mesh,
    palette: Palette,
    lights: Lights,
    random: np.random.Generator,
) -> LidarPoints:
    """Measures the sector that the LiDAR sees on both sides of its y axis.

    Args:
        T_world_lidar: pose of the sensor, z along its axis of rotation.
        half_width_rad: half angle of the sector.
        mesh: all meshes, world frame.
    """
    elevation = np.linspace(lidar.lowest_rad, lidar.highest_rad, lidar.rings)
    azimuth = np.arange(-half_width_rad, half_width_rad, lidar.step_rad)
    e, a = (angles.ravel() for angles in np.meshgrid(elevation, azimuth, indexing="ij"))
    rays = np.stack([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)], axis=1)
    directions = T_world_lidar.rotation.apply(rays).astype(np.float32)
    origin = T_world_lidar.translation.astype(np.float32)
    hits = RayScene(mesh.vertices, mesh.triangles).first_hits(np.broadcast_to(origin, directions.shape), directions)
    kept = (hits.triangle >= 0) & (hits.t > lidar.nearest_m) & (hits.t < lidar.farthest_m)
    index = np.flatnonzero(kept & (random.random(len(directions)) >= lidar.dropout))
    surface = surface_at(mesh, hits.triangle[index], hits.uv[index], origin, hits.t[index], directions[index])
    base, key = shaded(palette, surface, lights)
    facing = np.abs((surface.normal * surface.view).sum(axis=1))
    albedo = palette.albedo(surface.material, surface.texture).mean(axis=1)
    reflectance = np.clip(albedo * (0.3 + 0.7 * facing) + random.normal(0, 0.04, len(index)), 0, 1)
    distance = hits.t[index] + random.normal(0, lidar.noise_m, len(index)).astype(np.float32)
    return LidarPoints(
        origin + distance[:, None] * directions[index],
        tone_mapped(base + key * np.float32(0.8)).astype(np.float32),
        reflectance.astype(np.float32),
        mesh.track[mesh.triangles[hits.triangle[index], 0]],
    )
