"""The projected edges of 3D boxes: the wire frames that are drawn over a camera image.

An edge is clipped to the half-spaces in front of the camera and within its field of view (Liang and Barsky, 1984). The
rest is projected. On a distorted image, it is divided into several pieces, because straight edges are curved there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from annotator.geometry.oriented_box import EDGES, corners
from annotator.geometry.outline import field_of_view
from annotator.geometry.projection import camera_key, project
from annotator.types import Camera, OrientedBox

# Pieces per edge on a distorted image.
PIECES_DISTORTED = 8

_ENDS = np.array(EDGES)


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
