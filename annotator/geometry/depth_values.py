"""Depth images as sensors and programs store them, in metres: one rule for what is no measurement."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32

# The highest numbers of 16 bits and of half precision: saturated, or "no data". Other types hold converted ones.
SATURATED = (65504, 65535)


def measured(values: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """True where raw depths of any type are measurements: positive, finite, and not the highest of a type."""
    if values.dtype.kind == "f":
        values = values.astype(np.float32, copy=False)
    found = (values > 0) & (values != SATURATED[0]) & (values != SATURATED[1])
    if values.dtype.kind == "f":
        return np.asarray(found & (values < np.inf))
    return np.asarray(found & (values != np.iinfo(values.dtype).max))


def in_metres(values: np.ndarray, units_per_m: float) -> Float32[np.ndarray, "h w"]:
    """Returns depths in metres, 0 where there is no measurement (`measured`).

    Args:
        values: (h, w) raw depths, of any integer or float type.
        units_per_m: 1000 for millimetres.
    """
    with np.errstate(all="ignore"):
        depth_m = np.divide(values, np.float32(units_per_m), dtype=np.float32, casting="unsafe")
    depth_m[~measured(values)] = 0
    return np.asarray(depth_m)
