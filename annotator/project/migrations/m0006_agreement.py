"""Version 6: labels hold the agreement of their proposal with its box on the image; NULL for older proposals."""

from __future__ import annotations

STATEMENTS = ("ALTER TABLE labels ADD COLUMN image_agreement REAL",)
