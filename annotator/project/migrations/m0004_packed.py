"""Version 4: long payloads of events are zlib-compressed blobs (`PackedText` in schema.py).

The tables stay as they are, and so do the rows that are there, since events are never rewritten. The number alone
changes: an older annotator, which would take a blob for damaged JSON, says that it is too old.
"""

from __future__ import annotations

STATEMENTS: tuple[str, ...] = ()
