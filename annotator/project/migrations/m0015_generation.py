"""Version 15: the chain of write transactions, which tells whether a `-wal` file belongs to the database beside it.

One row of fixed length: a mark, the random token of the transaction before the last, and that of the last one.
`annotator/project/backup/generation.py` explains it.
"""

from __future__ import annotations

_GENERATION = "CREATE TABLE generation (id INTEGER PRIMARY KEY CHECK (id = 1), chain TEXT NOT NULL)"
_FIRST = f"INSERT INTO generation VALUES (1, 'annotator-generation {'0' * 32} {'0' * 32}')"

STATEMENTS = (_GENERATION, _FIRST)
