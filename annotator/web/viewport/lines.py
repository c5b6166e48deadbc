"""Lines and places of things in the scene: boxes, the frustum of an image box, pictures standing in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from annotator.geometry.frustum import in_frustum
from annotator.geometry.oriented_box import CORNER_SIGNS, EDGES
from annotator.geometry.projection import undistort_px
from annotator.types import Box2D, Frame, OrientedBox, PseudoView

Segments = Float32[np.ndarray, "k 2 3"]

# Each side of an image box is followed in so many steps: lens distortion bends it.
SIDE_STEPS = 4
# The frustum ends where so many percent of its points are nearer, or here where it has none, metres.
FAR_PERCENT, EMPTY_FAR_M = 99.0, 5.0
# A picture stands in front of the nearest of its points, by this share of its larger side.
GAP = 0.15


# An arrow's head: its length and radius as shares of the arrow, and how many lines make its cone.
HEAD_LENGTH, HEAD_RADIUS, HEAD_LINES = 0.12, 0.045, 16


@dataclass(frozen=True, eq=False)
class Standing:
    """A pseudo-view as a picture in space, where it was taken from.

    Attributes:
        center_m: the middle of the picture, camera frame.
        R_camera_view: columns = right, down and into the page.
        size_m: width and height.
        seen_from_m, looks_at_m: a line along which it was taken: from in front of the picture, through its middle, to
            the middle of its points.
    """

    center_m: Float64[np.ndarray, "3"]
    R_camera_view: Float64[np.ndarray, "3 3"]
    size_m: Float64[np.ndarray, "2"]
    seen_from_m: Float64[np.ndarray, "3"]
    looks_at_m: Float64[np.ndarray, "3"]


def box_lines(size_m: Float64[np.ndarray, "3"]) -> Segments:
    """Edges of a box in its own frame, and a line from its middle out of its front (+x), which shows its heading."""
    corners = 0.5 * CORNER_SIGNS * size_m
    nose = np.array([[[0.0, 0.0, 0.0], [0.5 * size_m[0] + 0.15 * size_m.max(), 0.0, 0.0]]])
    return np.concatenate([corners[np.array(EDGES)], nose]).astype(np.float32)


def placed_box_lines(box: OrientedBox) -> Segments:
    """The same in the camera frame."""
    T_camera_box = box.T_camera_box.as_matrix()  # a frame may have a hundred boxes: `rotation` makes an object for each
    return (box_lines(box.size_m) @ T_camera_box[:3, :3].T + T_camera_box[:3, 3]).astype(np.float32)


def frustum_lines(frame: Frame, image_box: Box2D) -> Segments:
    """Rays through the corners of an image box, to the far end of what it cuts out, and the rectangle there."""
    border = _border_px(image_box)
    rays = np.column_stack([undistort_px(frame.camera, border), np.ones(len(border))])
    depth = frame.cloud.xyz_m[in_frustum(frame.camera, frame.cloud.xyz_m, image_box), 2]
    far = rays * (float(np.percentile(depth, FAR_PERCENT)) if len(depth) else EMPTY_FAR_M)
    corners = far[::SIDE_STEPS]
    lines = [*zip(np.zeros_like(corners), corners, strict=True), *zip(far, np.roll(far, -1, axis=0), strict=True)]
    found = np.array(lines, np.float32)
    # a corner beyond what the lens model reaches has no ray
    return found[np.isfinite(found).all(axis=(1, 2))]


def arrow_lines(
    start_m: Float64[np.ndarray, "3"], tip_m: Float64[np.ndarray, "3"], end_m: Float64[np.ndarray, "3"]
) -> Segments:
    """An arrow as lines: its shaft, then the cone of its head from the tip to a ring, then the ring.

    Lines are drawn in their own colour whatever the light is, which a solid arrow is not.

    Args:
        start_m, end_m: of the shaft.
        tip_m: of the head, on the shaft: an end within points would hide it.
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


def standing(view: PseudoView) -> Standing:
    """Where a pseudo-view stands: parallel to its own plane, just in front of its nearest point."""
    height_px, width_px = view.rgb.shape[:2]
    right, down = view.origin_m + 0.5 * (np.array([width_px, height_px]) - 1) * view.metres_per_px
    depth = view.xyz_m @ view.axes[2].astype(np.float32)
    near = float(depth.min()) if len(depth) else 0.0
    middle = float(np.median(depth)) if len(depth) else 0.0
    in_front = near - GAP * float(view.extent_m.max())
    seen_from = in_front - 2 * GAP * float(view.extent_m.max())
    place = np.array([[right, down, z] for z in (in_front, seen_from, middle)]) @ view.axes
    return Standing(place[0], view.axes.T.copy(), view.extent_m, place[1], place[2])


def _border_px(box: Box2D) -> Float64[np.ndarray, "n 2"]:
    corners = np.array(
        [[box.x_min, box.y_min], [box.x_max, box.y_min], [box.x_max, box.y_max], [box.x_min, box.y_max]], np.float64
    )
    share = np.arange(SIDE_STEPS)[:, None] / SIDE_STEPS
    return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
