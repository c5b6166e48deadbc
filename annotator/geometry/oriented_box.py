"""Oriented boxes: corners, points inside, boxes around points, upright boxes, and a canonical order of axes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from annotator.geometry.normals import normals_from_depth
from annotator.geometry.projection import inside_image, project
from annotator.types import Correction, Frame, OrientedBox, PointCloud
from annotator.types.errors import GeometryError

# Minimum side of a box around points, so that points on a plane still give a valid box.
MIN_SIDE_M = 1e-3
# Tolerance for equal boxes: metres, and entries of the rotation matrix.
SAME_BOX = 1e-6

# Order of the corners, along the box's own x, y, z: --- +-- ++- -+- --+ +-+ +++ -++
CORNER_SIGNS = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float64
)
CORNER_SIGNS.flags.writeable = False

# The 12 edges as pairs of corner indices: around the bottom, around the top, and the four vertical ones.
EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def corners(
    center: Float[np.ndarray, "*n 3"], rotation: Float[np.ndarray, "*n 3 3"], size: Float[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 8 3"]:
    """The corners of any number of boxes, in the order of `CORNER_SIGNS` and the frame of `center`, metres.

    The columns of `rotation` are box axes in that frame; `size` are full lengths along them.
    """
    half = 0.5 * CORNER_SIGNS * np.asarray(size, np.float64)[..., None, :]
    turned = half @ np.swapaxes(np.asarray(rotation, np.float64), -1, -2)
    return turned + np.asarray(center, np.float64)[..., None, :]


def box_corners(box: OrientedBox) -> Float64[np.ndarray, "8 3"]:
    """The corners of one box in the camera frame, metres, in the order of `CORNER_SIGNS`."""
    return corners(box.center_m, box.rotation, box.size_m)


def reach_along(box: OrientedBox, directions: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 2"]:
    """From where to where a box reaches along unit vectors in its frame, metres from the origin."""
    half_m, middle_m = np.abs(directions @ box.rotation) @ box.size_m / 2, directions @ box.center_m
    return np.stack([middle_m - half_m, middle_m + half_m], axis=1)


def turn_of_heading(box: OrientedBox, other: OrientedBox) -> float:
    """The angle between the headings (+x) of two boxes, radians, 0 to pi. As in web_assets/js/box3d.js."""
    return float(np.arccos(np.clip(box.rotation[:, 0] @ other.rotation[:, 0], -1.0, 1.0)))


def contains(box: OrientedBox, xyz_m: Float[np.ndarray, "n 3"], margin_m: float = 0.0) -> Bool[np.ndarray, "n"]:
    """Which points (camera frame) lie in a box with all faces moved outwards by `margin_m` metres, or on its surface.

    NaN points are outside. A negative margin shrinks the box; one that is shrunk to nothing contains no points. The
    computation uses the precision of the points, after subtracting the centre.
    """
    from annotator.geometry.kernels import points_in_box

    dtype, half_m = xyz_m.dtype, 0.5 * (box.size_m + 2.0 * margin_m)
    center_m, rotation = box.center_m.astype(dtype), box.rotation.astype(dtype, "C")
    return points_in_box(np.ascontiguousarray(xyz_m), center_m, rotation, half_m.astype(dtype))


def aligned_box(xyz_m: Float[np.ndarray, "n 3"], rotation: Float[np.ndarray, "3 3"]) -> OrientedBox:
    """The smallest box around points, metres, with given axes, the columns of `rotation` in their frame.

    Shorter sides are widened to `MIN_SIDE_M`.

    Raises:
        GeometryError: no points, or points that are not finite.
        ValueError: `rotation` is not a rotation.
    """
    if len(xyz_m) == 0:
        raise GeometryError("a box needs at least 1 point, not 0")
    if not np.isfinite(xyz_m).all():
        raise GeometryError("a box needs finite points; drop the invalid ones first")
    xyz = np.asarray(xyz_m, np.float64)
    axes = np.asarray(rotation, np.float64)
    # differences between points are more precise than the coordinates themselves
    local = (xyz - xyz[0]) @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    center = xyz[0] + axes @ (0.5 * (low + high))
    return OrientedBox.from_parts(center, axes, np.maximum(high - low, MIN_SIDE_M))


def canonical_box(box: OrientedBox, up: Float64[np.ndarray, "3"] | None) -> OrientedBox:
    """The same box with one unique labelling of its axes; 24 labellings describe the same box.

    With `up` (unit vector), z points up and length >= width; otherwise length >= width >= height. Among the remaining
    labellings, the one whose axes point away from the camera and to its right is chosen.
    """
    rotation, size = box.rotation, box.size_m
    if up is not None:
        vertical = int(np.argmax(np.abs(up @ rotation)))
        level = [i for i in range(3) if i != vertical]
        order = [*sorted(level, key=lambda i: -size[i]), vertical]
    else:
        order = list(np.argsort(-size, kind="stable"))
    axes = rotation[:, order].copy()
    if up is not None:
        axes[:, 2] *= np.sign(axes[:, 2] @ up)
    elif axes[:, 2] @ np.array([0.3, 0.1, 1.0]) < 0:
        axes[:, 2] *= -1
    if axes[:, 0] @ np.array([1.0, 0.1, 0.3]) < 0:
        axes[:, 0] *= -1
    # z cross x; np.cross takes longer than the rest of the function
    (a, b, c), (d, e, f) = axes[:, 2].tolist(), axes[:, 0].tolist()
    axes[:, 1] = (b * f - c * e, c * d - a * f, a * e - b * d)
    return OrientedBox.from_parts(box.center_m, axes, size[order])


def same_box(a: OrientedBox, b: OrientedBox) -> bool:
    """True if two boxes have the same centre, axes and size, within `SAME_BOX`."""
    # `np.allclose` takes ten times as long
    return bool((np.abs(a.pose - b.pose) <= SAME_BOX).all() and (np.abs(a.size_m - b.size_m) <= SAME_BOX).all())


def nearest_upright(box: OrientedBox, up: Float[np.ndarray, "3"]) -> tuple[OrientedBox, float]:
    """The nearest box with the same centre and sides and a vertical z axis, and the angle between both, radians.

    The box's z axis becomes vertical, unless another axis is closer to the vertical; that axis then becomes the height.
    The length axis stays the length if it is still horizontal. Among these boxes, the one with the smallest rotation
    angle is returned; an upright box is returned unchanged.

    Args:
        up: unit vector against gravity, in the box's frame.
    """
    R, size_m, rise = box.rotation, box.size_m, box.rotation.T @ up
    vertical = int(np.argmax(np.abs(rise)))
    if vertical == 2 or abs(rise[vertical]) - abs(rise[2]) < 1e-9:
        # upside down: half a turn about the length axis keeps the heading
        R = R if rise[2] >= 0 else R * np.array([1.0, -1.0, -1.0])
    else:
        # on end or on its side: the length axis is kept if it is still horizontal
        order = [1, 2, 0] if vertical == 0 else [0, 2, 1]
        R = R[:, order] * np.array([1.0, 1.0, math.copysign(1.0, rise[vertical])])
        R[:, 1] *= np.linalg.det(R)
        size_m = size_m[order]
    tilt = math.acos(min(1.0, max(-1.0, float(R[:, 2] @ up))))
    if tilt < 1e-12:
        return OrientedBox.from_parts(box.center_m, R, size_m), 0.0
    # the smallest rotation that makes z vertical; any additional yaw would increase the angle
    axis = np.cross(R[:, 2], up)
    norm = np.linalg.norm(axis)
    axis = axis / norm if norm > 1e-12 else R[:, 0]
    return OrientedBox.from_parts(box.center_m, Rotation.from_rotvec(tilt * axis).as_matrix() @ R, size_m), tilt


# The rotations of a grid that are refined, by turns of `FIRST_TURN_RAD` that are halved down to `LAST_TURN_RAD`.
STARTS = 8
FIRST_TURN_RAD, LAST_TURN_RAD = float(np.deg2rad(8)), 1e-3


def tightest_box(
    xyz_m: Float64[np.ndarray, "n 3"],
    rotations: Float64[np.ndarray, "k 3 3"],
    up: Float64[np.ndarray, "3"] | None = None,
) -> OrientedBox:
    """The box of least volume that contains all points (camera frame, metres), found by local search.

    Args:
        rotations: where the search starts; columns = box axes.
        up: unit vector; if given, boxes turn about it only.
    """
    outer = _hull(xyz_m)
    best = rotations[np.argsort(_volumes(outer, rotations))[:STARTS]]
    turns = np.concatenate([np.eye(3), -np.eye(3)]) if up is None else np.stack([up, -up])
    refined = [_refined(outer, start, turns) for start in best]
    return aligned_box(outer, refined[int(np.argmin(_volumes(outer, np.stack(refined))))])


def _refined(
    outer: Float64[np.ndarray, "n 3"], rotation: Float64[np.ndarray, "3 3"], turns: Float64[np.ndarray, "t 3"]
) -> Float64[np.ndarray, "3 3"]:
    least, turn_rad = _volumes(outer, rotation[None])[0], FIRST_TURN_RAD
    while turn_rad > LAST_TURN_RAD:
        turned = Rotation.from_rotvec(turn_rad * turns).as_matrix() @ rotation
        volumes = _volumes(outer, turned)
        if volumes.min() < least:
            rotation, least = turned[int(volumes.argmin())], volumes.min()
        else:
            turn_rad /= 2
    return rotation


def _volumes(outer: Float64[np.ndarray, "n 3"], rotations: Float64[np.ndarray, "k 3 3"]) -> Float64[np.ndarray, "k"]:
    along = np.einsum("nd,kdi->kni", outer, rotations)
    return np.asarray(np.ptp(along, axis=1).prod(axis=1))


def _hull(xyz_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "h 3"]:
    """The corners of the convex hull; all points if they are too few or flat."""
    try:
        return xyz_m[ConvexHull(xyz_m).vertices]
    except (QhullError, ValueError):
        return xyz_m


def corrected(frame: Frame, correction: Correction) -> Frame:
    """The frame with its cloud turned and shifted; what the cloud knows (normals, up, labels of its files) moves along.

    The depth image is no longer registered to the camera, so it is left out; normals are taken from it before.
    """
    if not correction.moves:
        return frame
    T, cloud = correction.T_camera_recorded, frame.cloud
    normals = cloud.normals
    if normals is None and frame.depth_m is not None and cloud.pixel_index is not None:
        normals = normals_from_depth(frame.camera, frame.depth_m).reshape(-1, 3)[cloud.pixel_index]
    moved = PointCloud(
        T.apply(cloud.xyz_m).astype(np.float32),
        cloud.rgb,
        cloud.reflectance,
        normals=None if normals is None else T.rotation.apply(normals).astype(np.float32),
    )
    label = T if frame.T_camera_label is None else T * frame.T_camera_label
    up = None if frame.up is None else np.asarray(T.rotation.apply(frame.up))
    world = None if frame.T_world_camera is None else frame.T_world_camera * T.inv()
    return _coloured(
        replace(
            frame,
            cloud=moved,
            depth_m=None,
            up=up,
            T_camera_label=label,
            T_camera_recorded=T,
            T_world_camera=world,
        )
    )


def with_image(frame: Frame, rgb: UInt8[np.ndarray, "h w 3"]) -> Frame:
    """The frame with another image of the same camera, which colours its cloud."""
    return _coloured(replace(frame, rgb=rgb))


def _coloured(frame: Frame) -> Frame:
    """The frame with the colours of its image on its cloud, if it has colours; points off the image keep theirs."""
    cloud = frame.cloud
    if cloud.rgb is None:
        return frame
    px = project(frame.camera, cloud.xyz_m)
    seen = np.flatnonzero(inside_image(frame.camera, px))
    u, v = np.round(px[seen]).astype(np.int64).T
    colours = cloud.rgb.copy()
    colours[seen] = frame.rgb[v, u]
    return replace(frame, cloud=replace(cloud, rgb=colours))


# Steps in which an axis moves to the mean of the boxes' nearest axes.
MEAN_STEPS = 5
# Share of the boxes within `CommonAxis.spread_rad`.
WITHIN = 0.9


@dataclass(frozen=True, eq=False)
class CommonAxis:
    """An axis that is near to an axis of most boxes.

    Attributes:
        axis: unit vector (3,); its sign has no meaning.
        spread_rad: nine of ten boxes have an axis within this angle of it.
        alike: how alike the boxes' headings about the axis are, modulo a quarter turn: 0 = all headings, 1 = one.
    """

    axis: Float64[np.ndarray, "3"]
    spread_rad: float
    alike: float


def common_axis(rotations: Float64[np.ndarray, "n 3 3"]) -> CommonAxis:
    """The axis with the smallest spread, among those that start from an axis of a box, a column of its rotation."""
    best, spread = rotations[0, :, 0], np.inf
    for axis in rotations.transpose(0, 2, 1).reshape(-1, 3):
        for _ in range(MEAN_STEPS):
            axis = _nearest(rotations, axis).mean(axis=0)
            axis = axis / np.linalg.norm(axis)
        angles = np.arccos(np.clip((_nearest(rotations, axis) * axis).sum(axis=1), -1, 1))
        if (reached := float(np.quantile(angles, WITHIN))) < spread:
            best, spread = axis, reached
    return CommonAxis(best, spread, _alike(rotations, best))


def _nearest(rotations: Float64[np.ndarray, "n 3 3"], axis: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "n 3"]:
    """The axis of each box that is nearest to the given one, with its sign."""
    each, along = np.arange(len(rotations)), axis @ rotations
    nearest = np.abs(along).argmax(axis=1)
    return np.asarray(rotations[each, :, nearest] * np.sign(along[each, nearest])[:, None])


def _alike(rotations: Float64[np.ndarray, "n 3 3"], axis: Float64[np.ndarray, "3"]) -> float:
    """Length of the mean of the headings' unit vectors (mean resultant length; Mardia and Jupp, Directional Statistics,
    2000), of four times the heading, since a box looks the same after a quarter turn."""
    x = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    y = np.cross(axis, x)
    across = (np.abs(axis @ rotations).argmax(axis=1) + 1) % 3
    side = rotations[np.arange(len(rotations)), :, across]
    return float(np.abs(np.exp(4j * np.arctan2(side @ y, side @ x)).mean()))
