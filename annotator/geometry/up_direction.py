"""The direction against gravity, from the planes of one point cloud: floors, table tops, walls, the ground.

Planes are found one after the other. Each of them, and each pair of upright ones, proposes a direction. The best one is
that to which most of the surface is level or upright, given that cameras are held nearly level: of a room's three axes,
only this tells which one is vertical.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from annotator.geometry.normals import normals_from_depth, normals_knn
from annotator.types import Frame

# Points per frame that planes are fitted to, and the normals' neighbours where there is no depth image.
SAMPLES, NEIGHBOURS = 12_000, 24
# Cells of the thinned cloud per distance: sampling by area, so that near surfaces do not outweigh the others.
CELLS_PER_RANGE = 120
# Planes: number, smallest share of the surface, tried hypotheses, distance of their points (share of the range), angle.
MOST_PLANES, LEAST_SHARE, TRIES = 10, 0.015, 300
PLANE_REACH, PLANE_REACH_M, PLANE_COS = 0.008, 0.006, np.cos(np.radians(20.0))
# A plane, or a piece of surface, counts as level or upright if it is within a few of these angles.
LEVEL_RAD, SURFACE_RAD = np.radians(2.0), np.radians(4.0)
# Spread of a camera's roll and pitch, and its usual pitch (downwards).
ROLL_RAD, PITCH_RAD, USUAL_PITCH_RAD = np.radians(16.0), np.radians(20.0), np.radians(-12.0)
USUAL_UP = np.array([0.0, -np.cos(USUAL_PITCH_RAD), np.sin(USUAL_PITCH_RAD)])
# What counts beside a surface that faces up: upright surface, one that faces down, and a ground, below which there are
# at most this share of the points; and the scale of the evidence.
UPRIGHT_WEIGHT, FACES_DOWN_WEIGHT, GROUND_WEIGHT, MOST_BELOW, EVIDENCE = 0.6, 0.5, 0.25, 0.03, 14.0
# Evidence against any direction: that of this share of surface.
NEEDED_SHARE = 0.12
# The share of surface that holds a direction at which its certainty is halved.
HALF_HELD = 0.03
# Directions closer than this are the same one.
SAME_RAD = np.radians(8.0)


@dataclass(frozen=True, eq=False)
class UpEstimate:
    """A direction against gravity and the evidence for it.

    Attributes:
        up: unit vector, camera frame.
        certainty: 0..1, that it is within a few degrees.
        level_share, upright_share: shares of the surface that are level, and upright, if it is right.
    """

    up: Float64[np.ndarray, "3"]
    certainty: float
    level_share: float
    upright_share: float


@dataclass(frozen=True, eq=False)
class _Planes:
    """Planes of a cloud: unit normals towards the sensor, shares of the surface, share of points behind each."""

    normals: Float64[np.ndarray, "k 3"]
    shares: Float64[np.ndarray, "k"]
    behind: Float64[np.ndarray, "k"]


def estimate_up(frame: Frame) -> UpEstimate | None:
    """The direction against gravity of one frame; None without any plane that could tell.

    Only the cloud (or the depth image) and the image's orientation are used, not `frame.up`.
    """
    points, normals = _surface(frame)
    if len(points) < 3 * NEIGHBOURS:
        return None
    planes = _find_planes(points, normals)
    candidates = _candidates(planes)
    if not len(candidates):
        return None
    scores = _scores(candidates, planes)
    best = candidates[int(np.argmax(scores))]
    # a direction is only as certain as it beats the others; and planes that it does not call upright may be walls
    rivals = candidates[candidates @ best < np.cos(SAME_RAD)]
    walls = _up_if_upright(planes.normals[np.abs(planes.normals @ best) > np.sin(SAME_RAD)])
    against = np.concatenate([_scores(rivals, planes), _scores(walls, planes, 1.0), [EVIDENCE * NEEDED_SHARE]])
    posterior = 1 / (1 + np.exp(np.clip(against.max() - scores.max(), -50, 50)))
    # the normals of a sparse cloud are too coarse to refine with; its planes are not
    weight = 0.0 if frame.depth_m is None else 1 / len(normals)
    up, held = _refined(best, planes, normals, weight)
    level, upright = _agreement(up[None], planes.normals, LEVEL_RAD)
    return UpEstimate(
        up,
        float(posterior * held**2 / (held**2 + HALF_HELD**2)),
        float(np.abs(level[0]) @ planes.shares),
        float(upright[0] @ planes.shares),
    )


def _surface(frame: Frame) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Points that are spread evenly over the seen surface, and their normals."""
    cloud = frame.cloud
    normals = cloud.normals
    if normals is None and frame.depth_m is not None and cloud.pixel_index is not None:
        normals = normals_from_depth(frame.camera, frame.depth_m).reshape(-1, 3)[cloud.pixel_index]
    keep = _thinned(cloud.xyz_m)
    points = cloud.xyz_m[keep].astype(np.float64)
    near = normals_knn(points, NEIGHBOURS) if normals is None else normals[keep]
    known = np.flatnonzero(np.einsum("ij,ij->i", near, near) > 0.5)
    return points[known], near[known].astype(np.float64)


