"""Ray casting: an ideal camera, a colour and depth camera with noise, and a LiDAR beside a camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, Int32, UInt8, UInt16
from scipy.spatial.transform import RigidTransform

from annotator.geometry.projection import project
from annotator.synthetic.materials import Lights, Palette, Surface, shaded
from annotator.synthetic.mesh import Mesh
from annotator.types import Camera

# Shadow rays start slightly off their surface and end slightly before the lamp, shares of their length.
SHADOW_NEAR = 2e-3


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hits of n rays.

    Attributes:
        t: (n,) multiples of the ray's direction; infinite without a hit.
        triangle: (n,) triangle index, -1 without a hit.
        uv: (n, 2) barycentric weights of the triangle's second and third corner.
        normal: (n, 3) of the triangle, unit.
    """

    t: Float32[np.ndarray, "n"]
    triangle: Int32[np.ndarray, "n"]
    uv: Float32[np.ndarray, "n 2"]
    normal: Float32[np.ndarray, "n 3"]


class RayScene:
    """A triangle mesh for ray casting."""

    def __init__(self, vertices: Float32[np.ndarray, "v 3"], triangles: Int32[np.ndarray, "t 3"]) -> None:
        """Builds the search tree over triangles, given as vertex indices."""
        import open3d as o3d

        self._tensor: Any = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles.astype(np.uint32)))

    def first_hits(self, origins: Float32[np.ndarray, "*n 3"], directions: Float32[np.ndarray, "n 3"]) -> Hits:
        """The nearest triangle on each ray; triangles are hit from both sides."""
        hits = {name: values.numpy() for name, values in self._scene.cast_rays(self._rays(origins, directions)).items()}
        triangle = np.where(np.isfinite(hits["t_hit"]), hits["primitive_ids"].astype(np.int32), np.int32(-1))
        return Hits(hits["t_hit"], triangle, hits["primitive_uvs"], hits["primitive_normals"])

    def lit(self, surface: Surface, lamp_m: tuple[float, float, float]) -> Bool[np.ndarray, "n"]:
        """Which points nothing hides from a lamp."""
        rays = self._rays(surface.position, np.array(lamp_m, np.float32) - surface.position)
        blocked: np.ndarray = self._scene.test_occlusions(rays, tnear=SHADOW_NEAR, tfar=1.0 - SHADOW_NEAR).numpy()
        return ~blocked

    def _rays(self, origins: np.ndarray, directions: np.ndarray) -> Any:
        return self._tensor(np.concatenate([np.broadcast_to(origins, directions.shape), directions], axis=1))


def _surface(mesh: Mesh, hits: Hits, index: np.ndarray, origin: np.ndarray, directions: np.ndarray) -> Surface:
    """The surface points that those rays hit whose indices are given."""
    corners = mesh.triangles[hits.triangle[index]]
    weights = np.concatenate([1 - hits.uv[index].sum(axis=1, keepdims=True), hits.uv[index]], axis=1)
    view = directions[index] / np.linalg.norm(directions[index], axis=1, keepdims=True)
    facing = -(hits.normal[index] * view).sum(axis=1)
    return Surface(
        origin + hits.t[index, None] * directions[index],
        # towards the camera, since thin sheets are visible from both sides
        hits.normal[index] * np.where(facing < 0, np.float32(-1), np.float32(1))[:, None],
        np.abs(facing),
        np.einsum("nk,nkj->nj", weights, mesh.texture[corners]),
        mesh.material[corners[:, 0]],
        mesh.track[corners[:, 0]],
    )


