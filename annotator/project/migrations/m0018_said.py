"""Version 18: proposals hold what each source of boxes says of their object."""

from __future__ import annotations

STATEMENTS = ("ALTER TABLE labels ADD COLUMN said TEXT",)
