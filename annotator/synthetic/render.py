"""Rendering with an ideal camera: colour, depth and object ids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.synthetic.materials import Lights, Palette, Surface, lamp_points, shaded, softened, tone_mapped
from annotator.synthetic.mesh import Mesh, joined
from annotator.synthetic.raycast import RayScene
from annotator.synthetic.silhouette import silhouette
from annotator.types import Camera

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
            palette: materials of all meshes.
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
