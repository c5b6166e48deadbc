"""The rotation of the least-volume box around a convex hull.

Freeman and Shapira (1975): the least rectangle around a polygon has a side along one of its edges, found by
rotating calipers. O'Rourke (1985): the least box has two adjacent faces each flush with an edge of the hull, and
often one flush with a face. So: calipers about candidate axes (large hull faces, the eigenvectors, a grid of
directions); from the best of them a pattern search over small rotations; and last, calipers about each of the box's
own axes in turn until nothing shrinks (after Chang, Gorissen and Melchior, 2011), which puts faces exactly flush.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

MAX_VERTICES = 400
MAX_FACES = 48
GRID_DIRECTIONS = 40
STARTS = 12
ROUNDS = 8

# The pattern search: its steps, and with how many of the starts each is taken.
PATTERN_STEPS_RAD = tuple(np.radians(4.0) * 0.5**i for i in range(12))
PATTERN_KEEP = (13, 12, 8, 4, 3, 3, 2, 2, 1, 1, 1, 1)


@dataclass(frozen=True, eq=False)
class Hull:
    """What the search needs of a convex hull: vertices, triangles' outward normals, and edges between them.

    Attributes:
        vertices: (v, 3) corners.
        normals: (f, 3) outward unit normals of the triangles.
        areas: (f,) areas of the triangles.
        edges: (e, 3) unit vectors along the edges.
        sides: (e, 2) the two triangles of each edge.
    """

    vertices: Float64[np.ndarray, "v 3"]
    normals: Float64[np.ndarray, "f 3"]
    areas: Float64[np.ndarray, "f"]
    edges: Float64[np.ndarray, "e 3"]
    sides: Int[np.ndarray, "e 2"]


def least_width_direction(polygon: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "2"]:
    """The direction of one side of the least-area rectangle around a convex polygon.

    Args:
        polygon: corners in order, at least three.
    """
    edges = np.roll(polygon, -1, axis=0) - polygon
    along = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    areas = np.ptp(polygon @ along.T, axis=0) * np.ptp(polygon @ across.T, axis=0)
    return along[np.argmin(areas)]


def least_volume_rotation(hull: ConvexHull, eigenvectors: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The rotation (columns = box axes) of the least-volume box around a hull, or of one close to it.

    Args:
        hull: of points around the origin.
        eigenvectors: columns = the principal axes of the points, tried as axes too.
    """
    simple = _simplified(hull)
    axes = np.concatenate([_large_faces(simple), eigenvectors.T, _grid(GRID_DIRECTIONS)])
    starts = sorted((_turned_about(simple, axis) for axis in axes), key=lambda found: found[0])
    tried = [_alternate(simple, starts[0][1]), *starts[:STARTS]]
    near = _pattern_search(simple.vertices, np.array([rotation for _, rotation in tried]))
    return _alternate(simple, near)[1]


