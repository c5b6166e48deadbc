"""The messages of a ROS 2 bag in an SQLite file (`.db3`), the only use of SQLite outside `project`.

Tables of rosbag2_storage_sqlite3: `topics`, `messages` and, since ROS 2 Iron, `message_definitions`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import local
from typing import TYPE_CHECKING

import numpy as np

from annotator.files import open_file
from annotator.recordings.ros.bag import Channel, ChannelBuilder
from annotator.recordings.ros.chunks import HEAD_OF_MESSAGE, MOST_BYTES, unpack_message
from annotator.types.messages import amount

if TYPE_CHECKING:
    import sqlite3

MAGIC = b"SQLite format 3\0"
ROWS_AT_ONCE = 10_000


class SqliteFile:
    """The content of an SQLite file of ROS 2; a `BagFile`. A message's offset is its row."""

    is_slow = False

    def __init__(self, path: Path, are_compressed: bool = False) -> None:
        """Lists the messages.

        Args:
            are_compressed: each message is compressed with zstd.

        Raises:
            ValueError: not such a file.
            OSError: the file cannot be read.
        """
        self.path = path
        self._are_compressed = are_compressed
        self._messages = ChannelBuilder()
        self._kept = local()
        # SQLite keeps what was not yet merged into a file beside it
        self._is_immutable = not path.with_name(path.name + "-wal").exists()
        with open_file(path) as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise ValueError("is not an SQLite file")
        with self._connected() as connection:
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not {"topics", "messages"} <= tables:
                raise ValueError("is not a ROS 2 bag: it lacks the tables topics and messages")
            definitions = {}
            if "message_definitions" in tables:
                columns = "topic_type, encoding, encoded_message_definition"
                definitions = {
                    str(name): (str(encoding), str(text).encode())
                    for name, encoding, text in connection.execute(f"SELECT {columns} FROM message_definitions")
                }
            topics = connection.execute(
                "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
            ).fetchall()
            problem = self._list_messages(connection)
        self.notes: tuple[str, ...] = (f"{path.name} {problem}",) if problem else ()
        self.channels: tuple[Channel, ...] = tuple(
            Channel(
                str(name), str(kind), str(encoding), *definitions.get(kind, ("", b"")), "", int(number),
                *self._messages.arrays(int(number)),
            )
            for number, name, kind, encoding in topics
        )  # fmt: skip

    def read(self, channel: Channel, i: int, most: int | None = None) -> bytes:
        """Reads message `i` of a channel, or its first `most` bytes."""
        with self._connected() as connection:
            blob = connection.blobopen("messages", "data", int(channel.offset[i]), readonly=True)
            with blob:
                # -1 = to the end
                wanted = -1 if most is None else most
                data = blob.read(HEAD_OF_MESSAGE if self._are_compressed and most is not None else wanted)
        return unpack_message(data, most) if self._are_compressed else data

    @contextmanager
    def many(self) -> Iterator[None]:
        """Keeps the connection open: opening it takes longer than reading the head of a message."""
        with self._connected() as connection:
            self._kept.connection = connection
            try:
                yield
            finally:
                self._kept.connection = None

    def _list_messages(self, connection: sqlite3.Connection) -> str:
        """Adds all messages; returns what is wrong with the file, "" if nothing."""
        import sqlite3

        count = 0
        try:
            rows = connection.execute("SELECT topic_id, timestamp, id FROM messages")
            while part := rows.fetchmany(ROWS_AT_ONCE):
                table = np.array(part, np.int64)
                for number in np.unique(table[:, 0]).tolist():
                    of_topic = table[table[:, 0] == number]
                    self._messages.add(int(number), of_topic[:, 1], -1, of_topic[:, 2])
                count += len(part)
                # pages of a damaged file may lead to each other in circles
                if count > self.path.stat().st_size:
                    return "is damaged: it lists more messages than it has bytes"
        except (sqlite3.Error, OverflowError, TypeError, ValueError) as error:
            return f"is damaged after {amount(count, 'message')} ({error}); the others are not used"
        return ""

    @contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        import sqlite3

        kept: sqlite3.Connection | None = getattr(self._kept, "connection", None)
        mode = "immutable=1" if self._is_immutable else "mode=ro"
        try:
            if kept is not None:
                yield kept
                return
            with closing(sqlite3.connect(f"{self.path.absolute().as_uri()}?{mode}", uri=True)) as connection:
                # a column that is computed can be of any length
                connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_BYTES)
                yield connection
        except sqlite3.Error as error:
            raise ValueError(f"the SQLite file is damaged ({error})") from error
