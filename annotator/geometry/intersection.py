"""Exact intersection volume of two oriented boxes, for many pairs at once.

Two boxes are six slabs: pairs of parallel planes. Each edge of the intersection lies on the line where planes of
two different slabs meet, between the points where the line enters and leaves the four other slabs. With 15 pairs
of slabs and 4 pairs of planes each, there are 60 such lines, and the divergence theorem, applied twice, makes the
volume a sum over them:

    V = 1/3 sum_faces d_i A_i,   A_i = 1/2 sum_edges e_ij L_ij,   e_ij = (d_j - c_ij d_i) / s_ij

with d a plane's distance from the origin along its outward normal, c and s the cosine and sine of the angle
between two normals, and L_ij what the slabs leave of the line. No face polygon is ever built, and every pair of
boxes costs the same steps.

Faces that lie in one plane, or nearly: where three planes meet is computed once, and used for all three lines, so
a line that ends at a nearly parallel plane ends exactly where the other plane's line begins, wherever rounding
puts that point. Edges that coincide would still be counted twice or not at all, so axes that are parallel but
for rounding are made parallel, and then one of the boxes is made larger by a share of `TIE`, far below the accuracy
claimed and far above rounding.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float, Float64

from annotator.types.errors import GeometryError

# How much each face of the box with the longer diagonal is moved out, as a share of that diagonal.
TIE = 1e-13

# Axes closer than this (sine) are taken as parallel: what is left of that line carries no volume worth counting.
PARALLEL = 1e-11

# Stands for a determinant of 0: three planes that share a direction meet beyond everything, at a finite number.
TINY = 1e-25

# Pairs a pass: 15 kB each, so that a pass stays in the processor's cache.
CHUNK = 128

SLAB_PAIRS = tuple(combinations(range(6), 2))
SLAB_TRIPLES = tuple(combinations(range(6), 3))
_FIRST, _SECOND = np.array(SLAB_PAIRS).T
_TRIPLES = np.array(SLAB_TRIPLES)

# For each place in a triple: the pair of slabs that is left without it.
_PAIR_WITHOUT = np.array(
    [
        [SLAB_PAIRS.index((t[1], t[2])), SLAB_PAIRS.index((t[0], t[2])), SLAB_PAIRS.index((t[0], t[1]))]
        for t in SLAB_TRIPLES
    ]
).T
# For each pair of slabs: which four of the 3 x 20 (place, triple) hold it, with another slab in that place.
_CLIPS = np.array([np.flatnonzero(_PAIR_WITHOUT.reshape(-1) == p) for p in range(len(SLAB_PAIRS))])
# Outward normals: minus for the lower plane of a slab, so this is the sign of a product of two of them.
_OUTWARD = np.array([[1.0, -1.0], [-1.0, 1.0]])[None, :, :, None]

Centers = Float[np.ndarray, "n 3"]
Rotations = Float[np.ndarray, "n 3 3"]
Volumes = Float64[np.ndarray, "n"]


def intersection_volume_pairs(
    centers_a: Centers,
    rotations_a: Rotations,
    sizes_a: Centers,
    centers_b: Centers,
    rotations_b: Rotations,
    sizes_b: Centers,
) -> Volumes:
    """Volume of the intersection of box a and box b of each of n pairs.

    Args:
        centers_a, centers_b: box centres, metres, in one frame.
        rotations_a, rotations_b: columns = box axes in that frame.
        sizes_a, sizes_b: full lengths along the box axes, metres, positive.

    Returns:
        (n,) cubic metres, between 0 and the volume of the smaller box.

    Raises:
        GeometryError: a size that is not positive, or a value that is not finite.
    """
    boxes_a = _checked(centers_a, rotations_a, sizes_a)
    boxes_b = _checked(centers_b, rotations_b, sizes_b)
    diagonal_a, diagonal_b = np.linalg.norm(boxes_a[2], axis=1), np.linalg.norm(boxes_b[2], axis=1)
    apart = np.linalg.norm(boxes_a[0] - boxes_b[0], axis=1)
    near = np.flatnonzero(apart <= 0.5 * (diagonal_a + diagonal_b))
    volumes = np.zeros(len(apart))
    for start in range(0, len(near), CHUNK):
        rows = near[start : start + CHUNK]
        # the origin goes into the smaller box, where all that matters is near it; this makes it symmetric, too
        swap = diagonal_a[rows] < diagonal_b[rows]
        large = [np.where(_like(swap, a), b[rows], a[rows]) for a, b in zip(boxes_a, boxes_b, strict=True)]
        small = [np.where(_like(swap, a), a[rows], b[rows]) for a, b in zip(boxes_a, boxes_b, strict=True)]
        volumes[rows] = _volumes(*_slabs(large, small))
    return np.clip(volumes, 0.0, np.minimum(boxes_a[2].prod(axis=1), boxes_b[2].prod(axis=1)))


def _checked(centers: Centers, rotations: Rotations, sizes: Centers) -> list[np.ndarray]:
    boxes = [np.asarray(values, np.float64) for values in (centers, rotations, sizes)]
    if not all(np.isfinite(values).all() for values in boxes) or (boxes[2] <= 0).any():
        raise GeometryError("boxes must have finite poses and finite, positive sizes to be intersected")
    return boxes


def _like(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    return mask.reshape(-1, *[1] * (values.ndim - 1))


def _slabs(
    large: list[np.ndarray], small: list[np.ndarray]
) -> tuple[Float64[np.ndarray, "6 3 n"], Float64[np.ndarray, "6 2 n"]]:
    """The six slabs of each pair, around the smaller box's centre: unit normals, and offsets of the two planes."""
    # rotations (n, xyz, axis) -> (axis, xyz, n): the pairs last, so that every step runs along memory
    axes = np.ascontiguousarray(np.concatenate([large[1], small[1]], axis=2).transpose(2, 1, 0))
    _align_parallel(axes)
    middle = np.zeros((6, len(small[0])))
    middle[:3] = np.einsum("kin,ni->kn", axes[:3], large[0] - small[0])
    half = 0.5 * np.concatenate([large[2].T, small[2].T])
    half[:3] += TIE * np.linalg.norm(large[2], axis=1)
    return axes, np.stack([middle - half, middle + half], axis=1)


