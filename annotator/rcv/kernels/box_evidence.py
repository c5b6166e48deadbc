"""How 3D boxes agree with the points of a frustum, and their outlines on the image: loops over boxes and points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from annotator.compiled import compiled

# Corners nearer than this are moved to it before they are projected, metres.
NEAR_M = 0.05


@compiled
def outlines(
    rotation: Float64[np.ndarray, "k 3 3"],
    center: Float64[np.ndarray, "k 3"],
    size: Float64[np.ndarray, "k 3"],
    image: Float64[np.ndarray, "4"],
) -> Float64[np.ndarray, "k 4"]:
    """The projections of boxes, clipped to the image.

    Args:
        rotation: columns = box axes.
        center, size: metres, camera frame.
        image: left, right, top and bottom end of the image, normalised (x/z, y/z).

    Returns:
        left, right, top, bottom, normalised.
    """
    result = np.empty((len(center), 4))
    for k in range(len(center)):
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for corner in range(8):
            a = size[k, 0] * (0.5 if corner & 1 else -0.5)
            b = size[k, 1] * (0.5 if corner & 2 else -0.5)
            c = size[k, 2] * (0.5 if corner & 4 else -0.5)
            x = center[k, 0] + rotation[k, 0, 0] * a + rotation[k, 0, 1] * b + rotation[k, 0, 2] * c
            y = center[k, 1] + rotation[k, 1, 0] * a + rotation[k, 1, 1] * b + rotation[k, 1, 2] * c
            z = center[k, 2] + rotation[k, 2, 0] * a + rotation[k, 2, 1] * b + rotation[k, 2, 2] * c
            z = max(z, NEAR_M)
            left, right = min(left, x / z), max(right, x / z)
            top, bottom = min(top, y / z), max(bottom, y / z)
        result[k, 0] = min(max(left, image[0]), image[1])
        result[k, 1] = min(max(right, image[0]), image[1])
        result[k, 2] = min(max(top, image[2]), image[3])
        result[k, 3] = min(max(bottom, image[2]), image[3])
    return result


@compiled
def point_evidence(
    rotation: Float64[np.ndarray, "k 3 3"],
    center: Float64[np.ndarray, "k 3"],
    size: Float64[np.ndarray, "k 3"],
    points: Float64[np.ndarray, "n 3"],
    in_middle: Bool[np.ndarray, "n"],
    margin: float,
) -> Float64[np.ndarray, "k 3"]:
    """How the rays from the camera through points meet boxes.

    A ray that meets a box ends in it (a hit), behind it, or in front of it, at something that hides the box.

    Args:
        rotation, center, size: as in `outlines`.
        points: camera frame; at least one.
        in_middle: which points are in the middle of the image box.
        margin: by which the boxes are enlarged on each side, share of their mean side.

    Returns:
        hits as shares of all points, of those not ending in front, and of the middle's points not ending in front.
    """
    count = len(points)
    result = np.empty((len(center), 3))
    origin, half = np.empty(3), np.empty(3)
    for k in range(len(center)):
        mean = (size[k, 0] + size[k, 1] + size[k, 2]) / 3
        for axis in range(3):
            half[axis] = size[k, axis] / 2 + margin * mean
            origin[axis] = -(
                rotation[k, 0, axis] * center[k, 0]
                + rotation[k, 1, axis] * center[k, 1]
                + rotation[k, 2, axis] * center[k, 2]
            )
        hits, behind, hits_middle, open_middle = 0, 0, 0, 0
        for i in range(count):
            enter, leave = -np.inf, np.inf
            for axis in range(3):
                along = (
                    rotation[k, 0, axis] * points[i, 0]
                    + rotation[k, 1, axis] * points[i, 1]
                    + rotation[k, 2, axis] * points[i, 2]
                )
                first, second = (-half[axis] - origin[axis]) / along, (half[axis] - origin[axis]) / along
                enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
            meets = enter < leave and leave > 0
            is_front = meets and enter > 1
            is_hit = meets and enter <= 1 and leave >= 1
            hits += is_hit
            behind += meets and leave < 1
            if in_middle[i] and not is_front:
                open_middle += 1
                hits_middle += is_hit
        result[k, 0] = hits / count
        result[k, 1] = hits / max(hits + behind, 1)
        result[k, 2] = hits_middle / max(open_middle, 1)
    return result
