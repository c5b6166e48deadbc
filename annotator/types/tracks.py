"""Ids of objects over a recording."""

from __future__ import annotations

# Track ids go from -MOST_TRACK to MOST_TRACK: whole numbers that JSON and SQLite hold exactly.
MOST_TRACK = 2**53
