"""A pinhole camera with OpenCV's distortion model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera; its axes are OpenCV's: x right, y down, z forward.

    Pixel coordinates are continuous and the centre of the first pixel is (0, 0), so that the image
    covers [-0.5, width_px - 0.5] x [-0.5, height_px - 0.5].

    Attributes:
        width_px, height_px: image size.
        fx, fy, cx, cy: focal lengths and principal point, pixels.
        distortion: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]] as in `cv2.projectPoints`;
            empty for an ideal pinhole.
    """

    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width_px <= 0 or self.height_px <= 0:
            raise ValueError(f"image size must be positive, not {self.width_px} x {self.height_px}")
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"focal lengths must be positive, not {self.fx}, {self.fy}")
        if len(self.distortion) not in DISTORTION_LENGTHS:
            raise ValueError(
                f"distortion must have one of {DISTORTION_LENGTHS} coefficients, not {len(self.distortion)}"
            )

    @property
    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        """The camera matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_ideal(self) -> bool:
        """True if the camera has no distortion."""
        return not any(self.distortion)