@dataclass(frozen=True, eq=False)
class Rendering:
    """The ideal image of one moment.

    Attributes:
        rgb: (h, w, 3) colours.
        depth_m: (h, w) along the optical axis; 0 without a surface.
        track: (h, w) track id of the labelled object, 0 elsewhere.
        facing: (h, w) cosine between surface normal and view ray; 0 = grazing.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"]
    track: Int16[np.ndarray, "h w"]
    facing: Float32[np.ndarray, "h w"]


def render(camera: Camera, T_world_camera: RigidTransform, mesh: Mesh, palette: Palette, lights: Lights) -> Rendering:
    """The ideal image of a scene, given as one mesh in the world frame; the camera has no distortion."""
    shape = (camera.height_px, camera.width_px)
    origin, directions = _rays(camera, T_world_camera, np.zeros(2, int), np.array(shape[::-1]))
    scene = RayScene(mesh.vertices, mesh.triangles)
    hits = scene.first_hits(origin, directions)
    index = np.flatnonzero(hits.triangle >= 0)
    surface = _surface(mesh, hits, index, origin, directions)
    colours = shaded(
        palette.albedo(surface.material, surface.texture), surface, lights, scene.lit(surface, lights.lamp_m)
    )

    def image(values: np.ndarray) -> np.ndarray:
        whole = np.zeros((shape[0] * shape[1], *values.shape[1:]), values.dtype)
        whole[index] = values
        return whole.reshape(*shape, *values.shape[1:])

    return Rendering(image(colours), image(hits.t[index]), image(surface.track), image(surface.facing))


def _rays(
    camera: Camera, T_world_camera: RigidTransform, low_px: np.ndarray, high_px: np.ndarray
) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "n 3"]]:
    """The camera's position, and rays through the centres of pixels, row by row; z = 1 in the camera frame, so that t
    is the depth."""
    v, u = np.mgrid[low_px[1] : high_px[1], low_px[0] : high_px[0]]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    directions = T_world_camera.rotation.apply(rays.reshape(-1, 3)).astype(np.float32)
    return T_world_camera.translation.astype(np.float32), directions


def whole_px(camera: Camera, T_world_camera: RigidTransform, mesh: Mesh) -> int:
    """The number of pixels that a mesh covers without occlusion on an image extended by half its longer side.

    All pixels of the image if a part of the mesh is beside or behind the camera.
    """
    px = project(camera, T_world_camera.inv().apply(mesh.vertices.astype(np.float64)))
    size = np.array([camera.width_px, camera.height_px])
    if not np.isfinite(px).all():
        return int(size.prod())
    low, high = (np.clip(ends, -size.max() // 2, size + size.max() // 2) for ends in (px.min(axis=0), px.max(axis=0)))
    rays = _rays(camera, T_world_camera, np.floor(low).astype(int), np.ceil(high).astype(int) + 1)
    return int((RayScene(mesh.vertices, mesh.triangles).first_hits(*rays).triangle >= 0).sum())


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR.

    Attributes:
        lowest_rad, highest_rad: elevation of the first and the last laser.
        step_rad: angle between two measurements of a laser.
        noise_m: standard deviation of the distance.
        nearest_m, farthest_m: range.
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
        rgb: (n, 3) colours as a camera would see them.
        reflectance: (n,) 0..1.
        track: (n,) track id of the labelled object, 0 elsewhere.
    """

    xyz_m: Float32[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
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
    directions = T_world_lidar.rotation.apply(_lidar_rays(lidar, half_width_rad)).astype(np.float32)
    origin = T_world_lidar.translation.astype(np.float32)
    scene = RayScene(mesh.vertices, mesh.triangles)
    hits = scene.first_hits(origin, directions)
    kept = (hits.triangle >= 0) & (hits.t > lidar.nearest_m) & (hits.t < lidar.farthest_m)
    index = np.flatnonzero(kept & (random.random(len(directions)) >= lidar.dropout))
    surface = _surface(mesh, hits, index, origin, directions)
    albedo = palette.albedo(surface.material, surface.texture)
    reflectance = np.clip(albedo.mean(axis=1) * (0.3 + 0.7 * surface.facing) + random.normal(0, 0.04, len(index)), 0, 1)
    distance = hits.t[index] + random.normal(0, lidar.noise_m, len(index)).astype(np.float32)
    return LidarPoints(
        origin + distance[:, None] * directions[index],
        shaded(albedo, surface, lights, scene.lit(surface, lights.lamp_m)),
        reflectance.astype(np.float32),
        surface.track,
    )


@lru_cache(maxsize=4)
def _lidar_rays(lidar: Lidar, half_width_rad: float) -> Float64[np.ndarray, "n 3"]:
    """Unit vectors, LiDAR frame."""
    elevation = np.linspace(lidar.lowest_rad, lidar.highest_rad, lidar.rings)
    azimuth = np.arange(-half_width_rad, half_width_rad, lidar.step_rad)
    e, a = (angles.ravel() for angles in np.meshgrid(elevation, azimuth, indexing="ij"))
    return np.stack([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)], axis=1)


