"""Rigid registration of points with a cloud: iterative closest point with trimming.

P. J. Besl and N. D. McKay, "A Method for Registration of 3-D Shapes" (PAMI 1992); trimming as in D. Chetverikov et al.,
"The Trimmed Iterative Closest Point Algorithm" (ICPR 2002); distances from planes as in Y. Chen and G. Medioni, "Object
Modelling by Registration of Multiple Range Images" (IVC 1992).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

Pose = tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]
"""Rotation and translation: `p_cloud = rotation @ p + translation`."""

ITERATIONS = 20
# The nearest pairs that are used, share of those within reach.
TRIM = 0.75
# The reach shrinks by this factor in each iteration, down to this share of the first reach.
SHRINK, LEAST_REACH = 0.85, 0.35
# The pose has converged if it moves the points by less than this on average, share of the first reach.
CONVERGED = 3e-4
MIN_PAIRS = 6
# Of the registration with planes: iterations, nearest pairs that are used, and least reach, as above; damping of
# directions in which the surface can slide, and the smallest residual that is weighted more than others, metres.
PLANE_ITERATIONS, PLANE_TRIM, PLANE_REACH = 30, 0.8, 0.2
DAMPING, LEAST_RESIDUAL_M = 1e-3, 1e-4
PLANE_PAIRS = 20


def register(
    points: Float[np.ndarray, "n 3"],
    cloud: KDTree,
    start: Pose,
    reach_m: float,
    up: Float64[np.ndarray, "3"] | None = None,
) -> Pose | None:
    """Moves and turns points so that they lie on the points of a cloud; None if too few lie near it.

    Points without a counterpart in the cloud, and other objects in it, do no harm.

    Args:
        points: of the object, in its own coordinates.
        start: the first pose, from these to the cloud's coordinates.
        reach_m: distance within which a point's counterpart is looked for at first.
        up: unit vector; if given, the rotation changes about it only.
    """
    rotation, translation = start
    reach = reach_m
    for _ in range(ITERATIONS):
        moved = points @ rotation.T + translation
        distances, indices = cloud.query(moved, distance_upper_bound=reach)
        near = np.isfinite(distances)
        if near.sum() < MIN_PAIRS:
            return None
        near &= distances <= np.quantile(distances[near], TRIM)
        ours, theirs = moved[near], cloud.data[indices[near]]
        turn = _best_turn(ours - ours.mean(axis=0), theirs - theirs.mean(axis=0), up)
        translation = turn @ (translation - ours.mean(axis=0)) + theirs.mean(axis=0)
        rotation = turn @ rotation
        steps_m = np.linalg.norm(points @ rotation.T + translation - moved, axis=1)
        if reach <= LEAST_REACH * reach_m and steps_m.mean() < CONVERGED * reach_m:
            break
        reach = max(LEAST_REACH * reach_m, SHRINK * reach)
    return rotation, translation


def register_surface(
    points: Float[np.ndarray, "n 3"],
    cloud: KDTree,
    normals: Float[np.ndarray, "m 3"],
    start: Pose,
    reach_m: float,
    up: Float64[np.ndarray, "3"] | None = None,
) -> Pose | None:
    """As `register`, but brings points onto the planes through the cloud's points.

    A surface that turns is seen from one side only. The nearest points then turn it by too little (three quarters of
    the truth for a person who turns by 10 degrees per frame); planes let it slide along itself.

    Args:
        normals: unit vectors at the cloud's points; zero where unknown, and these points are no counterparts.
    """
    rotation, translation = start
    has_plane = np.append(normals.any(axis=1), False)  # the last one: of points without a counterpart
    reach = reach_m
    for _ in range(PLANE_ITERATIONS):
        moved = points @ rotation.T + translation
        distances, indices = cloud.query(moved, distance_upper_bound=reach)
        near = has_plane[indices]
        if near.sum() < PLANE_PAIRS:
            return None
        near &= distances <= np.quantile(distances[near], PLANE_TRIM)
        ours, planes = moved[near], normals[indices[near]]
        middle = ours.mean(axis=0)
        residuals = ((cloud.data[indices[near]] - ours) * planes).sum(axis=1)
        levers = np.cross(ours - middle, planes)
        rows = np.concatenate([levers if up is None else (levers @ up)[:, None], planes], axis=1)
        sizes = np.abs(residuals)
        weights = 1 / np.maximum(sizes, np.median(sizes) + LEAST_RESIDUAL_M)
        normal = rows.T @ (rows * weights[:, None])
        normal += DAMPING * np.diag(normal).mean() * np.eye(len(normal))
        step = np.linalg.solve(normal, rows.T @ (weights * residuals))
        turn = Rotation.from_rotvec(step[:3] if up is None else step[0] * up).as_matrix()
        translation = turn @ (translation - middle) + middle + step[-3:]
        rotation = turn @ rotation
        reach = max(PLANE_REACH * reach_m, SHRINK * reach)
    return rotation, translation


def _best_turn(
    ours: Float[np.ndarray, "k 3"], theirs: Float[np.ndarray, "k 3"], up: Float64[np.ndarray, "3"] | None
) -> Float64[np.ndarray, "3 3"]:
    """The rotation that brings centred points nearest to their counterparts (Kabsch)."""
    covariance = ours.T @ theirs
    if up is None:
        left, _, right = np.linalg.svd(covariance)
        mirrored = np.sign(np.linalg.det(right.T @ left.T))
        return np.asarray(right.T @ np.diag([1.0, 1.0, mirrored]) @ left.T)
    twist = np.array([covariance[1, 2] - covariance[2, 1], covariance[2, 0] - covariance[0, 2], 0.0])
    twist[2] = covariance[0, 1] - covariance[1, 0]
    angle = np.arctan2(up @ twist, np.trace(covariance) - up @ covariance @ up)
    return np.asarray(Rotation.from_rotvec(angle * up).as_matrix())


def share_found(points: Float[np.ndarray, "n 3"], cloud: KDTree, pose: Pose, tolerance_m: float) -> float:
    """Share of the points that have a point of the cloud within the tolerance."""
    distances, _ = cloud.query(points @ pose[0].T + pose[1], distance_upper_bound=tolerance_m)
    return float(np.isfinite(distances).mean())
