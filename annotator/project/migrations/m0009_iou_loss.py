"""Version 9: labels hold the expected IoU loss of their proposal; NULL for older proposals, and without a fit."""

from __future__ import annotations

STATEMENTS = ("ALTER TABLE labels ADD COLUMN expected_iou_loss REAL",)
