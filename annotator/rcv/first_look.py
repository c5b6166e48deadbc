"""The first look of an object that a class-agnostic view detector measures: crops along the depth of its frustum.

In a view of a whole frustum, an object is small beside the background, and nothing tells which of several objects the
frustum is about. So the frustum is also cut at several depths, each crop as long as the object would be wide there.
All crops go through the recursion as rivals (`finish.best_rivals`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Float64

from annotator.geometry.outline import edges_at_border
from annotator.geometry.projection import project, undistort_px
from annotator.rcv.config import MIN_POINTS, RcvConfig
from annotator.rcv.interval_fit import Intervals
from annotator.types import Box2D, BoxKind, Camera
from annotator.types.label import Edges

# The crops: percentiles of the depths in the box's middle, and lengths in multiples of the box's longer side there.
DEPTH_PERCENTILES, LENGTHS = (5.0, 20.0, 40.0, 60.0, 80.0), (1.0, 2.5)
# Expected error of the image box's edges as bounds of the 3D box, pixels.
PLANE_NOISE_PX = 2.0
# How far the outline of a whole 3D box lies outside a box around what is seen, share of its side; standard deviation.
SILHOUETTE_ROOM, SILHOUETTE_SPREAD = 0.13, 0.1
# Share of the image box, in width and height, that counts as its middle.
MIDDLE = 0.5
# Crops that share more of their points than this (IoU) are the same.
SAME_CROP = 0.9
# An image box that ends this close to the image's border may be cut off there, pixels.
BORDER_PX = 2.0


def in_middle(camera: Camera, xyz_m: Float[np.ndarray, "n 3"], image_box: Box2D) -> Bool[np.ndarray, "n"]:
    """Which points project into the middle of a 2D box; all points if none does."""
    u, v = project(camera, xyz_m).T
    half_u, half_v = MIDDLE * image_box.width_px / 2, MIDDLE * image_box.height_px / 2
    u_middle, v_middle = (image_box.x_min + image_box.x_max) / 2, (image_box.y_min + image_box.y_max) / 2
    middle = (np.abs(u - u_middle) <= half_u) & (np.abs(v - v_middle) <= half_v)
    return middle if middle.any() else np.ones(len(xyz_m), np.bool_)


def width_at(camera: Camera, image_box: Box2D, depth_m: float) -> float:
    """The longer side of a 2D box at a depth, metres."""
    return depth_m * max(image_box.width_px / camera.fx, image_box.height_px / camera.fy)


def depth_crop(xyz_m: Float[np.ndarray, "n 3"], depth_m: float, length_m: float) -> Bool[np.ndarray, "n"]:
    """Which points are at most half of `length_m` nearer or farther than `depth_m`."""
    return np.asarray(np.abs(xyz_m[:, 2] - depth_m) <= length_m / 2)


def depth_crops(camera: Camera, xyz_m: Float[np.ndarray, "n 3"], image_box: Box2D) -> list[Bool[np.ndarray, "n"]]:
    """The masks of different crops along the depth, the short ones first.

    Args:
        xyz_m: the points in the frustum of `image_box`, camera frame.
    """
    depths = np.percentile(xyz_m[in_middle(camera, xyz_m, image_box), 2], DEPTH_PERCENTILES)
    crops: list[np.ndarray] = []
    for length, depth in product(LENGTHS, depths.tolist()):
        crop = depth_crop(xyz_m, depth, length * width_at(camera, image_box, depth))
        if crop.sum() >= MIN_POINTS and all((crop & o).sum() <= SAME_CROP * (crop | o).sum() for o in crops):
            crops.append(crop)
    return crops


@dataclass(frozen=True, eq=False)
class Outline:
    """The expected outline of a 3D box on the image.

    Attributes:
        sigma_px: expected errors of its left, right, top and bottom edge, pixels.
    """

    box: Box2D
    sigma_px: Float64[np.ndarray, "4"]


def expected_outline(camera: Camera, image_box: Box2D, config: RcvConfig) -> Outline:
    """The outline of the 3D box that belongs to a box on the image.

    It is the box on the image, except that the outline of a whole 3D box lies outside a box around what is seen: its
    corners are empty. Edges at the image's border stay there.
    """
    noise_px = np.full(4, PLANE_NOISE_PX)
    if (config.image_box_kind, config.box_kind) != (BoxKind.SILHOUETTE, BoxKind.BOX):
        return Outline(image_box, noise_px)
    sides = np.array([image_box.width_px, image_box.width_px, image_box.height_px, image_box.height_px])
    room = SILHOUETTE_ROOM * sides * ~np.array(edges_at_border(camera, image_box, BORDER_PX))
    left, right, top, bottom = room.tolist()
    outline = replace(
        image_box,
        x_min=max(image_box.x_min - left, -0.5),
        x_max=min(image_box.x_max + right, camera.width_px - 0.5),
        y_min=max(image_box.y_min - top, -0.5),
        y_max=min(image_box.y_max + bottom, camera.height_px - 0.5),
    )
    return Outline(outline, np.hypot(noise_px, SILHOUETTE_SPREAD * sides))


def edges_normalised(camera: Camera, ends_px: tuple[float, float, float, float]) -> Float64[np.ndarray, "4"]:
    """Left, right, top and bottom of a rectangle on the image as x/z and y/z, at the middles of its sides."""
    left, right, top, bottom = ends_px
    u, v = (left + right) / 2, (top + bottom) / 2
    xy = undistort_px(camera, np.array([(left, v), (right, v), (u, top), (u, bottom)]))
    return np.array([xy[0, 0], xy[1, 0], xy[2, 1], xy[3, 1]])


def image_planes(camera: Camera, outline: Outline, depth_m: float) -> Intervals | None:
    """The planes through the camera and the edges of an outline, as intervals of the fit with one known end.

    A 3D box with this outline touches each of these planes from inside. Edges at the image's border are
    left out, because the object may extend beyond them.

    Args:
        depth_m: depth of the object, which turns the error of an edge into metres.
    """
    edges = known_edges(camera, outline.box)
    if (directions := edge_planes(edges)) is None:
        return None
    known = [edge is not None for edge in edges]
    slants = np.array([np.hypot(1.0, edge) for edge in edges if edge is not None])
    sigma_m = (outline.sigma_px * depth_m / np.array([camera.fx, camera.fx, camera.fy, camera.fy]))[known] / slants
    return Intervals(
        directions, np.zeros((len(directions), 2)), np.stack([np.full(len(slants), np.inf), sigma_m], axis=1)
    )


def known_edges(camera: Camera, image_box: Box2D) -> Edges:
    """The edges of a box on the image; those at the image's border are not known, since the object may go on there."""
    edges = edges_normalised(camera, (image_box.x_min, image_box.x_max, image_box.y_min, image_box.y_max)).tolist()
    at_border = edges_at_border(camera, image_box, BORDER_PX)
    left, right, top, bottom = (
        None if is_cut or not np.isfinite(edge) else edge for edge, is_cut in zip(edges, at_border, strict=True)
    )
    return left, right, top, bottom


def edge_planes(edges: Edges) -> Float64[np.ndarray, "k 3"] | None:
    """The unit normals, outward, of the planes through the camera and the known edges; None without any."""
    left, right, top, bottom = (np.nan if edge is None else edge for edge in edges)
    normals = np.array([(-1.0, 0.0, left), (1.0, 0.0, -right), (0.0, -1.0, top), (0.0, 1.0, -bottom)])
    normals = normals[np.isfinite(normals).all(axis=1)]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True) if len(normals) else None
