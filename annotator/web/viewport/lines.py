"""Geometry of the drawn scene: lines of boxes, frustums and arrows, and poses of pseudo-views in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from annotator.geometry.oriented_box import CORNER_SIGNS, EDGES
from annotator.geometry.projection import in_frustum, undistort_px
from annotator.types import Box2D, Frame, OrientedBox, PseudoView

Segments = Float32[np.ndarray, "k 2 3"]

# Number of segments per side of an image box, since lens distortion curves its rays.
SIDE_STEPS = 4
# The frustum ends at this percentile of its points' depths; if it has no points, at this depth, metres.
FAR_PERCENT, EMPTY_FAR_M = 99.0, 5.0
# Distance between a view's image and the nearest of its points, as a share of the view's larger side.
GAP = 0.15
# An arrow's head: length and radius as shares of the arrow, and number of lines of its cone.
HEAD_LENGTH, HEAD_RADIUS, HEAD_LINES = 0.12, 0.045, 16
# The head of a box's heading begins and ends in front of the box, where no edge hides it: distances from the front and
# radius, shares of the box's mean side.
HEADING_FROM, HEADING_TO, HEADING_RADIUS = 0.08, 0.4, 0.13


@dataclass(frozen=True, eq=False)
class ViewPlacement:
    """The pose of a pseudo-view's image in space, facing the direction that it was rendered from.

    Attributes:
        center_m: centre of the image, camera frame.
        R_camera_view: columns = right, down and into the image.
        size_m: width and height.
        seen_from_m, looks_at_m: ends of the viewing direction's arrow: from in front of the image, through its centre,
            to the median depth of its points.
    """

    center_m: Float64[np.ndarray, "3"]
    R_camera_view: Float64[np.ndarray, "3 3"]
    size_m: Float64[np.ndarray, "2"]
    seen_from_m: Float64[np.ndarray, "3"]
    looks_at_m: Float64[np.ndarray, "3"]


def box_lines(size_m: Float64[np.ndarray, "3"]) -> Segments:
    """Edges of a box in its own axes, and an arrow from the middle of its top to beyond its front (+x): its heading.

    At the top, the object's own points do not hide it. Its head is four lines from the tip to the corners of a square,
    and the square: seen from anywhere, some of them are beside the shaft.
    """
    corners = 0.5 * CORNER_SIGNS * size_m
    (length_m, _, height_m), mean_m = size_m, size_m.mean()
    middle, ahead = np.array([0.0, 0.0, 0.5 * height_m]), np.array([1.0, 0.0, 0.0])
    tip = middle + (0.5 * length_m + HEADING_TO * mean_m) * ahead
    around = np.array([[0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]])
    square = middle + (0.5 * length_m + HEADING_FROM * mean_m) * ahead + HEADING_RADIUS * mean_m * around
    shaft = np.stack([middle, tip])
    head = np.stack([np.broadcast_to(tip, square.shape), square], axis=1)
    rim = np.stack([square, np.roll(square, -1, axis=0)], axis=1)
    return np.concatenate([corners[np.array(EDGES)], shaft[None], head, rim]).astype(np.float32)


def placed_box_lines(box: OrientedBox) -> Segments:
    """As `box_lines`, in the camera frame."""
    pose = box.pose
    return (box_lines(box.size_m) @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)


def frustum_lines(frame: Frame, image_box: Box2D) -> Segments:
    """The frustum of an image box: rays through its corners to the far end, and the outline there."""
    border = _border_px(image_box)
    rays = np.column_stack([undistort_px(frame.camera, border), np.ones(len(border))])
    depth = frame.cloud.xyz_m[in_frustum(frame.camera, frame.cloud.xyz_m, image_box), 2]
    far = rays * (float(np.percentile(depth, FAR_PERCENT)) if len(depth) else EMPTY_FAR_M)
    corners = far[::SIDE_STEPS]
    lines = [*zip(np.zeros_like(corners), corners, strict=True), *zip(far, np.roll(far, -1, axis=0), strict=True)]
    segments = np.array(lines, np.float32)
    # a corner outside the range of the lens model has no ray
    return segments[np.isfinite(segments).all(axis=(1, 2))]


def arrow_lines(
    start_m: Float64[np.ndarray, "3"], tip_m: Float64[np.ndarray, "3"], end_m: Float64[np.ndarray, "3"]
) -> Segments:
    """An arrow as lines: its shaft, then the cone of its head from the tip to a ring, then the ring.

    The colour of lines does not depend on the lights, in contrast to that of a mesh.

    Args:
        start_m, end_m: of the shaft.
        tip_m: tip of the head, on the shaft: at the end of the shaft, points would hide it.
    """
    along = end_m - start_m
    length = float(np.linalg.norm(along))
    direction = along / length
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    across /= np.linalg.norm(across)
    angle = 2 * np.pi * np.arange(HEAD_LINES)[:, None] / HEAD_LINES
    spokes = np.cos(angle) * across + np.sin(angle) * np.cross(direction, across)
    ring = tip_m - HEAD_LENGTH * along + HEAD_RADIUS * length * spokes
    cone = np.stack([np.broadcast_to(tip_m, ring.shape), ring], axis=1)
    rim = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)
    return np.concatenate([np.stack([start_m, end_m])[None], cone, rim]).astype(np.float32)


def view_placement(view: PseudoView) -> ViewPlacement:
    """The pose of a pseudo-view's image: parallel to its plane, in front of its nearest point."""
    height_px, width_px = view.rgb.shape[:2]
    right, down = view.origin_m + 0.5 * (np.array([width_px, height_px]) - 1) * view.metres_per_px
    depth = view.xyz_m @ view.axes[2].astype(np.float32)
    near = float(depth.min()) if len(depth) else 0.0
    median = float(np.median(depth)) if len(depth) else 0.0
    in_front = near - GAP * float(view.extent_m.max())
    seen_from = in_front - 2 * GAP * float(view.extent_m.max())
    points = np.array([[right, down, z] for z in (in_front, seen_from, median)]) @ view.axes
    return ViewPlacement(points[0], view.axes.T.copy(), view.extent_m, points[1], points[2])


def _border_px(box: Box2D) -> Float64[np.ndarray, "n 2"]:
    corners = np.array(
        [[box.x_min, box.y_min], [box.x_max, box.y_min], [box.x_max, box.y_max], [box.x_min, box.y_max]], np.float64
    )
    share = np.arange(SIDE_STEPS)[:, None] / SIDE_STEPS
    return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
