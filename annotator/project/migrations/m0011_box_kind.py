"""Version 11: labels hold what their 3D box encloses; those of earlier versions count as whole objects, as before."""

from __future__ import annotations

STATEMENTS = (
    "ALTER TABLE labels ADD COLUMN box_kind TEXT NOT NULL DEFAULT 'box' CHECK (box_kind IN ('box', 'silhouette'))",
)
