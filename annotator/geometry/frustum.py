"""The points of a cloud in the frustum of a 2D box."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from annotator.geometry.projection import project
from annotator.types import Box2D, Camera


def in_frustum(camera: Camera, xyz_m: Float[np.ndarray, "n 3"], box: Box2D) -> Bool[np.ndarray, "n"]:
    """Which points project into a 2D box on the camera image, edges included.

    Args:
        camera: intrinsics and distortion.
        xyz_m: points in the camera frame, metres.
        box: on the image, pixels; it may extend beyond the image.

    Returns:
        (n,) mask; points behind the camera (z <= 0) and NaN points are outside.
    """
    return in_frustums(camera, xyz_m, [box])[0]


def in_frustums(camera: Camera, xyz_m: Float[np.ndarray, "n 3"], boxes: Sequence[Box2D]) -> list[Bool[np.ndarray, "n"]]:
    """As `in_frustum`, for several boxes on one image; the points are projected once."""
    if not boxes:
        return []
    u, v = project(camera, xyz_m).T
    # comparisons with NaN are false, so points that cannot be projected are outside
    return [(u >= box.x_min) & (u <= box.x_max) & (v >= box.y_min) & (v <= box.y_max) for box in boxes]
