"""The files of bags: messages are listed without reading them, and each is read on request, as far as it is needed.

ROS 1 (`.bag`) is listed by rosbags; MCAP (`mcap_file.py`) and SQLite (`.db3`) by annotator: rosbags ignores what is not
yet merged into an SQLite file, and reads whole messages, of which opening a bag needs only the times in their heads.

Formats: "Bags/Format/2.0" of the ROS wiki; the tables of rosbag2_storage_sqlite3. ROS 1 and MCAP have chunks: messages
that are compressed together.
"""

from __future__ import annotations

import bz2
import sqlite3
import sys
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, local
from typing import Any
from zlib import crc32

import numpy as np
from jaxtyping import Int64

from annotator.files import check_file, open_file
from annotator.frame_limits import frame_memory, require_memory
from annotator.types.errors import MissingExtraError
from annotator.types.messages import amount

# Contents that are kept, of all files together: the messages of a frame are often in the same chunks.
MOST_KEPT_BYTES = 1 << 26
PIECE = 1 << 16
# Compressed bytes of a message that contain its head: the largest block of zstd.
HEAD_OF_MESSAGE = 1 << 18


@dataclass(frozen=True, eq=False)
class Channel:
    """What one publisher sent on a topic, in one file.

    Attributes:
        topic: its name.
        type: message type as the file has it: `sensor_msgs/Image`, `sensor_msgs/msg/Image`, `foxglove.RawImage`.
        encoding: of the messages: ros1, cdr, protobuf or json.
        schema_encoding, schema: definition of the type: ros1msg, ros2msg, ros2idl, protobuf or jsonschema; "" = none.
        publisher: the publisher's name; "" if unknown.
        number: of the channel in its file.
        log_ns, chunk, offset: of each message: time of recording and place in the file; chunk -1 = outside chunks.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str
    schema: bytes
    publisher: str
    number: int
    log_ns: Int64[np.ndarray, "n"]
    chunk: Int64[np.ndarray, "n"]
    offset: Int64[np.ndarray, "n"]


class BagFile:
    """One file of a bag.

    Attributes:
        path: the file.
        channels: its channels.
        notes: what is damaged or missing, as sentences.
        is_slow: reading takes so long that it is worth several threads.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: tuple[Channel, ...] = ()
        self.notes: tuple[str, ...] = ()
        self.is_slow = False

    def read(self, channel: Channel, i: int, most: int | None = None) -> bytes:
        """Reads message `i` of a channel, or its first `most` bytes or a few more."""
        raise NotImplementedError

    def many(self) -> AbstractContextManager[None]:
        """Makes the reading of many messages faster, by this thread and within the block."""
        return nullcontext()


class Messages:
    """Collects the messages of a file while its records are listed."""

    def __init__(self) -> None:
        self._parts: dict[int, list[tuple[np.ndarray, int, np.ndarray]]] = {}
        self.first_chunk: dict[int, int] = {}

    def add(self, number: int, log_ns: np.ndarray, chunk: int, offset: np.ndarray) -> None:
        """Adds messages of channel `number`: times and offsets in a chunk."""
        # times beyond 2262 are damaged
        log_ns, offset = (np.minimum(values, 2**63 - 1).astype(np.int64) for values in (log_ns, offset))
        self._parts.setdefault(number, []).append((log_ns, chunk, offset))
        self.first_chunk.setdefault(number, chunk)

    def arrays(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns log_ns, chunk and offset of a channel's messages."""
        if number not in self._parts:
            return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64)
        times, chunks, offsets = zip(*self._parts[number], strict=True)
        chunk = np.repeat(np.array(chunks, np.int64), [len(time) for time in times])
        return np.concatenate(times), chunk, np.concatenate(offsets)


@dataclass(frozen=True)
class Chunk:
    """A chunk's place in its file.

    Attributes:
        at, size: of its stored bytes in the file.
        compression: "" or none, lz4, zstd or bz2.
        full_size: bytes after decompression, as declared; None = not known.
        checksum: CRC-32 of the content; 0 = none.
    """

    at: int
    size: int
    compression: str
    full_size: int | None = None
    checksum: int = 0


class _Kept:
    """The contents of chunks that were read last, for all threads; a bag may have hundreds of files."""

    def __init__(self) -> None:
        self._contents: OrderedDict[tuple[ChunkedFile, int], tuple[bytes, bool]] = OrderedDict()
        self._lock = Lock()

    def get(self, file: ChunkedFile, number: int) -> tuple[bytes, bool]:
        """Returns the content of a chunk as far as it is kept, and whether that is all of it."""
        with self._lock:
            return self._contents.get((file, number), (b"", False))

    def keep(self, file: ChunkedFile, number: int, content: bytes, is_all: bool) -> None:
        """Keeps the content of a chunk, and forgets the oldest ones beyond the limits."""
        with self._lock:
            self._contents[file, number] = content, is_all
            self._contents.move_to_end((file, number))
            total = sum(len(content) for content, _ in self._contents.values())
            while len(self._contents) > 1 and total > MOST_KEPT_BYTES:
                total -= len(self._contents.popitem(last=False)[1][0])