def _thinned(xyz_m: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """One random point of each cell of a grid; cells are larger in clouds that reach farther."""
    if not len(xyz_m):
        return np.zeros(0, np.int64)
    order = np.random.default_rng(0).permutation(len(xyz_m))
    cell_m = float(np.median(np.linalg.norm(xyz_m, axis=1))) / CELLS_PER_RANGE
    while True:
        cells = np.floor(xyz_m[order] / max(cell_m, 1e-6)).astype(np.int64)
        code = (cells - cells.min(axis=0)) @ np.array([1, 1 << 21, 1 << 42])
        first = order[np.unique(code, return_index=True)[1]]
        if len(first) <= SAMPLES:
            return np.sort(first)
        cell_m *= max(1.1, float(np.sqrt(len(first) / SAMPLES)))


def _find_planes(points: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"]) -> _Planes:
    """The largest planes, found one after the other; the points of each are left out of the next."""
    random = np.random.default_rng(0)
    reach = PLANE_REACH_M + PLANE_REACH * np.linalg.norm(points, axis=1)
    open_ = np.arange(len(points))
    found: list[tuple[np.ndarray, float, float]] = []
    while len(found) < MOST_PLANES and len(open_) > LEAST_SHARE * len(points):
        tried = open_[random.permutation(len(open_))[:TRIES]]
        axes, offsets = normals[tried], np.einsum("ij,ij->i", normals[tried], points[tried])
        fits = np.abs(points[open_] @ axes.T - offsets) < reach[open_, None]
        fits &= normals[open_] @ axes.T > PLANE_COS
        best = int(np.argmax(fits.sum(axis=0)))
        normal, offset, on = axes[best], offsets[best], fits[:, best]
        for _ in range(5):
            if on.sum() < 3:
                break
            normal, offset = _fit(points[open_[on]], 1 / reach[open_[on]], normal)
            on = np.abs(points[open_] @ normal - offset) < reach[open_]
            on &= normals[open_] @ normal > PLANE_COS
        share = float(on.mean() * len(open_) / len(points))
        if share < LEAST_SHARE:
            break
        found.append((normal, share, float((points @ normal - offset < -3 * reach).mean())))
        open_ = open_[~on]
    if not found:
        return _Planes(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    return _Planes(*(np.array(values) for values in zip(*found, strict=True)))


def _fit(
    points: Float64[np.ndarray, "n 3"], weights: Float64[np.ndarray, "n"], towards: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], float]:
    """Least-squares plane: its normal on the side of `towards`, and its offset along it."""
    squares = weights * weights
    middle = squares @ points / squares.sum()
    apart = (points - middle) * weights[:, None]
    normal = np.linalg.eigh(apart.T @ apart)[1][:, 0]
    normal = normal if normal @ towards > 0 else -normal
    return normal, float(normal @ middle)


def _candidates(planes: _Planes) -> Float64[np.ndarray, "k 3"]:
    """The planes' normals and the normals' cross products, turned to the upper half of the image."""
    first, second = np.triu_indices(len(planes.normals), 1)
    crosses = np.cross(planes.normals[first], planes.normals[second])
    length = np.linalg.norm(crosses, axis=1)
    wide = length > 0.5
    directions = np.concatenate([planes.normals, crosses[wide] / length[wide, None]])
    return directions * -np.sign(directions[:, 1:2] + 1e-12)


def _up_if_upright(normals: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "m 3"]:
    """For planes that may be walls, the usual direction along each: it explains the wall, but nothing confirms it."""
    directions = USUAL_UP - (normals @ USUAL_UP)[:, None] * normals
    length = np.linalg.norm(directions, axis=1)
    return directions[length > 0.1] / length[length > 0.1, None]


def _scores(
    directions: Float64[np.ndarray, "k 3"], planes: _Planes, upright_weight: float = UPRIGHT_WEIGHT
) -> Float64[np.ndarray, "k"]:
    level, upright = _agreement(directions, planes.normals, LEVEL_RAD)
    faces_up, faces_down = np.maximum(level, 0), np.maximum(-level, 0)
    clear = np.clip(1 - planes.behind / MOST_BELOW, 0, 1)
    evidence = (faces_up + FACES_DOWN_WEIGHT * faces_down + upright_weight * upright) @ planes.shares
    ground = (faces_up * clear * np.sqrt(planes.shares)).max(axis=1)
    scores: np.ndarray = EVIDENCE * (evidence + GROUND_WEIGHT * ground) + _prior(directions)
    return scores


def _agreement(
    directions: Float64[np.ndarray, "k 3"], normals: Float64[np.ndarray, "m 3"], sigma_rad: float
) -> tuple[Float64[np.ndarray, "k m"], Float64[np.ndarray, "k m"]]:
    """How level (negative: facing down) and how upright surfaces are for each direction, 0..1."""
    cosine = np.clip(directions @ normals.T, -1, 1)
    level = np.exp(-0.5 * (np.arccos(np.abs(cosine)) / sigma_rad) ** 2) * np.sign(cosine)
    return level, np.exp(-0.5 * (np.arcsin(np.abs(cosine)) / sigma_rad) ** 2)


def _prior(directions: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k"]:
    """Logarithm of how usual the camera's roll and pitch are."""
    roll = np.arctan2(directions[:, 0], -directions[:, 1])
    pitch = np.arcsin(np.clip(directions[:, 2], -1, 1))
    prior: np.ndarray = -0.5 * ((roll / ROLL_RAD) ** 2 + ((pitch - USUAL_PITCH_RAD) / PITCH_RAD) ** 2)
    return prior


def _refined(
    up: Float64[np.ndarray, "3"], planes: _Planes, normals: Float64[np.ndarray, "n 3"], weight: float
) -> tuple[Float64[np.ndarray, "3"], float]:
    """The direction that fits all level and upright surfaces best (least squares), a unit vector.

    With it, the share of the surface that keeps it from turning in its least certain direction.
    """
    held = 0.0
    for _ in range(4):
        of_planes = _moments(up, planes.normals, LEVEL_RAD) * planes.shares
        moments = (planes.normals * of_planes[:, None]).T @ planes.normals
        if weight:
            of_surface = _moments(up, normals, SURFACE_RAD) * weight
            moments += (normals * of_surface[:, None]).T @ normals
        values, axes = np.linalg.eigh(moments)
        up = axes[:, 0] if axes[:, 0] @ up > 0 else -axes[:, 0]
        held = float(values[1] - values[0]) / (2 if weight else 1)
    return up, held


def _moments(
    up: Float64[np.ndarray, "3"], normals: Float64[np.ndarray, "n 3"], sigma_rad: float
) -> Float64[np.ndarray, "n"]:
    """Weights of normals: positive for upright surfaces, negative for level ones."""
    level, upright = _agreement(up[None], normals, sigma_rad)
    weights: np.ndarray = upright[0] - np.abs(level[0])
    return weights