def whole_points(lidar: Lidar, T_world_lidar: RigidTransform, mesh: Mesh) -> int:
    """The number of points that a LiDAR would measure on a mesh if nothing hid it."""
    vertices = T_world_lidar.inv().apply(mesh.vertices.astype(np.float64))
    towards = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    middle = towards.mean(axis=0)
    rays = _lidar_rays(lidar, np.pi)
    rays = rays[rays @ middle >= (towards @ middle).min()].astype(np.float32)
    hits = RayScene(vertices.astype(np.float32), mesh.triangles).first_hits(np.zeros(3, np.float32), rays)
    return int(((hits.t > lidar.nearest_m) & (hits.t < lidar.farthest_m)).sum())


# Simulation of a colour camera and a depth camera, from an ideal image.
#
# The depth noise grows with the square of the distance, as for triangulating cameras (see Nguyen, Izadi, Lovell,
# "Modeling Kinect Sensor Noise", 3DIMPVT 2012). Depth is missing at grazing angles, along depth edges and in random
# pixels, and is rounded to whole millimetres.


# Below this cosine between normal and ray, depth is increasingly often missing.
GRAZING_COS = 0.17
# Relative depth step between neighbours that counts as an edge.
EDGE_STEP = 0.02
# Blur of the colour image, and standard deviation of its colours, 0..255.
BLUR_PX, COLOUR_NOISE = 0.55, 2.2


@dataclass(frozen=True)
class Sensor:
    """The imperfections of the depth camera.

    Attributes:
        noise_floor_m, noise_per_m2: standard deviation of depth = floor + per_m2 * z^2.
        nearest_m, farthest_m: range of depth measurements.
        edge_loss: share of edge pixels that lose their depth.
        dropout: share of all pixels that lose their depth.
    """

    noise_floor_m: float = 0.0008
    noise_per_m2: float = 0.0009
    nearest_m: float = 0.25
    farthest_m: float = 8.0
    edge_loss: float = 0.55
    dropout: float = 0.004


def depth_image(ideal: Rendering, sensor: Sensor, random: np.random.Generator) -> UInt16[np.ndarray, "h w"]:
    """The measured depth in millimetres; 0 = no measurement."""
    import cv2

    z = ideal.depth_m
    sigma = np.float32(sensor.noise_floor_m) + np.float32(sensor.noise_per_m2) * z * z
    # Half of the variance is shared by neighbours, since depth is measured over windows. A Gaussian of 1.2 px divides
    # the deviation of white noise by 2 sqrt(pi) 1.2.
    white, coarse = random.standard_normal((2, *z.shape), np.float32)
    noise = (white + cv2.GaussianBlur(coarse, (0, 0), 1.2) * np.float32(2 * np.pi**0.5 * 1.2)) / np.float32(2**0.5)
    kernel = np.ones((3, 3), np.uint8)
    is_edge = cv2.dilate(z, kernel) - cv2.erode(z, kernel) > EDGE_STEP * z
    grazing, at_edge, anywhere = random.random((3, *z.shape), np.float32)
    lost = (z < sensor.nearest_m) | (z > sensor.farthest_m) | (grazing > ideal.facing / np.float32(GRAZING_COS))
    lost |= (is_edge & (at_edge < sensor.edge_loss)) | (anywhere < sensor.dropout)
    return np.where(lost, 0, np.rint((z + sigma * noise) * 1000)).clip(0, 65535).astype(np.uint16)


def colour_image(ideal: Rendering, random: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """The colour camera's image, with blur and noise."""
    import cv2

    blurred = cv2.GaussianBlur(ideal.rgb, (0, 0), BLUR_PX).astype(np.float32)
    blurred += np.float32(COLOUR_NOISE) * random.standard_normal(blurred.shape, np.float32)
    return np.clip(blurred + 0.5, 0, 255).astype(np.uint8)
