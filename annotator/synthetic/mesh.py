"""Triangle meshes from two kinds of parts: boxes with sharp edges, and blobs.

A blob is a generalised capsule: two half superellipsoids around two points, and the surface between them. With equal
points it is an ellipsoid, with a high power a cushion. Limbs, heads, torsos, fingers and pillows are all blobs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise, product

import numpy as np
from jaxtyping import Float, Float32, Float64, Int16, Int32
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

SEGMENTS = 18
RINGS = 5  # per half of a blob, without the pole
# Straight pieces of a ring or of the wall of a tube.
PIECES = 14

# Integers are allowed, too; the run-time type checks of the tests distinguish them from floats.
Number = float | int
Triple = tuple[Number, Number, Number]
Point = Float[np.ndarray, "3"]

FORWARD, LEFT, UP = IDENTITY = np.eye(3)
CUBE = np.array(list(product((-0.5, 0.5), repeat=3)))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with the attributes needed for rendering.

    Attributes:
        vertices: (v, 3) metres.
        texture: (v, 3) coordinates in the part's own solid texture, metres; they move with the part.
        material: (v,) row of the palette.
        track: (v,) track id of the labelled object, 0 for everything else.
        triangles: (t, 3) vertex indices.
    """

    vertices: Float32[np.ndarray, "v 3"]
    texture: Float32[np.ndarray, "v 3"]
    material: Int16[np.ndarray, "v"]
    track: Int16[np.ndarray, "v"]
    triangles: Int32[np.ndarray, "t 3"]

    def moved(self, linear: Float[np.ndarray, "3 3"], offset: Point | None = None) -> Mesh:
        """The mesh after mapping p to linear p + offset."""
        shift = np.zeros(3) if offset is None else offset
        return replace(self, vertices=self.vertices @ linear.T.astype(np.float32) + shift.astype(np.float32))

    def scaled(self, factor: float) -> Mesh:
        """The mesh enlarged by a factor about the origin."""
        return replace(self.moved(factor * IDENTITY), texture=self.texture * np.float32(max(factor, 0.05)))

    def tracked(self, track: int) -> Mesh:
        """The mesh with a track id."""
        return replace(self, track=np.full(len(self.vertices), track, np.int16))


def _part(vertices: np.ndarray, texture: np.ndarray, material: int, triangles: np.ndarray) -> Mesh:
    count = len(vertices)
    rows, track = np.full(count, material, np.int16), np.zeros(count, np.int16)
    return Mesh(vertices.astype(np.float32), texture.astype(np.float32), rows, track, triangles)


def joined(meshes: list[Mesh]) -> Mesh:
    """One mesh with all triangles in order."""
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.texture for mesh in meshes]),
        np.concatenate([mesh.material for mesh in meshes]),
        np.concatenate([mesh.track for mesh in meshes]),
        np.concatenate([mesh.triangles + np.int32(at) for mesh, at in zip(meshes, first, strict=False)]),
    )


def box_mesh(center: Triple | Point, size: Triple | Point, material: int, axes: np.ndarray = IDENTITY) -> Mesh:
    """A box with sharp edges; the columns of `axes` are its directions; metres."""
    local = CUBE * np.asarray(size, np.float64)
    return _part(local @ axes.T + np.asarray(center, np.float64), local, material, _hull_of_cube())


@cache
def _hull_of_cube() -> Int32[np.ndarray, "t 3"]:
    return ConvexHull(CUBE).simplices.astype(np.int32)