KEPT = _Kept()


class ChunkedFile(BagFile):
    """A file with chunks. A chunk is decompressed only as far as its messages are needed."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.chunks: list[Chunk] = []

    def content(self, number: int, start: int, size: int) -> bytes:
        """Reads `size` bytes of a chunk's content from `start`, or as far as it goes; chunk -1 is the file itself."""
        require_memory(more_bytes=size)
        if number < 0:
            return self._stored(start, size)
        chunk = self.chunks[number]
        if chunk.compression in ("", "none"):
            return self._stored(chunk.at + start, min(size, chunk.size - start))
        longest = frame_memory() if chunk.full_size is None else chunk.full_size
        end = min(start + size, longest)
        content, is_all = KEPT.get(self, number)
        if len(content) < end and not is_all:
            # more than is asked for, so that a chunk of many messages is not decompressed for each of them
            most = min(max(end, 2 * len(content), PIECE), longest)
            require_memory(more_bytes=most)
            content, problem = unpack(chunk.compression, self._pieces(chunk), most)
            if problem and len(content) < end:
                raise ValueError(problem)
            is_all = len(content) < most or len(content) == chunk.full_size
            if chunk.checksum and len(content) == chunk.full_size and crc32(content) != chunk.checksum:
                raise ValueError("the checksum of a chunk is wrong")
            KEPT.keep(self, number, content, is_all)
        return content[start : start + size]

    def sound(self, number: int) -> bytes:
        """Returns a chunk's content as far as it can be read; nothing of an unknown compression."""
        chunk = self.chunks[number]
        try:
            return unpack(
                chunk.compression, self._pieces(chunk), min(chunk.full_size or frame_memory(), frame_memory())
            )[0]
        except ValueError:
            return b""

    def _pieces(self, chunk: Chunk) -> Iterator[bytes]:
        with open_file(self.path) as file:
            file.seek(chunk.at)
            left = chunk.size
            while left > 0 and (piece := file.read(min(PIECE, left))):
                left -= len(piece)
                yield piece

    def _stored(self, at: int, size: int) -> bytes:
        with open_file(self.path) as file:
            file.seek(at)
            return file.read(max(size, 0))


def unpack(compression: str, pieces: Iterable[bytes], most: int) -> tuple[bytes, str]:
    """Decompresses up to `most` bytes; returns what is sound, and what is wrong ("" if nothing)."""
    stream, parts, length = _decompressor(compression), [], 0
    for piece in pieces:
        try:
            parts.append(stream.decompress(piece, most - length))
            length += len(parts[-1])
            while length < most and not stream.eof and not stream.needs_input:
                parts.append(stream.decompress(b"", most - length))
                length += len(parts[-1])
        except Exception as error:  # each library has its own
            return b"".join(parts), f"a chunk is damaged ({error})"
        if length >= most or stream.eof:
            break
    is_cut = length < most and not stream.eof
    return b"".join(parts), f"a chunk ends after {length} of {most} bytes" if is_cut else ""


def unpacked_message(data: bytes, most: int | None = None) -> bytes:
    """Decompresses a zstd message of a ROS 2 bag in compression mode "message", or its first `most` bytes."""
    content, problem = unpack("zstd", [data], frame_memory() if most is None else most)
    if not content or (most is None and problem):
        raise ValueError("a message is not compressed with zstd, or damaged")
    return content


class _Plain:
    """What an uncompressed chunk is "decompressed" with."""

    eof, needs_input = False, True

    def decompress(self, data: bytes, most: int) -> bytes:
        return data[:most]


def _decompressor(compression: str) -> Any:
    if compression in ("", "none"):
        return _Plain()
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    try:
        if compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            return LZ4FrameDecompressor()
        if compression == "zstd":
            # the standard library's, if this Python has it
            if sys.version_info >= (3, 14):
                from compression.zstd import ZstdDecompressor
            else:
                from backports.zstd import ZstdDecompressor

            return ZstdDecompressor()
    except ImportError as error:
        raise MissingExtraError("rosbags", "ros") from error
    raise ValueError(f"the compression {compression!r} is unknown")


# --- ROS 1 -----------------------------------------------------------------------------------------------------------

ROS1_MAGIC = b"#ROSBAG V2.0\n"
MESSAGE_OP, CONNECTION_OP = 2, 7
# Bytes that hold a message's header: it has 43 in every known writer.
ROS1_HEADER = 1 << 10


