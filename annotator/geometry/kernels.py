"""Compiled loops of the geometry. Import this module inside functions: it loads numba."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from annotator.compiled import compiled


@compiled
def points_in_box(
    xyz: Float[np.ndarray, "n 3"],
    center: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    half: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "n"]:
    """Which points lie in a box or on its surface; NaN points are outside.

    All arguments have the points' dtype and frame; rows are contiguous, `half` are half the lengths of the box.
    """
    inside = np.empty(len(xyz), np.bool_)
    # scalars, so that the compiler does not reload them in the loop
    cx, cy, cz = center[0], center[1], center[2]
    xx, yx, zx = rotation[0, 0], rotation[1, 0], rotation[2, 0]
    xy, yy, zy = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    xz, yz, zz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    hx, hy, hz = half[0], half[1], half[2]
    # a constant stride, and `&` instead of `and`, so that the loop vectorises
    flat = xyz.reshape(-1)
    for i in range(len(xyz)):
        x, y, z = flat[3 * i] - cx, flat[3 * i + 1] - cy, flat[3 * i + 2] - cz
        inside[i] = (
            (abs(xx * x + yx * y + zx * z) <= hx)
            & (abs(xy * x + yy * y + zy * z) <= hy)
            & (abs(xz * x + yz * y + zz * z) <= hz)
        )
    return inside


@compiled
def depth_points(
    depth: Float32[np.ndarray, "p"], x: Float32[np.ndarray, "p"], y: Float32[np.ndarray, "p"]
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "n"]]:
    """The point and the place of each pixel with a positive, finite depth (z, metres) and a ray.

    `x` and `y` are x/z and y/z of the ray of each pixel; x is NaN for a pixel without a ray.
    """
    count = 0
    for i in range(len(depth)):
        count += (depth[i] > 0) & (depth[i] < np.inf) & (x[i] == x[i])
    xyz = np.empty((count, 3), np.float32)
    index = np.empty(count, np.int32)
    k = 0
    for i in range(len(depth)):
        z = depth[i]
        if (z > 0) & (z < np.inf) & (x[i] == x[i]):
            xyz[k, 0], xyz[k, 1], xyz[k, 2] = x[i] * z, y[i] * z, z
            index[k] = i
            k += 1
    return xyz, index


# Each face of the box with the longer diagonal is moved outwards by this share of that diagonal.
TIE = 1e-13

# Axes with a smaller sine between them count as parallel: the lines where their planes meet add a negligible volume.
# Axes with a smaller cosine count as perpendicular.
PARALLEL = 1e-11

# Replaces a determinant of 0: three planes with a common direction then meet very far away, but at finite coordinates.
TINY = 1e-25

Vectors = Float64[np.ndarray, "n 3"]
Rotations = Float64[np.ndarray, "n 3 3"]


@compiled
def intersection_volumes(
    centers_a: Vectors,
    rotations_a: Rotations,
    sizes_a: Vectors,
    centers_b: Vectors,
    rotations_b: Rotations,
    sizes_b: Vectors,
) -> Float64[np.ndarray, "n"]:
    """As `geometry.iou.intersection_volume_pairs`, without checks of the arguments."""
    volumes = np.zeros(len(centers_a))
    normals, offsets = np.empty((6, 3)), np.empty((6, 2))
    crosses, lines = np.empty((6, 6, 3)), np.empty((6, 6, 2, 2, 2))
    for n in range(len(centers_a)):
        a, b = (centers_a[n], rotations_a[n], sizes_a[n]), (centers_b[n], rotations_b[n], sizes_b[n])
        diagonal_a, diagonal_b, apart = _length(a[2]), _length(b[2]), _length(a[0] - b[0])
        if apart > 0.5 * (diagonal_a + diagonal_b):
            continue
        # the origin is the centre of the smaller box: this is more precise and makes the result symmetric in a and b
        if diagonal_a < diagonal_b:
            _slabs(b, a, diagonal_b, normals, offsets)
        else:
            _slabs(a, b, diagonal_a, normals, offsets)
        _clip_lines(normals, offsets, crosses, lines)
        smaller = min(a[2][0] * a[2][1] * a[2][2], b[2][0] * b[2][1] * b[2][2])
        volumes[n] = min(max(_volume(normals, offsets, crosses, lines), 0.0), smaller)
    return volumes


@compiled
def _length(vector: np.ndarray) -> float:
    return np.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


@compiled
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _slabs(
    large: tuple[np.ndarray, np.ndarray, np.ndarray],
    small: tuple[np.ndarray, np.ndarray, np.ndarray],
    diagonal: float,
    normals: np.ndarray,
    offsets: np.ndarray,
) -> None:
    """Fills in the slabs relative to the smaller box's centre, those of the larger box first.

    Boxes are centre, rotation (columns = axes) and sizes, `diagonal` that of the larger one; `normals` are (6, 3) unit
    vectors, `offsets` (6, 2) of the lower and upper plane of each.
    """
    shift = large[0] - small[0]
    for i in range(3):
        for j in range(3):
            normals[i, j], normals[3 + i, j] = large[1][j, i], small[1][j, i]
        middle, half = _dot(normals[i], shift), 0.5 * large[2][i] + TIE * diagonal
        offsets[i, 0], offsets[i, 1] = middle - half, middle + half
        offsets[3 + i, 0], offsets[3 + i, 1] = -0.5 * small[2][i], 0.5 * small[2][i]
    # axes of the smaller box that are parallel to an axis of the larger one up to rounding are set to its direction
    for j in range(3, 6):
        parallel, across = -1, 0
        for i in range(3):
            if abs(_dot(normals[i], normals[j])) < PARALLEL:
                across += 1
            else:
                parallel = i
        if across == 2:
            sign = np.sign(_dot(normals[parallel], normals[j]))
            for k in range(3):
                normals[j, k] = sign * normals[parallel, k]


@compiled
def _clip_lines(normals: np.ndarray, offsets: np.ndarray, crosses: np.ndarray, lines: np.ndarray) -> None:
    """Fills in where each line enters and leaves the four other slabs, measured along its cross product.

    For i < j: `crosses` (6, 6, 3), and `lines` (6, 6, 2, 2, 2) by plane of i, plane of j, and entry or exit.
    """
    for i in range(6):
        for j in range(i + 1, 6):
            a, b = normals[i], normals[j]
            crosses[i, j, 0] = a[1] * b[2] - a[2] * b[1]
            crosses[i, j, 1] = a[2] * b[0] - a[0] * b[2]
            crosses[i, j, 2] = a[0] * b[1] - a[1] * b[0]
    lines[..., 0] = -np.inf
    lines[..., 1] = np.inf
    points = np.empty((2, 2, 2, 3))
    for i in range(6):
        for j in range(i + 1, 6):
            for k in range(j + 1, 6):
                _meeting_points(normals, offsets, crosses, (i, j, k), points)
                for p in range(2):
                    for q in range(2):
                        _clip(lines[i, j, p, q], crosses[i, j], points[p, q, 0], points[p, q, 1])
                        _clip(lines[i, k, p, q], crosses[i, k], points[p, 0, q], points[p, 1, q])
                        _clip(lines[j, k, p, q], crosses[j, k], points[0, p, q], points[1, p, q])


@compiled
def _meeting_points(
    normals: np.ndarray, offsets: np.ndarray, crosses: np.ndarray, slabs: tuple[int, int, int], points: np.ndarray
) -> None:
    """Fills in the points where planes of three slabs meet (Cramer's rule): (2, 2, 2, 3), one per choice of planes."""
    i, j, k = slabs
    determinant = _dot(crosses[j, k], normals[i])
    if abs(determinant) < TINY:
        determinant = TINY
    for x in range(3):
        # the columns of adjugate / determinant; the middle cross product is stored with the opposite sign
        first = crosses[j, k, x] / determinant
        second = -crosses[i, k, x] / determinant
        third = crosses[i, j, x] / determinant
        for p in range(2):
            for q in range(2):
                for r in range(2):
                    points[p, q, r, x] = offsets[i, p] * first + offsets[j, q] * second + offsets[k, r] * third


@compiled
def _clip(line: np.ndarray, along: np.ndarray, one: np.ndarray, other: np.ndarray) -> None:
    """Clips a line, in place, to the part between two points on it."""
    a, b = _dot(one, along), _dot(other, along)
    line[0], line[1] = max(line[0], min(a, b)), min(line[1], max(a, b))


@compiled
def _volume(normals: np.ndarray, offsets: np.ndarray, crosses: np.ndarray, lines: np.ndarray) -> float:
    """The sum over all lines of their lengths times d_i e_ij + d_j e_ji, divided by 6."""
    total = 0.0
    for i in range(6):
        for j in range(i + 1, 6):
            sine, cosine = _length(crosses[i, j]), _dot(normals[i], normals[j])
            if sine <= PARALLEL:
                continue
            sign = -1.0 if cosine < 0.0 else 1.0
            for p in range(2):
                for q in range(2):
                    length = max(lines[i, j, p, q, 1] - lines[i, j, p, q, 0], 0.0) / sine
                    first, second = offsets[i, p], offsets[j, q]
                    # (2 d_i d_j - c (d_i^2 + d_j^2)) / s, in a form without cancellation at small s
                    squares = sine * (first * first + second * second) / (1.0 + abs(cosine))
                    weight = sign * (squares - (first - sign * second) ** 2 / sine)
                    # outward normals: that of the lower plane is the negative of the slab's normal
                    total += length * (weight if p == q else -weight)
    return total / 6.0
