"""Version 4: long payloads of events are zlib-compressed blobs (`PackedText` in schema.py).

The tables and the existing rows do not change, since events are never rewritten. Only the version number changes, so
that an older annotator rejects the database instead of reading a blob as damaged JSON.
"""

from __future__ import annotations

STATEMENTS: tuple[str, ...] = ()
