"""Triangle meshes from two kinds of parts: boxes with sharp edges, and blobs.

A blob is a generalised capsule: two half superellipsoids around two points, and the surface between them. With equal
points it is an ellipsoid, with a high power a cushion. Limbs, heads, torsos, fingers and pillows are all blobs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Float64, Int16, Int32

SEGMENTS = 18
RINGS = 5  # per half of a blob, without the pole

# Integers are allowed, too; the run-time type checks of the tests distinguish them from floats.
Number = float | int
Triple = tuple[Number, Number, Number]

IDENTITY = np.eye(3)
# Straight pieces of a ring or of the wall of a tube.
PIECES = 14
BOX_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with the attributes needed for rendering.

    Attributes:
        vertices: (v, 3) metres.
        normals: (v, 3) unit.
        texture: (v, 3) coordinates in the part's own solid texture, metres; they move with the part.
        material: (v,) row of the palette.
        track: (v,) track id of the labelled object, 0 for everything else.
        triangles: (t, 3) vertex indices.
        parts: (v,) index of the convex part within this mesh.
    """

    vertices: Float32[np.ndarray, "v 3"]
    normals: Float32[np.ndarray, "v 3"]
    texture: Float32[np.ndarray, "v 3"]
    material: Int16[np.ndarray, "v"]
    track: Int16[np.ndarray, "v"]
    triangles: Int32[np.ndarray, "t 3"]
    parts: Int32[np.ndarray, "v"]

    def moved(self, linear: Float[np.ndarray, "3 3"], offset: Float[np.ndarray, "3"]) -> Mesh:
        """The mesh after mapping p to linear p + offset; `linear` is orthogonal and may be a reflection."""
        matrix = linear.astype(np.float32)
        vertices = self.vertices @ matrix.T + offset.astype(np.float32)
        return replace(self, vertices=vertices, normals=self.normals @ matrix.T)


def joined(meshes: list[Mesh]) -> Mesh:
    """One mesh with all triangles in order; parts are renumbered."""
    vertex_offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    part_offsets = np.cumsum([0] + [int(mesh.parts.max(initial=-1)) + 1 for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.texture for mesh in meshes]),
        np.concatenate([mesh.material for mesh in meshes]),
        np.concatenate([mesh.track for mesh in meshes]),
        np.concatenate([m.triangles + np.int32(at) for m, at in zip(meshes, vertex_offsets, strict=False)]),
        np.concatenate([m.parts + np.int32(at) for m, at in zip(meshes, part_offsets, strict=False)]),
    )


@dataclass
class Parts:
    """A builder of one mesh from many parts; metres, in the object's own coordinates.

    Attributes:
        track: track id for the blobs that are added next.
    """

    track: int = 0
    _meshes: list[Mesh] = field(default_factory=list)
    _ends: list[np.ndarray] = field(default_factory=list)
    _radii: list[np.ndarray] = field(default_factory=list)
    _axes: list[np.ndarray] = field(default_factory=list)
    _numbers: list[tuple[Number, int, int]] = field(default_factory=list)

    def blob(
        self,
        start: np.ndarray,
        end: np.ndarray,
        radii: tuple[float, float] | tuple[float, float, float],
        material: int,
        *,
        end_radii: tuple[float, float] | tuple[float, float, float] | None = None,
        side: np.ndarray | None = None,
        power: Number = 2.0,
    ) -> None:
        """Adds a blob from `start` to `end`, metres.

        Args:
            start, end: (3,) centres of its two half ellipsoids.
            radii: half widths along `side`, across it, and along the axis (by default the mean of the first two).
            end_radii: half widths at `end` if they differ.
            side: (3,) direction of the first radius, not parallel to the axis; arbitrary if None.
            power: 2 = round; 8 or more = like a box with rounded edges.
        """
        self._ends.append(np.stack([start, end]))
        self._radii.append(np.array([_three(radii), _three(end_radii or radii)]))
        self._axes.append(_blob_axes(np.asarray(end, np.float64) - start, side))
        self._numbers.append((power, material, self.track))

    def ball(
        self,
        center: np.ndarray,
        radii: tuple[float, float, float] | Float[np.ndarray, "3"],
        material: int,
        *,
        axes: Float[np.ndarray, "3 3"] = IDENTITY,
        power: Number = 2.0,
    ) -> None:
        """Adds an ellipsoid with `radii` along the columns of `axes`; with a higher `power`, a cushion."""
        self._ends.append(np.stack([center, center]))
        self._radii.append(np.array([radii, radii]))
        self._axes.append(axes)
        self._numbers.append((power, material, self.track))

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
        self.blob(
            np.asarray(start, np.float64),
            np.asarray(end, np.float64),
            (radius * flatness, radius, radius * caps[0]),
            material,
            end_radii=(last * flatness, last, last * caps[1]),
            side=side,
            power=power,
        )

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
        return joined([*self._meshes, *([self._blobs()] if self._ends else [])])

    def _blobs(self) -> Mesh:
        n, s, triangles = _template()
        ends, radii = np.array(self._ends), np.array(self._radii)
        power = np.array([number[0] for number in self._numbers])[:, None, None]
        axes = np.array(self._axes)
        # superellipsoid: the surface point in direction n has p-norm 1
        unit = n / (np.abs(n) ** power).sum(axis=2, keepdims=True) ** (1 / power)
        blend = s[None, :, None]
        scale = radii[:, :1] * (1 - blend) + radii[:, 1:] * blend
        local = unit * scale
        centers = ends[:, :1] * (1 - blend) + ends[:, 1:] * blend
        slopes = np.sign(unit) * np.abs(unit) ** (power - 1) / scale
        slopes /= np.linalg.norm(slopes, axis=2, keepdims=True)
        to_world = axes.transpose(0, 2, 1)
        count, size = local.shape[:2]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)[:, None]
        texture = local.copy()
        texture[:, :, 2] += s * length
        return Mesh(
            (local @ to_world + centers).reshape(-1, 3).astype(np.float32),
            (slopes @ to_world).reshape(-1, 3).astype(np.float32),
            texture.reshape(-1, 3).astype(np.float32),
            np.repeat(np.array([number[1] for number in self._numbers], np.int16), size),
            np.repeat(np.array([number[2] for number in self._numbers], np.int16), size),
            (triangles[None] + (np.arange(count) * size)[:, None, None]).reshape(-1, 3).astype(np.int32),
            np.repeat(np.arange(count, dtype=np.int32), size),
        )


