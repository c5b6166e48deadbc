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
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any
from zlib import crc32

import numpy as np
from jaxtyping import Integer

from annotator.files import check_file, open_file
from annotator.frame_limits import frame_memory, require_memory
from annotator.types.errors import MissingExtraError
from annotator.types.messages import amount

# Contents that are kept, of all files together: the messages of a frame are often in the same chunks.
MOST_KEPT, MOST_KEPT_BYTES = 16, 1 << 26
PIECE = 1 << 16
# Compressed bytes of a message that contain its head: the largest block of zstd.
HEAD_OF_MESSAGE = 1 << 18
# A message's channel, time of recording and place; chunk -1 = outside of chunks. `file` is set when files are joined.
MESSAGE = np.dtype([(name, np.int64) for name in ("file", "channel", "log_ns", "chunk", "offset")])


@dataclass(frozen=True)
class Channel:
    """What one publisher sent on a topic, in one file.

    Attributes:
        type: message type as the file has it: `sensor_msgs/Image`, `sensor_msgs/msg/Image`, `foxglove.RawImage`.
        encoding: of the messages: ros1, cdr, protobuf or json.
        schema_encoding, schema: definition of the type: ros1msg, ros2msg, ros2idl, protobuf or jsonschema; "" = none.
        publisher: the publisher's name; "" if unknown.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = b""
    publisher: str = ""


def listed(
    channel: int | np.ndarray,
    log_ns: Integer[np.ndarray, "n"],
    chunk: int | np.ndarray,
    offset: Integer[np.ndarray, "n"],
) -> np.ndarray:
    found = np.zeros(len(log_ns), MESSAGE)
    found["channel"], found["chunk"], found["offset"] = channel, chunk, offset
    # times beyond 2262 are damaged
    found["log_ns"] = np.minimum(log_ns, 2**63 - 1)
    return found


class BagFile:
    """One file of a bag: its channels by number, all messages (of the type `MESSAGE`), and notes on what is damaged.

    `is_slow`: reading takes so long that it is worth several threads.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.messages = np.empty(0, MESSAGE)
        self.notes: tuple[str, ...] = ()
        self.is_slow = False

    def read(self, message: np.void, most: int | None = None) -> bytes:
        """Reads one of `messages`, or its first `most` bytes or a few more."""
        raise NotImplementedError


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


def _decompressor(compression: str) -> Any:
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


class Content:
    """What is stored in pieces, decompressed as far as it was needed; several threads may read it.

    `is_damaged`: the pieces are damaged or end too early. `is_wrong`: it is complete, but its checksum is another.
    """

    def __init__(self, compression: str, pieces: Iterator[bytes], full_size: int | None = None, checksum: int = 0):
        self.data, self.is_damaged, self.is_wrong = bytearray(), False, False
        self._stream, self._pieces = _decompressor(compression), pieces
        self._full_size, self._checksum, self._lock = full_size, checksum, Lock()

    def read(self, start: int, end: int, is_checked: bool = True) -> bytes:
        """Returns the bytes from `start` to `end`, or as far as they are sound.

        `is_checked`: raises ValueError if the checksum is wrong; nothing is returned before all is decompressed.
        """
        with self._lock:
            until = max(end, self._full_size or 0) if self._checksum else end
            while len(self.data) < until and not self._stream.eof and not self.is_damaged:
                piece = next(self._pieces, None) if self._stream.needs_input else b""
                try:
                    self.data += self._stream.decompress(piece, until - len(self.data))
                except Exception:  # each library has its own; without a piece, it is a TypeError
                    self.is_damaged = True
                if self._checksum and len(self.data) == self._full_size and crc32(self.data) != self._checksum:
                    self.is_damaged = self.is_wrong = True
            if self.is_wrong and is_checked:
                raise ValueError("the checksum of a chunk is wrong: the file is damaged there")
            return bytes(memoryview(self.data)[start:end])


