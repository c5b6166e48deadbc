"""Checks of shape, dtype and finiteness that the value types run on construction."""

from __future__ import annotations

from typing import Any

import numpy as np


def as_array(name: str, value: Any, dtype: type[np.generic], shape: tuple[int | None, ...]) -> np.ndarray:
    """`value` as a read-only array of the given dtype and shape; None in `shape` matches any length.

    Raises:
        ValueError: another shape; the message contains `name`.
    """
    array = np.asarray(value, dtype=dtype)
    matches = array.shape == shape or (
        array.ndim == len(shape)
        and all(want is None or want == have for want, have in zip(shape, array.shape, strict=True))
    )
    if not matches:
        expected = tuple("any" if n is None else n for n in shape)
        raise ValueError(f"{name} must have shape {expected}, not {array.shape}")
    if array.flags.writeable:
        array = array.view()
        array.flags.writeable = False
    return array