@dataclass
class Parts:
    """A builder of one mesh from many parts; metres, in the object's own coordinates."""

    meshes: list[Mesh] = field(default_factory=list)

    def blob(
        self,
        start: Point,
        end: Point,
        radii: tuple[Number, ...] | Point,
        material: int,
        *,
        end_radii: tuple[Number, ...] | None = None,
        side: Point | None = None,
        axes: Float[np.ndarray, "3 3"] | None = None,
        power: Number = 2.0,
    ) -> None:
        """Adds a blob.

        Args:
            start, end: centres of its two half ellipsoids.
            radii: half widths along `side`, across it, and along the axis (by default the mean of the first two).
            end_radii: half widths at `end` if they differ.
            side: direction of the first radius, not parallel to the axis; arbitrary if None.
            axes: columns = directions of the radii, in place of `side`.
            power: 2 = round; 8 or more = like a box with rounded edges.
        """
        at_end, triangles = _template()
        first, last = (np.array(r if len(r) == 3 else (*r, sum(r) / 2)) for r in (radii, end_radii or radii))
        axes = _blob_axes(np.asarray(end, np.float64) - start, side) if axes is None else axes
        local = _unit(power) * (first + (last - first) * at_end)
        texture = local + at_end * [0.0, 0.0, float(np.linalg.norm(end - start))]
        self.meshes.append(_part(local @ axes.T + start + (end - start) * at_end, texture, material, triangles))

    def ball(
        self,
        center: Point,
        radii: Triple | Point,
        material: int,
        *,
        axes: Float[np.ndarray, "3 3"] = IDENTITY,
        power: Number = 2.0,
    ) -> None:
        """Adds an ellipsoid with `radii` along the columns of `axes`; with a higher `power`, a cushion."""
        self.blob(center, center, tuple(float(radius) for radius in radii), material, axes=axes, power=power)

    def slab(self, center: Point, size: Point, material: int, axes: Float[np.ndarray, "3 3"] = IDENTITY) -> None:
        """Adds a box with sharp edges; columns of `axes` are its directions."""
        self.meshes.append(box_mesh(center, size, material, axes))

    def rod(
        self,
        start: Point,
        end: Point,
        radius: Number,
        material: int,
        *,
        end_radius: Number | None = None,
        power: Number = 2.0,
        side: Point | None = None,
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
        cap = 1.0 if round_ends else 0.04
        each = [(r * flatness, r, r * cap) for r in (radius, radius if end_radius is None else end_radius)]
        self.blob(start, end, each[0], material, end_radii=each[1], side=side, power=power)

    def ring(self, center: Point, axis: int, radius: float, thickness: float, material: int) -> None:
        """Adds a ring (tyre, handle) around a coordinate axis through `center`."""
        angles = np.linspace(0, 2 * np.pi, PIECES + 1)[:, None]
        u, v = IDENTITY[(axis + 1) % 3], IDENTITY[(axis + 2) % 3]
        for start, end in pairwise(center + radius * (np.cos(angles) * u + np.sin(angles) * v)):
            self.rod(start, end, thickness, material)

    def tube(self, base: Point, height: float, radius: float, top_radius: float, wall: float, material: int) -> None:
        """Adds the wall of an upright round vessel, open at the top and at the bottom."""
        length, lean = float(np.hypot(height, top_radius - radius)), np.arctan2(top_radius - radius, height)
        width = 2 * np.tan(np.pi / PIECES) * max(radius, top_radius)
        for angle in np.arange(PIECES) * 2 * np.pi / PIECES:
            axes = turn("zy", angle, lean)
            middle = base + turn("z", angle) @ xyz((radius + top_radius) / 2, 0, height / 2)
            self.slab(middle, np.array([wall, width, length]), material, axes)

    def mesh(self) -> Mesh:
        """All parts as one mesh."""
        return joined(self.meshes)


@cache
def _template() -> tuple[Float64[np.ndarray, "v 1"], Int32[np.ndarray, "t 3"]]:
    """The end to which each vertex of a blob belongs, 0 or 1, and its triangles."""
    at_end = np.concatenate([np.repeat([0.0, 1.0], RINGS * SEGMENTS), [0.0, 1.0]])
    triangles = []
    last, bottom = 2 * RINGS - 1, 2 * RINGS * SEGMENTS
    for j in range(SEGMENTS):
        k = (j + 1) % SEGMENTS
        triangles.append([bottom, k, j])
        triangles.append([bottom + 1, last * SEGMENTS + j, last * SEGMENTS + k])
        for ring in range(last):
            a, b = ring * SEGMENTS, (ring + 1) * SEGMENTS
            triangles += [[a + j, a + k, b + k], [a + j, b + k, b + j]]
    return at_end[:, None], np.array(triangles, np.int32)


@cache
def _unit(power: Number) -> Float64[np.ndarray, "v 3"]:
    """The vertices of a unit superellipsoid, rings from the bottom upwards (the equator twice), then the poles."""
    half = np.linspace(0, np.pi / 2, RINGS + 1)[1:]
    polar, around = np.meshgrid(
        np.concatenate([np.pi - half, half[::-1]]), np.arange(SEGMENTS) * 2 * np.pi / SEGMENTS, indexing="ij"
    )
    rings = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    n = np.concatenate([rings.reshape(-1, 3), [-UP, UP]])
    # the surface point in direction n has p-norm 1
    return np.asarray(n / np.linalg.norm(n, power, axis=1)[:, None])


def _blob_axes(axis: np.ndarray, side: np.ndarray | None) -> np.ndarray:
    """(3, 3) columns: `side` orthogonalised to the axis, the third direction, the axis."""
    z = axis / np.linalg.norm(axis)
    if side is None:
        side = IDENTITY[np.abs(z).argmin()]
    x = side - z * (side @ z)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def turn(axes: str, *angles: float) -> Float64[np.ndarray, "3 3"]:
    """The product of right-handed rotations about coordinate axes, radians: "yz" is R_y R_z."""
    return Rotation.from_euler(axes.upper(), angles).as_matrix().reshape(3, 3)


def xyz(x: Number, y: Number, z: Number) -> Float64[np.ndarray, "3"]:
    """A point or a displacement, metres."""
    return np.array([x, y, z], np.float64)


def grounded(mesh: Mesh) -> Mesh:
    """The mesh moved so that its box is centred above the origin and starts at z = 0."""
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    middle = (low + high) / 2
    return mesh.moved(IDENTITY, -xyz(middle[0], middle[1], low[2]))