def _align_parallel(axes: Float64[np.ndarray, "6 3 n"]) -> None:
    """Gives, in place, the second box's axes that are parallel to one of the first but for rounding its direction."""
    cosines = np.einsum("ikn,jkn->ijn", axes[:3], axes[3:])
    across = np.abs(cosines) < PARALLEL
    parallel = across.sum(axis=0) == 2
    if parallel.any():
        turned = np.einsum("ijn,ikn->jkn", np.where(across, 0.0, np.sign(cosines)), axes[:3])
        axes[3:] = np.where(parallel[:, None], turned, axes[3:])


def _volumes(normals: Float64[np.ndarray, "6 3 n"], offsets: Float64[np.ndarray, "6 2 n"]) -> Volumes:
    """The volume that the six slabs have in common."""
    crosses = np.cross(normals[_FIRST], normals[_SECOND], axis=1)
    sines = np.sqrt((crosses * crosses).sum(axis=1))
    low, high = _clipped_lines(crosses, normals, offsets)
    meet = sines > PARALLEL
    sines = np.where(meet, sines, 1.0)
    lengths = np.where(meet[:, None, None], np.maximum(high - low, 0.0), 0.0) / sines[:, None, None]
    cosines = (normals[_FIRST] * normals[_SECOND]).sum(axis=1)
    return (lengths * _weights(sines, cosines, offsets)).sum(axis=(0, 1, 2)) / 6.0


def _clipped_lines(
    crosses: Float64[np.ndarray, "15 3 n"],
    normals: Float64[np.ndarray, "6 3 n"],
    offsets: Float64[np.ndarray, "6 2 n"],
) -> tuple[Float64[np.ndarray, "15 2 2 n"], Float64[np.ndarray, "15 2 2 n"]]:
    """Where each line enters and leaves the other slabs, along its direction times the sine of its planes.

    Axes: the pair of slabs, which plane of the first, which of the second.
    """
    places = _meeting_points(crosses, normals, offsets)
    lows, highs = [], []
    for place in range(3):
        along = crosses[_PAIR_WITHOUT[place]][:, None, None, None]
        positions = places[..., 0, :] * along[..., 0, :]
        positions += places[..., 1, :] * along[..., 1, :]
        positions += places[..., 2, :] * along[..., 2, :]
        lows.append(positions.min(axis=1 + place))
        highs.append(positions.max(axis=1 + place))
    return np.concatenate(lows)[_CLIPS].max(axis=1), np.concatenate(highs)[_CLIPS].min(axis=1)


def _meeting_points(
    crosses: Float64[np.ndarray, "15 3 n"],
    normals: Float64[np.ndarray, "6 3 n"],
    offsets: Float64[np.ndarray, "6 2 n"],
) -> Float64[np.ndarray, "20 2 2 2 3 n"]:
    """The points where planes of three slabs meet (Cramer's rule), for each choice of the three planes."""
    # the three columns of adjugate / determinant; the middle pair is stored the other way round
    edges = [crosses[_PAIR_WITHOUT[0]], -crosses[_PAIR_WITHOUT[1]], crosses[_PAIR_WITHOUT[2]]]
    determinants = (edges[0] * normals[_TRIPLES[:, 0]]).sum(axis=1)
    determinants = np.where(np.abs(determinants) < TINY, TINY, determinants)
    first, second, third = (
        offsets[_TRIPLES[:, k]][:, :, None] * (edges[k] / determinants[:, None])[:, None] for k in range(3)
    )
    return first[:, :, None, None] + second[:, None, :, None] + third[:, None, None, :]


def _weights(
    sines: Float64[np.ndarray, "15 n"], cosines: Float64[np.ndarray, "15 n"], offsets: Float64[np.ndarray, "6 2 n"]
) -> Float64[np.ndarray, "15 2 2 n"]:
    """d_i e_ij + d_j e_ji of each line: (2 d_i d_j - c (d_i^2 + d_j^2)) / s, without its cancellation at small s."""
    first, second = offsets[_FIRST][:, :, None], offsets[_SECOND][:, None, :]
    cosines, sines = cosines[:, None, None], sines[:, None, None]
    sign = np.where(cosines < 0, -1.0, 1.0)
    squares = first * first + second * second
    return _OUTWARD * sign * (sines * squares / (1.0 + np.abs(cosines)) - (first - sign * second) ** 2 / sines)
