"""Checks of values: shapes of arrays, and times, which are whole nanoseconds in 64 bits as in the database."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from typing import Any

import numpy as np


def as_array(name: str, value: Any, dtype: type[np.generic], shape: tuple[int | None, ...]) -> np.ndarray:
    """`value` as a read-only array of the given dtype and shape; None in `shape` matches any length."""
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


# In the year 2262.
LATEST_NS = 2**63 - 1


def too_late(time: object, unit: str) -> str:
    """Says that a time does not fit, and why that probably is."""
    return f"the time {str(time)[:40]} {unit} is beyond the year 2262, so its unit is probably another one"


def seconds_ns(text: str) -> int:
    """Returns a time in seconds, as a text, as whole nanoseconds; a float would lose some."""
    try:
        time_s = Decimal(text)
        if time_s > LATEST_NS // 10**9:
            raise ValueError(too_late(text, "s"))
        if time_s >= 0:
            return int(time_s * 10**9)
    except InvalidOperation:
        pass
    raise ValueError(f"{text[:40]!r} is no time in seconds")


def in_time(time: int, unit: str = "ns", unit_ns: int = 1) -> int:
    """Returns a time that fits; for pydantic's fields."""
    if abs(time) > LATEST_NS // unit_ns:
        raise ValueError(too_late(time, unit))
    return time
