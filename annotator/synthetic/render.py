"""Ray casting: an ideal camera, a colour and depth camera with noise, and a LiDAR beside a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, Int32, UInt8, UInt16
from scipy.spatial.transform import RigidTransform

from annotator.geometry.projection import project
from annotator.synthetic.materials import Lights, Palette, Surface, lamp_points, shaded, softened, tone_mapped
from annotator.synthetic.mesh import Mesh, joined
from annotator.types import Camera

# Shadow rays start slightly off their surface and end slightly before the lamp.
SHADOW_NEAR = 2e-3


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hits of n rays.

    Attributes:
        t: (n,) multiples of the ray's direction; infinite without a hit.
        triangle: (n,) triangle index, -1 without a hit.
        uv: (n, 2) barycentric weights of the triangle's second and third corner.
    """

    t: Float32[np.ndarray, "n"]
    triangle: Int32[np.ndarray, "n"]
    uv: Float32[np.ndarray, "n 2"]


class RayScene:
    """A triangle mesh for ray casting."""

    def __init__(self, vertices: Float32[np.ndarray, "v 3"], triangles: Int32[np.ndarray, "t 3"]) -> None:
        """Builds the search tree over triangles, given as vertex indices."""
        import open3d as o3d

        self._tensor: Any = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles.astype(np.uint32)))

    def first_hits(self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]) -> Hits:
        """The nearest triangle on each ray; triangles are hit from both sides."""
        hits = self._scene.cast_rays(self._rays(origins, directions))
        t = hits["t_hit"].numpy()
        triangle = hits["primitive_ids"].numpy().astype(np.int32)
        return Hits(t, np.where(np.isfinite(t), triangle, np.int32(-1)), hits["primitive_uvs"].numpy())

    def blocked(
        self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, "n"]:
        """Which rays hit something between origin and origin + direction."""
        rays = self._rays(origins, directions)
        blocked: np.ndarray = self._scene.test_occlusions(rays, tnear=SHADOW_NEAR, tfar=1.0 - SHADOW_NEAR).numpy()
        return blocked

    def _rays(self, origins: np.ndarray, directions: np.ndarray) -> Any:
        return self._tensor(np.concatenate([origins, directions], axis=1))


def silhouette(
    camera: Camera, T_camera_world: RigidTransform, mesh: Mesh, border_px: int = 0
) -> UInt8[np.ndarray, "h w"] | None:
    """A mask of the pixels that `mesh` (world frame) covers without occlusion, accurate to a pixel.

    A convex part covers the convex hull of its projected vertices.

    Returns:
        the mask (1 inside, 0 outside) with `border_px` additional pixels on every side; None if a part of the mesh is
        beside or behind the camera.
    """
    import cv2

    px = project(camera, T_camera_world.apply(mesh.vertices.astype(np.float64))) + border_px
    if not np.isfinite(px).all():
        return None
    mask = np.zeros((camera.height_px + 2 * border_px, camera.width_px + 2 * border_px), np.uint8)
    starts = np.flatnonzero(np.diff(mesh.parts, prepend=-1))
    for part in np.split(np.rint(px).astype(np.int32), starts[1:]):
        cv2.fillConvexPoly(mask, cv2.convexHull(part), 1)
    return mask


# Rays to the lamp start this far off their surface.
LIFT_M = np.float32(2e-3)
# Margin around the silhouettes of moving meshes within which rays are cast; silhouettes are accurate to a pixel.
MARGIN_PX = 2


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


@dataclass(frozen=True, eq=False)
class _Layer:
    """The n pixels of an image, row by row, without the shadows that moving meshes cast.

    Attributes:
        depth_m: (n,) 0 without a surface.
        base, key: (n, 3) linear colour without the lamp, and the lamp's contribution if it is visible.
        start, to_lamp: (n, 3) the ray from just above the surface to the lamp, world frame.
        lit: (n,) True if no static mesh blocks this ray.
        facing, track: as in `Rendering`.
    """

    depth_m: Float32[np.ndarray, "n"]
    base: Float32[np.ndarray, "n 3"]
    key: Float32[np.ndarray, "n 3"]
    start: Float32[np.ndarray, "n 3"]
    to_lamp: Float32[np.ndarray, "n 3"]
    lit: Bool[np.ndarray, "n"]
    facing: Float32[np.ndarray, "n"]
    track: Int16[np.ndarray, "n"]

    @classmethod
    def empty(cls, n: int) -> _Layer:
        """A layer without surfaces."""
        base, key, start, to_lamp = np.zeros((4, n, 3), np.float32)
        depth_m, facing = np.zeros((2, n), np.float32)
        return cls(depth_m, base, key, start, to_lamp, np.zeros(n, bool), facing, np.zeros(n, np.int16))

    def copy(self) -> _Layer:
        """A deep copy."""
        return _Layer(**{name: values.copy() for name, values in vars(self).items()})


