"""Version 8: labels record whether linking assigned their track id; all older ids come from operators and files."""

from __future__ import annotations

STATEMENTS = ("ALTER TABLE labels ADD COLUMN track_linked INTEGER NOT NULL DEFAULT 0 CHECK (track_linked IN (0, 1))",)
