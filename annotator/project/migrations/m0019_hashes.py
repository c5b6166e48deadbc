"""Version 19: the registry of models has the hashes of their weights, so that a verification finds damaged ones."""

from __future__ import annotations

# SHA-256 in hexadecimal digits; NULL for models that were registered before
STATEMENTS = ("ALTER TABLE models ADD COLUMN sha256 TEXT",)
