"""A builder of meshes from slabs, rods, balls, rings and shells, in any orientation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float64

from annotator.synthetic.mesh import Blobs, Mesh, Number, box_mesh, joined

IDENTITY = np.eye(3)
# Straight pieces of a ring or of the wall of a tube.
PIECES = 14


def xyz(x: Number, y: Number, z: Number) -> Float64[np.ndarray, "3"]:
    """A point or a displacement, metres."""
    return np.array([x, y, z], np.float64)


@dataclass
class Parts:
    """Collects the parts of one object; metres, in the object's own coordinates."""

    _meshes: list[Mesh] = field(default_factory=list)
    _blobs: Blobs = field(default_factory=Blobs)
    _has_blobs: bool = False

    def slab(
        self,
        center: Float[np.ndarray, "3"],
        size: Float[np.ndarray, "3"],
        material: int,
        axes: Float[np.ndarray, "3 3"] = IDENTITY,
    ) -> None:
        """Adds a box with sharp edges; columns of `axes` are its directions."""
        x, y, z = (float(side) for side in size)
        self._meshes.append(box_mesh((0.0, 0.0, 0.0), (x, y, z), material).moved(axes, np.asarray(center, np.float64)))

    def rod(
        self,
        start: Float[np.ndarray, "3"],
        end: Float[np.ndarray, "3"],
        radius: Number,
        material: int,
        *,
        end_radius: Number | None = None,
        power: Number = 2.0,
        side: Float[np.ndarray, "3"] | None = None,
        flatness: Number = 1.0,
        round_ends: bool = True,
    ) -> None:
        """Adds a capsule, a cylinder or a cone between two points.

        Args:
            radius, end_radius: at `start` and at `end`.
            power: shape of the cross-section: 2 = round, 8 = square.
            side: direction along which the radius is multiplied by `flatness`.
            round_ends: half balls at the ends, as of a capsule; otherwise flat ends.
        """
        last = radius if end_radius is None else end_radius
        caps = (1.0, 1.0) if round_ends else (0.04, 0.04)
        self._blobs.add(
            np.asarray(start, np.float64),
            np.asarray(end, np.float64),
            (radius * flatness, radius, radius * caps[0]),
            material,
            end_radii=(last * flatness, last, last * caps[1]),
            side=side,
            power=power,
        )
        self._has_blobs = True

    def ball(
        self,
        center: Float[np.ndarray, "3"],
        radii: Float[np.ndarray, "3"],
        material: int,
        *,
        axes: Float[np.ndarray, "3 3"] = IDENTITY,
        power: Number = 2.0,
    ) -> None:
        """Adds an ellipsoid; with a higher `power`, a cushion."""
        a, b, c = (float(radius) for radius in radii)
        self._blobs.ball(np.asarray(center, np.float64), (a, b, c), material, axes=np.asarray(axes), power=power)
        self._has_blobs = True

    def ring(self, center: Float[np.ndarray, "3"], axis: int, radius: float, thickness: float, material: int) -> None:
        """Adds a ring (tyre, handle) around a coordinate axis through `center`."""
        u, v = IDENTITY[(axis + 1) % 3], IDENTITY[(axis + 2) % 3]
        angles = np.linspace(0, 2 * np.pi, PIECES + 1)
        points = center + radius * (np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v)
        for start, end in pairwise(points):
            self.rod(start, end, thickness, material)

    def tube(
        self, base: Float[np.ndarray, "3"], height: float, radius: float, top_radius: float, wall: float, material: int
    ) -> None:
        """Adds the wall of an upright round vessel, open at the top and at the bottom."""
        for k in range(PIECES):
            angle = 2 * np.pi * k / PIECES
            outward = np.array([np.cos(angle), np.sin(angle), 0.0])
            across = np.array([-np.sin(angle), np.cos(angle), 0.0])
            along = (top_radius - radius) * outward + np.array([0.0, 0.0, height])
            length = float(np.linalg.norm(along))
            axes = np.stack([np.cross(across, along / length), across, along / length], axis=1)
            width = 2 * np.tan(np.pi / PIECES) * max(radius, top_radius)
            middle = base + radius * outward + along / 2
            self.slab(middle, np.array([wall, width, length]), material, axes)

    def add(self, mesh: Mesh) -> None:
        """Adds a finished mesh."""
        self._meshes.append(mesh)

    def mesh(self) -> Mesh:
        """All parts as one mesh."""
        return joined([*self._meshes, self._blobs.mesh()] if self._has_blobs else self._meshes)


def mirrored(mesh: Mesh) -> Mesh:
    """The mesh together with its mirror image in the plane y = 0."""
    return joined([mesh, mesh.moved(np.diag([1.0, -1.0, 1.0]), np.zeros(3))])


def scaled(mesh: Mesh, factor: float) -> Mesh:
    """The mesh enlarged by a factor about the origin."""
    return replace(
        mesh, vertices=mesh.vertices * np.float32(factor), texture=mesh.texture * np.float32(max(factor, 0.05))
    )


def stretched(mesh: Mesh, factors: Float64[np.ndarray, "3"]) -> Mesh:
    """The mesh stretched along the coordinate axes."""
    normals = mesh.normals / factors.astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return replace(mesh, vertices=mesh.vertices * factors.astype(np.float32), normals=normals)