class ChunkedFile(BagFile):
    """A file with chunks. A chunk is decompressed only as far as its messages are needed."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.chunks: list[Chunk] = []

    def opened(self, number: int) -> Content:
        chunk = self.chunks[number]
        return Content(chunk.compression, self._pieces(chunk), chunk.full_size, chunk.checksum)

    def _pieces(self, chunk: Chunk) -> Iterator[bytes]:
        at, end = chunk.at, chunk.at + chunk.size
        # the file is not kept open: a bag may have hundreds; so pieces are larger and larger
        while piece := self._stored(at, min(max(PIECE, at - chunk.at), end - at)):
            at += len(piece)
            yield piece

    def _stored(self, at: int, size: int) -> bytes:
        with open_file(self.path) as file:
            file.seek(at)
            return file.read(max(size, 0))

    def content(self, number: int, start: int, size: int, is_checked: bool = True) -> bytes:
        """Reads `size` bytes of a chunk's content from `start`, or as far as it is sound; chunk -1 is the file."""
        chunk = self.chunks[number] if number >= 0 else Chunk(0, self.path.stat().st_size, "")
        if chunk.compression in ("", "none"):
            require_memory(more_bytes=size)
            return self._stored(chunk.at + start, min(size, chunk.size - start))
        end = start + size if chunk.full_size is None else min(start + size, chunk.full_size)
        require_memory(more_bytes=end if chunk.full_size is None else chunk.full_size)
        with KEPT_LOCK:
            content = KEPT.pop((self, number), None) or self.opened(number)
            KEPT[self, number] = content
            # the oldest ones are forgotten, but not this one
            while len(KEPT) > 1 and (
                len(KEPT) > MOST_KEPT or sum(len(each.data) for each in KEPT.values()) > MOST_KEPT_BYTES
            ):
                del KEPT[next(iter(KEPT))]
        try:
            return content.read(start, end, is_checked)
        except OSError:
            # what failed once may be read later, but not by these pieces
            with KEPT_LOCK:
                KEPT.pop((self, number), None)
            raise


# The contents that were read last, of all files, for all threads.
KEPT: dict[tuple[ChunkedFile, int], Content] = {}
KEPT_LOCK = Lock()


def unpacked_message(data: bytes, most: int | None = None) -> bytes:
    """Decompresses a zstd message of a ROS 2 bag in compression mode "message", or its first `most` bytes."""
    content = Content("zstd", iter([data]))
    unpacked = content.read(0, frame_memory() if most is None else most)
    if not unpacked or (most is None and content.is_damaged):
        raise ValueError("a message is not compressed with zstd, or damaged")
    return unpacked


# --- ROS 1 -----------------------------------------------------------------------------------------------------------

ROS1_MAGIC = b"#ROSBAG V2.0\n"
# Fields of a record's header, with their lengths before them.
IS_MESSAGE, IS_CONNECTION, OF_CONNECTION = b"\4\0\0\0op=\2", b"\4\0\0\0op=\7", b"\t\0\0\0conn="
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
                parts = [self.messages]
                for one in reader.connections:
                    schema, publisher = one.msgdef.data.encode(), one.ext.callerid or ""
                    self.channels[one.id] = Channel(one.topic, one.msgtype, "ros1", "ros1msg", schema, publisher)
                    index = [(each.time, numbers[each.chunk_pos], each.offset) for each in reader.indexes[one.id]]
                    parts.append(listed(one.id, *np.array(index, np.int64).reshape(-1, 3).T))
        except OSError:
            raise
        # of a damaged bag, rosbags raises any exception
        except Exception as error:
            problem = str(error) or type(error).__name__
            raise ValueError(
                f"has no index, or is damaged ({problem[:100]}); run rosbag reindex {path.name}"
            ) from error
        self.messages = np.concatenate(parts)
        self.is_slow = any(chunk.compression == "bz2" for chunk in self.chunks)

    def read(self, message: np.void, most: int | None = None) -> bytes:
        chunk, at = int(message["chunk"]), int(message["offset"])
        while True:
            data = self.content(chunk, at, ROS1_HEADER + (most or 0))
            end = 4 + int.from_bytes(data[:4], "little")
            header, size = data[4:end], int.from_bytes(data[end : end + 4], "little")
            # a connection may stand before its first message
            if len(data) < end + 4 or IS_CONNECTION not in header:
                break
            at += end + 4 + size
        if IS_MESSAGE not in header or OF_CONNECTION + int(message["channel"]).to_bytes(4, "little") not in header:
            raise ValueError("the index points to something that is not this message")
        wanted = size if most is None else min(size, most)
        data = self.content(chunk, at + end + 4, wanted)
        if len(data) < wanted:
            raise ValueError(f"a message ends after {len(data)} of {size} bytes: the file is damaged there")
        return data