class Stage:
    """A camera and the static part of its scene; moving meshes are drawn onto it for each image.

    The static part is cast and shaded once. For each image, rays are cast only around the moving meshes, and shadows
    are tested only against them.
    """

    def __init__(
        self, camera: Camera, T_world_camera: RigidTransform, still: Mesh, palette: Palette, lights: Lights
    ) -> None:
        """
        Args:
            camera: without distortion.
            still: the static mesh, world frame.
        """
        self.camera, self._palette, self._lights = camera, palette, lights
        self._T_camera_world = T_world_camera.inv()
        self._origin = T_world_camera.translation.astype(np.float32)
        self._directions = _directions(camera, T_world_camera)
        self._scene = RayScene(still.vertices, still.triangles)
        self._backdrop = _Layer.empty(len(self._directions))
        self._draw(self._backdrop, self._scene, still, np.arange(len(self._directions)))

    def render(self, moving: list[Mesh]) -> Rendering:
        """The image with the given moving meshes (world frame)."""
        mesh = joined(moving)
        scene = RayScene(mesh.vertices, mesh.triangles)
        layer = self._backdrop.copy()
        region = np.logical_or.reduce([self._surroundings(each) for each in moving])
        self._draw(layer, scene, mesh, np.flatnonzero(region))
        lit = np.flatnonzero(layer.lit)
        layer.lit[lit] = ~scene.blocked(layer.start[lit], layer.to_lamp[lit])
        return self._rendering(layer)

    def _draw(self, layer: _Layer, scene: RayScene, mesh: Mesh, pixels: np.ndarray) -> None:
        """Draws `mesh` at those `pixels` where it is nearer than the surfaces drawn before."""
        directions = self._directions[pixels]
        hits = scene.first_hits(np.broadcast_to(self._origin, directions.shape), directions)
        drawn = layer.depth_m[pixels]
        nearer = np.flatnonzero((hits.triangle >= 0) & ((drawn == 0) | (hits.t < drawn)))
        at, t = pixels[nearer], hits.t[nearer]
        surface = surface_at(mesh, hits.triangle[nearer], hits.uv[nearer], self._origin, t, directions[nearer])
        layer.depth_m[at] = t
        layer.facing[at] = np.abs((surface.normal * surface.view).sum(axis=1))
        layer.track[at] = mesh.track[mesh.triangles[hits.triangle[nearer], 0]]
        layer.start[at] = surface.position + LIFT_M * surface.normal
        layer.to_lamp[at] = lamp_points(self._lights, at, self.camera.width_px) - layer.start[at]
        layer.base[at], layer.key[at] = shaded(self._palette, surface, self._lights)
        layer.lit[at] = ~self._scene.blocked(layer.start[at], layer.to_lamp[at])

    def _surroundings(self, mesh: Mesh) -> Bool[np.ndarray, "n"]:
        """The pixels at which a mesh may be visible; all pixels if it extends behind the camera."""
        import cv2

        outline = silhouette(self.camera, self._T_camera_world, mesh)
        if outline is None:
            return np.ones(self.camera.width_px * self.camera.height_px, bool)
        return np.asarray(cv2.dilate(outline, np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)).ravel() > 0)

    def _rendering(self, layer: _Layer) -> Rendering:
        shape = (self.camera.height_px, self.camera.width_px)
        depth = layer.depth_m.reshape(shape)
        lit = softened(layer.lit.reshape(shape).astype(np.float32), depth)
        rgb = tone_mapped(layer.base + layer.key * lit.reshape(-1, 1))
        return Rendering(rgb.reshape(*shape, 3), depth, layer.track.reshape(shape), layer.facing.reshape(shape))


def _directions(camera: Camera, T_world_camera: RigidTransform) -> Float32[np.ndarray, "n 3"]:
    """The rays through all pixel centres, scaled to z = 1 in the camera frame, so that t is the depth."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    rotation: Float64[np.ndarray, "3 3"] = T_world_camera.rotation.as_matrix()
    return (rays.reshape(-1, 3) @ rotation.T).astype(np.float32)


def surface_at(
    mesh: Mesh, triangle: np.ndarray, uv: np.ndarray, origin: np.ndarray, t: np.ndarray, directions: np.ndarray
) -> Surface:
    """The surface points that rays hit, from triangle indices, barycentric weights (n, 2) and t along each ray."""
    corners = mesh.triangles[triangle]
    weights = np.concatenate([1 - uv.sum(axis=1, keepdims=True), uv], axis=1)
    normal = _blend(mesh.normals, corners, weights)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    view = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    # flipped towards the camera, since thin sheets are visible from both sides
    normal *= np.where((normal * view).sum(axis=1) < 0, np.float32(-1), np.float32(1))[:, None]
    return Surface(
        origin + t[:, None] * directions,
        normal,
        _blend(mesh.texture, corners, weights),
        mesh.material[corners[:, 0]],
        view,
    )


def _blend(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Vertex values interpolated at points inside triangles."""
    blended: np.ndarray = weights[:, :1] * values[corners[:, 0]]
    for k in (1, 2):
        blended += weights[:, k : k + 1] * values[corners[:, k]]
    return blended


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