class Ros1File(ChunkedFile):
    """A ROS 1 bag with an index, which rosbags reads."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            from rosbags.rosbag1.reader import Reader, decompressors
        except ImportError as error:
            raise MissingExtraError("rosbags", "ros") from error
        check_file(path)
        compressions = {function: name for name, function in decompressors.items()}
        try:
            with Reader(path) as reader:
                numbers = {at: number for number, at in enumerate(reader.chunks)}
                for chunk in reader.chunks.values():
                    self.chunks.append(Chunk(chunk.datapos, chunk.datasize, compressions[chunk.decompressor]))
                for connection in reader.connections:
                    index = reader.indexes[connection.id]
                    places = np.array([(each.time, numbers[each.chunk_pos], each.offset) for each in index], np.int64)
                    self.channels += (
                        Channel(
                            connection.topic, connection.msgtype, "ros1", "ros1msg", connection.msgdef.data.encode(),
                            connection.ext.callerid or "", connection.id,
                            *np.ascontiguousarray(places.reshape(-1, 3).T),
                        ),
                    )  # fmt: skip
        except OSError:
            raise
        # of a damaged bag, rosbags raises any exception
        except Exception as error:
            problem = str(error) or type(error).__name__
            raise ValueError(
                f"has no index, or is damaged ({problem[:100]}); run rosbag reindex {path.name}"
            ) from error
        self.is_slow = any(chunk.compression == "bz2" for chunk in self.chunks)

    def read(self, channel: Channel, i: int, most: int | None = None) -> bytes:
        chunk, at = int(channel.chunk[i]), int(channel.offset[i])
        while True:
            head = self.content(chunk, at, ROS1_HEADER + (most or 0))
            length = int.from_bytes(head[:4], "little")
            fields, size = _ros1_fields(head[4 : 4 + length]), int.from_bytes(head[4 + length : 8 + length], "little")
            start = at + 8 + length
            if len(head) < 8 + length:
                raise ValueError("a message's header is damaged or truncated")
            # a connection may stand before its first message
            if fields.get(b"op") != bytes([CONNECTION_OP]):
                break
            at = start + size
        if fields.get(b"op") != bytes([MESSAGE_OP]) or fields.get(b"conn") != channel.number.to_bytes(4, "little"):
            raise ValueError("the index points to something that is not this message")
        wanted = size if most is None else min(size, most)
        data = self.content(chunk, start, wanted)
        if len(data) < wanted:
            raise ValueError(f"a message ends after {len(data)} of {size} bytes")
        return data


def _ros1_fields(data: bytes) -> dict[bytes, bytes]:
    """Returns the named fields of a record's header, up to the first damaged one."""
    fields: dict[bytes, bytes] = {}
    at = 0
    while at + 4 <= len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields


# --- SQLite ----------------------------------------------------------------------------------------------------------

SQLITE_MAGIC = b"SQLite format 3\0"
ROWS_AT_ONCE = 10_000


class SqliteFile(BagFile):
    """A ROS 2 bag in an SQLite file, the only use of SQLite outside `project`. A message's offset is its row.

    Args:
        are_compressed: each message is compressed with zstd.
    """

    def __init__(self, path: Path, are_compressed: bool = False) -> None:
        super().__init__(path)
        self._are_compressed = are_compressed
        self._messages = Messages()
        self._kept = local()
        # SQLite keeps what was not yet merged into a file beside it
        self._is_immutable = not path.with_name(path.name + "-wal").exists()
        with open_file(path) as file:
            if file.read(len(SQLITE_MAGIC)) != SQLITE_MAGIC:
                raise ValueError("is not an SQLite file")
        with self._connected() as connection:
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not {"topics", "messages"} <= tables:
                raise ValueError("is not a ROS 2 bag: it lacks the tables topics and messages")
            definitions = {}
            # since ROS 2 Iron
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
        self.notes = (f"{path.name} {problem}",) if problem else ()
        self.channels = tuple(
            Channel(
                str(name), str(kind), str(encoding), *definitions.get(kind, ("", b"")), "", int(number),
                *self._messages.arrays(int(number)),
            )
            for number, name, kind, encoding in topics
        )  # fmt: skip

    def read(self, channel: Channel, i: int, most: int | None = None) -> bytes:
        wanted = HEAD_OF_MESSAGE if self._are_compressed and most is not None else most
        with (
            self._connected() as connection,
            connection.blobopen("messages", "data", int(channel.offset[i]), readonly=True) as blob,
        ):
            # -1 = to the end
            data = blob.read(-1 if wanted is None else wanted)
        return unpacked_message(data, most) if self._are_compressed else data

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
        count = 0
        try:
            rows = connection.execute("SELECT topic_id, timestamp, id FROM messages")
            while part := rows.fetchmany(ROWS_AT_ONCE):
                table = np.array(part, np.int64)
                for number in np.unique(table[:, 0]).tolist():
                    of_topic = table[table[:, 0] == number]
                    self._messages.add(number, of_topic[:, 1], -1, of_topic[:, 2])
                count += len(part)
                # pages of a damaged file may lead to each other in circles
                if count > self.path.stat().st_size:
                    return "is damaged: it lists more messages than it has bytes"
        except (sqlite3.Error, OverflowError, TypeError, ValueError) as error:
            return f"is damaged after {amount(count, 'message')} ({error}); the others are not used"
        return ""

    @contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        kept: sqlite3.Connection | None = getattr(self._kept, "connection", None)
        mode = "immutable=1" if self._is_immutable else "mode=ro"
        try:
            if kept is not None:
                yield kept
                return
            with closing(sqlite3.connect(f"{self.path.absolute().as_uri()}?{mode}", uri=True)) as connection:
                yield connection
        except sqlite3.Error as error:
            raise ValueError(f"the SQLite file is damaged ({error})") from error