# --- SQLite ----------------------------------------------------------------------------------------------------------

SQLITE_MAGIC = b"SQLite format 3\0"


class SqliteFile(BagFile):
    """A ROS 2 bag in an SQLite file, the only use of SQLite outside `project`. A message's offset is its row.

    `are_compressed`: each message is compressed with zstd.
    """

    def __init__(self, path: Path, are_compressed: bool = False) -> None:
        super().__init__(path)
        self._are_compressed, self._lock = are_compressed, Lock()
        check_file(path)
        # SQLite keeps what was not yet merged into a file beside it
        mode = "mode=ro" if path.with_name(path.name + "-wal").exists() else "immutable=1"
        with _sqlite_errors():
            self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True, check_same_thread=False)
            ask = self._connection.execute
            tables = {name for (name,) in ask("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not {"topics", "messages"} <= tables:
                raise ValueError("is not a ROS 2 bag: it lacks the tables topics and messages")
            definitions = {}
            # since ROS 2 Iron
            if "message_definitions" in tables:
                columns = "topic_type, encoding, encoded_message_definition"
                definitions = {
                    str(name): (str(encoding), str(text).encode())
                    for name, encoding, text in ask(f"SELECT {columns} FROM message_definitions")
                }
            for number, name, kind, encoding in ask("SELECT id, name, type, serialization_format FROM topics"):
                self.channels[int(number)] = Channel(str(name), str(kind), str(encoding), *definitions.get(kind, ()))
            self._list_messages()

    def __del__(self) -> None:
        if hasattr(self, "_connection"):
            self._connection.close()

    def read(self, message: np.void, most: int | None = None) -> bytes:
        # -1 = to the end
        wanted = -1 if most is None else HEAD_OF_MESSAGE if self._are_compressed else most
        row = int(message["offset"])
        with self._lock, _sqlite_errors(), self._connection.blobopen("messages", "data", row, readonly=True) as blob:
            data = blob.read(wanted)
        return unpacked_message(data, most) if self._are_compressed else data

    def _list_messages(self) -> None:
        # the three numbers of each: a list of lists would need six times the memory
        found, size = array("q"), self.path.stat().st_size
        try:
            for row in self._connection.execute("SELECT topic_id, timestamp, id FROM messages"):
                found.extend(map(int, row))
                # pages of a damaged file may lead to each other in circles
                if len(found) > 3 * size:
                    raise ValueError("it lists more messages than it has bytes")
        except (sqlite3.Error, OverflowError, TypeError, ValueError) as error:
            after = f"after {amount(len(found) // 3, 'message')} ({error}); the others are not used"
            self.notes = (f"{self.path.name} is damaged {after}",)
        channel, log_ns, row_id = np.array(found[: len(found) // 3 * 3], np.int64).reshape(-1, 3).T
        self.messages = listed(channel, log_ns, -1, row_id)


@contextmanager
def _sqlite_errors() -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise ValueError(f"the SQLite file is damaged ({error})") from error