def _simplified(hull: ConvexHull) -> Hull:
    """The hull as arrays; with many corners, the hull of those that are extreme in evenly spread directions."""
    if len(hull.vertices) > MAX_VERTICES:
        corners = hull.points[hull.vertices]
        directions = _grid(MAX_VERTICES // 2)
        along = directions @ corners.T
        hull = ConvexHull(corners[np.unique(np.concatenate([along.argmax(axis=1), along.argmin(axis=1)]))])
    triangles = hull.points[hull.simplices]
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    face = np.repeat(np.arange(len(triangles)), 3)
    # the neighbour that Qhull lists k-th shares the edge opposite the k-th corner; keep each edge once
    once = face < hull.neighbors.reshape(-1)
    along = (triangles[:, [2, 0, 1]] - triangles[:, [1, 2, 0]]).reshape(-1, 3)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    once &= length[:, 0] > 0
    return Hull(
        vertices=hull.points[hull.vertices],
        normals=hull.equations[:, :3],
        areas=0.5 * np.linalg.norm(cross, axis=1),
        edges=along[once] / length[once],
        sides=np.stack([face, hull.neighbors.reshape(-1)], axis=1)[once],
    )


def _large_faces(hull: Hull) -> Float64[np.ndarray, "n 3"]:
    """Normals of the largest faces, opposite ones and triangles of one face taken together."""
    normals = (
        hull.normals * np.where(hull.normals[np.arange(len(hull.normals)), _leading(hull.normals)] < 0, -1, 1)[:, None]
    )
    _, first, member = np.unique(np.round(normals, 6), axis=0, return_index=True, return_inverse=True)
    areas = np.bincount(member.reshape(-1), weights=hull.areas)
    return normals[first[np.argsort(-areas, kind="stable")[:MAX_FACES]]]


def _leading(vectors: Float64[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    return np.argmax(np.abs(vectors), axis=1)


def _grid(count: int) -> Float64[np.ndarray, "count 3"]:
    """Evenly spread directions on a half sphere (a Fibonacci lattice)."""
    z = (np.arange(count) + 0.5) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def _turned_about(hull: Hull, axis: Float64[np.ndarray, "3"]) -> tuple[float, Float64[np.ndarray, "3 3"]]:
    """The least box with one axis given: its volume and rotation (first column `axis`), by calipers.

    Seen along the axis, the outline's edges are those between a triangle that looks up and one that looks down.
    """
    turn = np.array([[0.0, axis[2], -axis[1]], [-axis[2], 0.0, axis[0]], [axis[1], -axis[0], 0.0]])
    up = hull.normals @ axis > 0
    across = hull.edges[up[hull.sides[:, 0]] != up[hull.sides[:, 1]]] @ turn
    length = np.sqrt((across * across).sum(axis=1))
    # an edge along the axis has no direction across it but rounding's
    usable = length > 1e-6
    across = across[usable] / length[usable, None]
    along = across @ turn
    seen = np.concatenate([across, along, axis[None]]) @ hull.vertices.T
    spans = seen.max(axis=1) - seen.min(axis=1)
    areas = spans[: len(along)] * spans[len(along) : -1]
    best = int(areas.argmin())
    rotation = np.array([axis, across[best], along[best]]).T
    return float(areas[best] * spans[-1]), rotation


def _alternate(hull: Hull, rotation: Float64[np.ndarray, "3 3"]) -> tuple[float, Float64[np.ndarray, "3 3"]]:
    """Calipers about each of the box's axes in turn, until none makes it smaller."""
    best = (float(np.prod(np.ptp(hull.vertices @ rotation, axis=0))), rotation)
    for _ in range(ROUNDS):
        before = best[0]
        for i in range(3):
            best = min(best, _turned_about(hull, best[1][:, i]), key=lambda found: found[0])
        if best[0] >= before * (1.0 - 1e-9):
            break
    return best


def _pattern_search(
    vertices: Float64[np.ndarray, "v 3"], rotations: Float64[np.ndarray, "k 3 3"]
) -> Float64[np.ndarray, "3 3"]:
    """Small rotations about 26 directions, in halving steps, as long as a box around the vertices shrinks.

    Searches from every given rotation at once, and returns the best that was found.
    """
    signs = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    directions = np.delete(signs, 13, axis=0).astype(np.float64)
    volumes = _volumes(vertices, rotations)
    for step, keep in zip(PATTERN_STEPS_RAD, PATTERN_KEEP, strict=True):
        best = np.argsort(volumes, kind="stable")[:keep]
        rotations, volumes = rotations[best], volumes[best]
        turns = Rotation.from_rotvec(step * directions).as_matrix()
        moving = np.arange(len(rotations))
        for _ in range(ROUNDS):
            tried = turns @ rotations[moving, None]
            found = _volumes(vertices, tried)
            choice = found.argmin(axis=1)
            smallest = found[np.arange(len(moving)), choice]
            better = smallest < volumes[moving]
            tried, moving = tried[better, choice[better]], moving[better]
            rotations[moving], volumes[moving] = tried, smallest[better]
            if not len(moving):
                break
    return rotations[volumes.argmin()]


def _volumes(
    vertices: Float64[np.ndarray, "v 3"], rotations: Float64[np.ndarray, "*k 3 3"]
) -> Float64[np.ndarray, "*k"]:
    """Volumes of the boxes around the vertices with each rotation."""
    axes = np.swapaxes(rotations, -1, -2).reshape(-1, 3)
    seen = axes @ vertices.T
    spans = seen.max(axis=1) - seen.min(axis=1)
    return spans.reshape(rotations.shape[:-1]).prod(axis=-1)