# Simulation of a colour camera and a depth camera, from an ideal image.
#
# The depth noise grows with the square of the distance, as for triangulating cameras (see Nguyen, Izadi, Lovell,
# "Modeling Kinect Sensor Noise", 3DIMPVT 2012). Depth is missing at grazing angles, along depth edges and in random
# pixels, and is rounded to whole millimetres.


@dataclass(frozen=True)
class Sensor:
    """The imperfections of the two cameras.

    Attributes:
        noise_floor_m, noise_per_m2: standard deviation of depth = floor + per_m2 * z^2.
        nearest_m, farthest_m: range of depth measurements.
        grazing_cos: below this cosine between normal and ray, depth is increasingly often missing.
        edge_step: relative depth step between neighbours that counts as an edge.
        edge_loss: share of edge pixels that lose their depth.
        dropout: share of all pixels that lose their depth, in small clusters.
        blur_px: blur of the colour image.
        colour_noise: standard deviation of the colours, 0..255.
    """

    noise_floor_m: float = 0.0008
    noise_per_m2: float = 0.0009
    nearest_m: float = 0.25
    farthest_m: float = 8.0
    grazing_cos: float = 0.17
    edge_step: float = 0.02
    edge_loss: float = 0.55
    dropout: float = 0.004
    blur_px: float = 0.55
    colour_noise: float = 2.2


def depth_image(ideal: Rendering, sensor: Sensor, random: np.random.Generator) -> UInt16[np.ndarray, "h w"]:
    """The measured depth in millimetres; 0 = no measurement."""
    z = ideal.depth_m
    sigma = np.float32(sensor.noise_floor_m) + np.float32(sensor.noise_per_m2) * z * z
    measured = z + sigma * _correlated_noise(z.shape, random)
    lost = (z < sensor.nearest_m) | (z > sensor.farthest_m)
    lost |= random.random(z.shape, np.float32) > ideal.facing / np.float32(sensor.grazing_cos)
    lost |= _edges(z, sensor.edge_step) & (random.random(z.shape, np.float32) < sensor.edge_loss)
    lost |= _clusters(z.shape, sensor.dropout, random)
    return np.where(lost, 0, np.rint(measured * 1000)).clip(0, 65535).astype(np.uint16)


def colour_image(ideal: Rendering, sensor: Sensor, random: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """The colour camera's image, with blur, vignetting and noise."""
    import cv2

    blurred = cv2.GaussianBlur(ideal.rgb, (0, 0), sensor.blur_px).astype(np.float32)
    height, width = blurred.shape[:2]
    x, y = np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32)
    blurred *= (1 - 0.08 * (x**2 + y[:, None] ** 2))[:, :, None]
    blurred += np.float32(sensor.colour_noise) * random.standard_normal((height, width, 1), np.float32)
    blurred += np.float32(0.5 * sensor.colour_noise) * random.standard_normal(blurred.shape, np.float32)
    return np.clip(blurred + 0.5, 0, 255).astype(np.uint8)


def _correlated_noise(shape: tuple[int, ...], random: np.random.Generator) -> Float32[np.ndarray, "h w"]:
    """Unit noise with half of its variance correlated between neighbours, since depth is measured over windows."""
    import cv2

    independent = random.standard_normal(shape, np.float32)
    # a Gaussian of 1.2 px divides the deviation of white noise by 2 sqrt(pi) 1.2
    shared = cv2.GaussianBlur(random.standard_normal(shape, np.float32), (0, 0), 1.2) * np.float32(2 * np.pi**0.5 * 1.2)
    return np.asarray((independent + shared) * np.float32(0.5**0.5))


def _edges(z: np.ndarray, step: float) -> np.ndarray:
    """Pixels next to a jump in depth."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(z, kernel) - cv2.erode(z, kernel) > step * z)


def _clusters(shape: tuple[int, ...], share: float, random: np.random.Generator) -> np.ndarray:
    """A random share of the pixels, in clusters of 2 x 2."""
    height, width = shape
    clusters = random.random(((height + 1) // 2, (width + 1) // 2), np.float32) < share
    return np.repeat(np.repeat(clusters, 2, axis=0), 2, axis=1)[:height, :width]
