"""Times are whole nanoseconds in 64 bits, the largest integer of the database."""

from __future__ import annotations

# In the year 2262.
LATEST_NS = 2**63 - 1


def too_late(time: object, unit: str) -> str:
    """Says that a time does not fit, and why that probably is.

    Args:
        time: as it stands in the file.
        unit: of the format.
    """
    return f"the time {str(time)[:40]} {unit} is beyond the year 2262, so its unit is probably another one"


def too_dense(step_ns: float) -> str:
    """Says that times follow each other faster than any sensor takes frames, and why that probably is.

    Args:
        step_ns: the median of their differences.
    """
    return f"the times are {step_ns:g} ns apart (their median), so their unit is probably another one"


def in_time(time: int, unit: str = "ns", unit_ns: int = 1) -> int:
    """Returns a time that fits; for pydantic's fields.

    Raises:
        ValueError: it does not.
    """
    if abs(time) > LATEST_NS // unit_ns:
        raise ValueError(too_late(time, unit))
    return time
