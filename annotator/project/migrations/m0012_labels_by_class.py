"""Version 12: the latest labels of a class are found without reading all labels."""

from __future__ import annotations

STATEMENTS = ("CREATE INDEX labels_by_class ON labels (label, state)",)
