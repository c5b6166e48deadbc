"""Images without lens distortion, for formats that know only ideal pinhole cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from annotator.geometry.projection import pixel_rays, project
from annotator.types import Camera


def straightened(camera: Camera, rgb: UInt8[np.ndarray, "h w 3"]) -> tuple[Camera, UInt8[np.ndarray, "h w 3"]]:
    """The ideal camera with the same matrix and size, and the image that it would have taken.

    Each pixel of the new image takes the colour that the old one has along the same ray (bilinear); rays that left the
    old image, or that its lens does not reach, are black. Without distortion both come back as they are.
    """
    if camera.is_ideal:
        return camera, rgb
    import cv2

    ideal = replace(camera, distortion=())
    plane = pixel_rays(ideal).reshape(-1, 2)
    px = project(camera, np.column_stack([plane, np.ones(len(plane), np.float32)]))
    # far outside, where the distortion model ends; remap knows no NaN
    where = np.nan_to_num(px, nan=-1e6).reshape(*rgb.shape[:2], 2).astype(np.float32)
    straight = cv2.remap(np.ascontiguousarray(rgb), where[..., 0], where[..., 1], cv2.INTER_LINEAR)
    return ideal, np.asarray(straight, np.uint8)
