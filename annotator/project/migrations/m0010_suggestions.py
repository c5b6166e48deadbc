"""Version 10: labels hold the detector that suggested their boxes, as JSON; NULL for older labels."""

from __future__ import annotations

STATEMENTS = ("ALTER TABLE labels ADD COLUMN suggestion TEXT",)
