"""Version 8: labels know whether linking gave them their track id. All ids from before come from people and files."""

from __future__ import annotations

STATEMENTS = ("ALTER TABLE labels ADD COLUMN track_linked INTEGER NOT NULL DEFAULT 0 CHECK (track_linked IN (0, 1))",)
