"""Projection axes of a cloud (RCV paper, section II.D): camera axes, eigenvectors, K-means over normals.

*Axes* are a (3, 3) matrix with rows a1, a2, a3 in camera coordinates, right-handed and orthonormal. The front view
looks along a3, the side view along -a1. For upright boxes a2 points down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial.transform import Rotation

from annotator.geometry.normals import normals_from_depth, normals_knn
from annotator.geometry.projection import every_nth, in_frustums
from annotator.rcv.config import MIN_POINTS, RcvConfig, Strategy
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, PointCloud

# Relative gap between eigenvalues below which they determine no axes.
MIN_FLATNESS = 0.05
# Neighbours that a normal is estimated from if there is no depth image.
NORMAL_NEIGHBOURS = 16
# Usable normals that are needed, and most that are clustered.
MIN_NORMALS, MAX_NORMALS = 30, 2000
# K-means usually converges in a few rounds; the number of rounds bounds the time if it oscillates.
KMEANS_CLUSTERS, KMEANS_SEED, KMEANS_ROUNDS = 6, 0, 20
# Upright: normals within this angle of the vertical (floor, table top) are ignored. Free: smallest angle between the
# major axis and the cluster that gives the second axis.
STEEP_NORMAL_RAD, MIN_SECOND_ANGLE_RAD = math.radians(25), math.radians(30)


class NoAxesError(Exception):
    """A strategy finds no axes in a cloud; the caller falls back to the next simpler strategy."""


@dataclass(frozen=True)
class FoundAxes:
    """Projection axes, the strategy that gave them, and why each more complex strategy failed."""

    axes: Float64[np.ndarray, "3 3"]
    strategy: Strategy
    fallback: tuple[str, ...] = ()


# The 24 rotations that map a box onto itself and relabel its axes.
BOX_SYMMETRIES: Float64[np.ndarray, "24 3 3"] = Rotation.create_group("O").as_matrix().round() + 0.0
UPRIGHT_SYMMETRIES = BOX_SYMMETRIES[BOX_SYMMETRIES[:, 1, 1] == 1.0]


def match_axes(
    axes: Float64[np.ndarray, "3 3"],
    reference: Float64[np.ndarray, "3 3"],
    symmetries: Float64[np.ndarray, "k 3 3"] = BOX_SYMMETRIES,
) -> Float64[np.ndarray, "3 3"]:
    """The relabelling of axes that is nearest to a reference; it removes quarter turns."""
    return match_all_axes(axes[None], reference, symmetries)[0]


def match_all_axes(
    axes: Float64[np.ndarray, "n 3 3"],
    reference: Float64[np.ndarray, "3 3"],
    symmetries: Float64[np.ndarray, "k 3 3"] = BOX_SYMMETRIES,
) -> Float64[np.ndarray, "n 3 3"]:
    """`match_axes` for several sets of axes at once."""
    candidates = symmetries @ axes[:, None]
    best = np.argmax(np.einsum("nkij,ij->nk", candidates, reference), axis=1)
    return candidates[np.arange(len(axes)), best]


def with_axes_like(box: OrientedBox, reference: OrientedBox) -> OrientedBox:
    """Returns the same box with its axes permuted and flipped to be as near as possible to those of another box."""
    rows = match_axes(box.rotation.T, reference.rotation.T)
    permutation = np.abs(np.rint(rows @ box.rotation))
    return OrientedBox.from_parts(box.center_m, rows.T, permutation @ box.size_m)


def axes_angle_rad(a: Float64[np.ndarray, "3 3"], b: Float64[np.ndarray, "3 3"]) -> float:
    """The smallest rotation between two sets of axes, radians; relabelled axes count as equal."""
    matched = match_axes(a, b)
    return float(np.arccos(np.clip((np.einsum("ij,ij->", matched, b) - 1) / 2, -1, 1)))


def camera_axes(up: Float64[np.ndarray, "3"] | None) -> Float64[np.ndarray, "3 3"]:
    """The camera's axes; levelled if `up` (unit vector) is given, so that a2 points along gravity."""
    if up is None:
        return np.eye(3)
    return upright_axes(np.array([0.0, 0.0, 1.0]), up)