def box_mesh(center: Triple, size: Triple, material: int, yaw_rad: float = 0.0) -> Mesh:
    """An upright box with sharp edges, rotated by `yaw_rad` about z; metres."""
    faces, normals = [], []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        for sign in (-1.0, 1.0):
            normal = np.eye(3)[axis] * sign
            faces.append(0.5 * np.array([normal - u - v, normal + u - v, normal + u + v, normal - u + v]))
            normals.append(np.repeat(normal[None], 4, axis=0))
    local = np.concatenate(faces) * np.array(size)
    turn = turn_z(yaw_rad)
    triangles = np.concatenate([BOX_TRIANGLES + 4 * face for face in range(6)])
    return Mesh(
        (local @ turn.T + np.array(center)).astype(np.float32),
        (np.concatenate(normals) @ turn.T).astype(np.float32),
        local.astype(np.float32),
        np.full(24, material, np.int16),
        np.zeros(24, np.int16),
        triangles.astype(np.int32),
        np.zeros(24, np.int32),
    )


def turn_x(angle: float) -> np.ndarray:
    """(3, 3) right-handed rotation about x, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def turn_y(angle: float) -> np.ndarray:
    """(3, 3) right-handed rotation about y, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def turn_z(angle: float) -> np.ndarray:
    """(3, 3) right-handed rotation about z, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@cache
def _template() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The unit blob: directions (v, 3), the end to which each vertex belongs (v,), and triangles (t, 3)."""
    half = np.linspace(0, np.pi / 2, RINGS + 1)[1:]
    polar = np.concatenate([np.pi - half, half[::-1]])  # from the bottom pole upwards; the equator occurs twice
    around = np.arange(SEGMENTS) * 2 * np.pi / SEGMENTS
    sin = np.sin(polar)[:, None]
    rings = np.stack([sin * np.cos(around), sin * np.sin(around), np.repeat(np.cos(polar)[:, None], SEGMENTS, 1)], -1)
    n = np.concatenate([rings.reshape(-1, 3), [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    s = np.concatenate([np.repeat([0.0, 1.0], RINGS * SEGMENTS), [0.0, 1.0]])
    triangles = []
    last, bottom = 2 * RINGS - 1, 2 * RINGS * SEGMENTS
    for j in range(SEGMENTS):
        k = (j + 1) % SEGMENTS
        triangles.append([bottom, k, j])
        triangles.append([bottom + 1, last * SEGMENTS + j, last * SEGMENTS + k])
        for ring in range(last):
            a, b = ring * SEGMENTS, (ring + 1) * SEGMENTS
            triangles += [[a + j, a + k, b + k], [a + j, b + k, b + j]]
    return n, s, np.array(triangles, np.int32)


def _three(radii: tuple[float, ...]) -> tuple[float, ...]:
    return radii if len(radii) == 3 else (*radii, (radii[0] + radii[1]) / 2)


def _blob_axes(axis: np.ndarray, side: np.ndarray | None) -> np.ndarray:
    """(3, 3) columns: `side` orthogonalised to the axis, the third direction, the axis."""
    z = axis / np.linalg.norm(axis)
    if side is None:
        side = np.eye(3)[np.abs(z).argmin()]
    x = side - z * (side @ z)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def xyz(x: Number, y: Number, z: Number) -> Float64[np.ndarray, "3"]:
    """A point or a displacement, metres."""
    return np.array([x, y, z], np.float64)


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
