"""Version 6: labels keep how well their proposal agreed with its box on the image. NULL for all proposed before."""

from __future__ import annotations

STATEMENTS = ("ALTER TABLE labels ADD COLUMN image_agreement REAL",)