def upright_axes(forward: Float64[np.ndarray, "3"], up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The axes with a2 = -up whose a3 is nearest to `forward`."""
    down = -up / np.linalg.norm(up)
    level = forward - down * (forward @ down)
    if np.linalg.norm(level) < 1e-6:  # looking straight up or down: the heading is arbitrary
        level = np.cross(down, [1.0, 0.0, 0.0])
    a3 = level / np.linalg.norm(level)
    return np.stack([np.cross(down, a3), down, a3])


def eigenvector_axes(
    xyz_m: Float[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"] | None
) -> Float64[np.ndarray, "3 3"]:
    """Principal axes of the points; of their footprint if `up` is given.

    Raises:
        NoAxesError: too few points, or eigenvalues that are too similar.
    """
    if len(xyz_m) < MIN_POINTS:
        raise NoAxesError(f"too few points for eigenvectors ({len(xyz_m)})")
    centred = np.asarray(xyz_m, np.float64) - np.mean(xyz_m, axis=0, dtype=np.float64)
    if up is not None:
        base = camera_axes(up)
        values, vectors = np.linalg.eigh(np.cov((centred @ base.T)[:, [0, 2]].T))
        _require_distinct(values)
        major = base[[0, 2]].T @ vectors[:, 1]
        return upright_axes(major, up)
    values, vectors = np.linalg.eigh(np.cov(centred.T))
    _require_distinct(values)
    axes = vectors.T[::-1].copy()
    axes[2] = np.cross(axes[0], axes[1])
    return axes


def _require_distinct(values: np.ndarray) -> None:
    if values[-1] <= 0 or np.diff(values).min() < MIN_FLATNESS * values[-1]:
        raise NoAxesError("eigenvalues are too similar to determine axes")


def axial_kmeans(
    directions: Float64[np.ndarray, "n 3"], clusters: int
) -> tuple[Float64[np.ndarray, "k 3"], np.ndarray]:
    """K-means of directions without sign: unit centres (k, 3), and the number of members (k,) of each.

    Similarity is |cosine|. A centre is the axial mean of its members: the principal eigenvector of the sum of n n^T.
    """
    rng = np.random.default_rng(KMEANS_SEED)
    centres = [directions[rng.integers(len(directions))]]
    # farthest-point initialisation: the centres are spread, and every cluster starts with a member
    for _ in range(clusters - 1):
        nearest = np.abs(directions @ np.array(centres).T).max(axis=1)
        centres.append(directions[np.argmin(nearest)])
    centre = np.array(centres)
    member = np.full(len(directions), -1)
    for _ in range(KMEANS_ROUNDS):
        assigned = np.argmax(np.abs(directions @ centre.T), axis=1)
        if (assigned == member).all():
            break
        member = assigned
        # one call for all clusters, as each call takes longer than its computation
        filled = [(k, members) for k in range(clusters) if len(members := directions[member == k])]
        moments = np.array([members.T @ members for _, members in filled])
        centre[[k for k, _ in filled]] = np.linalg.eigh(moments)[1][:, :, -1]
    return centre, np.bincount(member, minlength=clusters)


def normal_axes(normals: Float[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"] | None) -> Float64[np.ndarray, "3 3"]:
    """Axes with a3 along the largest cluster of normals; the next cluster (or gravity, if upright) gives the others.

    Args:
        normals: unit vectors, or zero where unknown; opposite vectors count as one direction.

    Raises:
        NoAxesError: too few usable normals.
    """
    known = np.asarray(normals, np.float64)
    known = known[np.einsum("ij,ij->i", known, known) > 0.25]
    if up is not None:
        known = known[np.abs(known @ up) < np.cos(STEEP_NORMAL_RAD)]
        known = known - np.outer(known @ up, up)
        known /= np.linalg.norm(known, axis=1, keepdims=True)
    if len(known) < MIN_NORMALS:
        raise NoAxesError(f"too few usable normals ({len(known)})")
    known = every_nth(known, MAX_NORMALS)
    centres, counts = axial_kmeans(known, min(KMEANS_CLUSTERS, len(known)))
    major = centres[np.argmax(counts)]
    if up is not None:
        return upright_axes(major, up)
    second = _second_direction(centres, counts, major)
    a1 = second - major * (second @ major)
    a1 /= np.linalg.norm(a1)
    return np.stack([a1, np.cross(major, a1), major])


def _second_direction(centres: np.ndarray, counts: np.ndarray, major: np.ndarray) -> np.ndarray:
    for index in np.argsort(-counts, kind="stable"):
        if np.abs(centres[index] @ major) < np.cos(MIN_SECOND_ANGLE_RAD):
            return centres[index]
    # Only one direction, as on a wall: use the camera axis that is most nearly perpendicular to it.
    return np.eye(3)[np.argmin(np.abs(major))]


def find_axes(
    cloud: PointCloud,
    strategy: Strategy,
    reference: Float64[np.ndarray, "3 3"],
    up: Float64[np.ndarray, "3"] | None,
    config: RcvConfig,
) -> FoundAxes:
    """The axes of a strategy, or of the next simpler one that works on the cloud, matched to `reference`.

    Args:
        strategy: camera, eigenvectors or normals.
        up: unit vector against gravity, to which one axis stays parallel, from `held_direction`; None: free axes.
    """
    symmetries = UPRIGHT_SYMMETRIES if up is not None else BOX_SYMMETRIES
    failed: list[str] = []
    simpler = {
        Strategy.NORMALS: (Strategy.NORMALS, Strategy.EIGENVECTORS),
        Strategy.EIGENVECTORS: (Strategy.EIGENVECTORS,),
    }
    for candidate in simpler.get(strategy, ()):
        try:
            if candidate is Strategy.NORMALS:
                normals = cloud.normals if cloud.normals is not None else np.zeros((0, 3))
                axes = normal_axes(normals, up)
            else:
                axes = eigenvector_axes(cloud.xyz_m, up)
        except NoAxesError as error:
            failed.append(f"{candidate}: {error}")
            continue
        return FoundAxes(match_axes(axes, reference, symmetries), candidate, tuple(failed))
    return FoundAxes(camera_axes(up), Strategy.CAMERA, tuple(failed))


def needs_normals(config: RcvConfig) -> bool:
    """True if the recursion uses normals with these settings."""
    return config.strategy is Strategy.NORMALS or (
        config.strategy is Strategy.CONSENSUS and config.box_kind is BoxKind.SILHOUETTE
    )


def with_normals(frame: Frame, mask: Bool[np.ndarray, "n"]) -> PointCloud:
    """The frame's cloud with normals, at least at the points of `mask`; zero if unknown.

    They are estimated from pixel neighbours if the cloud comes from a depth image, otherwise from the nearest
    neighbours within `mask`.
    """
    cloud = frame.cloud
    if cloud.normals is not None:
        return cloud
    if frame.depth_m is not None and cloud.pixel_index is not None:
        grid = normals_from_depth(frame.camera, frame.depth_m).reshape(-1, 3)
        return replace(cloud, normals=grid[cloud.pixel_index])
    normals = np.zeros((len(cloud), 3), np.float32)
    if mask.any():
        normals[mask] = normals_knn(cloud.xyz_m[mask], NORMAL_NEIGHBOURS)
    return replace(cloud, normals=normals)


def frame_with_normals(frame: Frame, image_boxes: Sequence[Box2D]) -> Frame:
    """The frame with normals in the frustums of all these boxes, so that they are not estimated once per object."""
    if not image_boxes or frame.cloud.normals is not None:
        return frame
    mask = np.logical_or.reduce(in_frustums(frame.camera, frame.cloud.xyz_m, image_boxes))
    return replace(frame, cloud=with_normals(frame, mask))
