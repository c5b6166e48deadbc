"""The projected edges of 3D boxes: the wire frames that are drawn over a camera image.

An edge is clipped to the half-spaces in front of the camera and within its field of view (Liang and Barsky, 1984). The
rest is projected. On a distorted image, it is divided into several pieces, because straight edges are curved there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from annotator.geometry.oriented_box import EDGES, corners, heading_arrow
from annotator.geometry.outline import field_of_view
from annotator.geometry.projection import camera_key, project
from annotator.types import Camera, OrientedBox

# Pieces per edge on a distorted image.
PIECES_DISTORTED = 8

# An arrow that ends farther from the image than so many times its longer side is not drawn.
FARTHEST_SIZES = 4
# Angle between an arrow's shaft and the lines of its head.
HEAD_RAD = np.pi / 6

_ENDS = np.array(EDGES)


def heading_px(camera: Camera, box: OrientedBox, head_px: float) -> Float64[np.ndarray, "k 2 2"]:
    """The arrow of a box's heading on the image, not clipped to it.

    Args:
        box: in the camera frame.
        head_px: length of the two lines of its head.

    Returns:
        (3, 2, 2) pixels, both ends (u, v) of the shaft and of the head's lines; (0, 2, 2) if it reaches behind the
        camera or far from the image.
    """
    shaft = project(camera, heading_arrow(box))
    if not (np.abs(shaft) < FARTHEST_SIZES * max(camera.width_px, camera.height_px)).all():
        return np.zeros((0, 2, 2))
    tip = shaft[1]
    back = (shaft[0] - tip) / max(float(np.linalg.norm(shaft[0] - tip)), 1e-9)
    aside = np.array([-back[1], back[0]])
    ends = [tip + head_px * (np.cos(HEAD_RAD) * back + side * np.sin(HEAD_RAD) * aside) for side in (-1, 1)]
    return np.stack([shaft, *(np.stack([tip, end]) for end in ends)])


def visible_edges(camera: Camera, boxes: Sequence[OrientedBox]) -> list[Float64[np.ndarray, "k 2 2"]]:
    """The visible parts of each box's 12 edges, as straight pieces on the image.

    Args:
        camera: distortion is taken into account.
        boxes: in the camera frame.

    Returns:
        one array per box: (k, 2, 2) pixels, both ends (u, v) of k pieces; k = 0 if the box is not visible. On a
        distorted image, pieces may extend slightly beyond the border.
    """
    if not boxes:
        return []
    poses = np.array([box.pose for box in boxes])
    sizes = np.array([box.size_m for box in boxes])
    ends = corners(poses[:, :3, 3], poses[:, :3, :3], sizes)[:, _ENDS].reshape(-1, 2, 3)
    cut, visible = cut_segments(ends, field_of_view(camera_key(camera)))
    owner = np.repeat(np.arange(len(boxes)), len(EDGES))[visible]
    pieces = 1 if camera.is_ideal else PIECES_DISTORTED
    share = np.linspace(0.0, 1.0, pieces + 1)[None, :, None]
    along = cut[visible, :1] + share * (cut[visible, 1:] - cut[visible, :1])
    px = project(camera, along.reshape(-1, 3)).reshape(-1, pieces + 1, 2)
    drawn = np.stack([px[:, :-1], px[:, 1:]], axis=2)
    return [_finite(drawn[owner == index].reshape(-1, 2, 2)) for index in range(len(boxes))]


def cut_segments(
    ends: Float64[np.ndarray, "n 2 3"], half_spaces: Float64[np.ndarray, "k 4"]
) -> tuple[Float64[np.ndarray, "n 2 3"], Bool[np.ndarray, "n"]]:
    """Line segments clipped to half-spaces, and a mask of the segments that are at least partly inside.

    Args:
        ends: both ends of each segment.
        half_spaces: rows of a normal and an offset; points with normal . p >= offset are kept.
    """
    height = ends @ half_spaces[:, :3].T - half_spaces[:, 3]
    first, last = height[:, 0], height[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = first / (first - last)
    start = np.where((first < 0) & (last >= 0), crossing, 0.0).max(axis=1)
    end = np.where((last < 0) & (first >= 0), crossing, 1.0).min(axis=1)
    visible = ~((first < 0) & (last < 0)).any(axis=1) & (start < end)
    along = ends[:, 1] - ends[:, 0]
    cut = np.stack([ends[:, 0] + start[:, None] * along, ends[:, 0] + end[:, None] * along], axis=1)
    return cut, visible


def _finite(pieces: Float64[np.ndarray, "k 2 2"]) -> Float64[np.ndarray, "m 2 2"]:
    return pieces[np.isfinite(pieces).all(axis=(1, 2))]
