"""SUN RGB-D's depth images: millimetres whose 16 bits are rotated left by three (SUNRGBDtoolbox, `read3dPoints.m`)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt16

from annotator.geometry.projection import in_metres, measured

# Depths below 8.192 m become multiples of eight, which few plain values are.
LEAST_MULTIPLES = 0.9
# Read as they are, their far parts are beyond this, metres: farther than depth cameras see.
FAR_M, FAR_SHARE = 8.192, 0.95


def decode_depth(raw: UInt16[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Returns the metres of a SUN RGB-D depth image."""
    return in_metres(raw >> np.uint16(3) | raw << np.uint16(13), 1000.0)


def looks_rotated(raw: UInt16[np.ndarray, "h w"], depth_scale: float) -> bool:
    """True if a depth image of so many units per metre is rather one of SUN RGB-D."""
    known = measured(raw)
    count = np.count_nonzero(known)
    # counted without a copy of the values: nearly all images end here
    if count == 0 or 1 - np.count_nonzero((raw & np.uint16(7)).astype(bool) & known) / count < LEAST_MULTIPLES:
        return False
    return bool(np.quantile(raw[known], FAR_SHARE) / depth_scale > FAR_M)
