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
    return f"the time {str(time)[:40]} {unit} is beyond the year 2262; its unit is probably not {unit}: correct it"
