"""The compressed parts of ROS 1 bags and MCAP files."""

from __future__ import annotations

import bz2
import sys
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any
from zlib import crc32

from annotator.files import open_file
from annotator.frame_limits import require_memory
from annotator.types.errors import MissingExtraError

# Limit of a chunk's content; recorders write some megabytes.
MOST_BYTES = 1 << 29
# Contents that are kept, of all files together: the messages of a frame are often in the same chunks.
MOST_KEPT, MOST_KEPT_BYTES = 64, 1 << 26
PIECE = 1 << 16
# Compressed bytes of a message that contain its head: the largest block of zstd.
HEAD_OF_MESSAGE = 1 << 18
UNCOMPRESSED = ("", "none")


@dataclass(frozen=True)
class Chunk:
    """A chunk's place in its file.

    Attributes:
        at, size: of its stored bytes in the file; `size` ends with the file.
        compression: "" or none, lz4, zstd or bz2.
        full_size: bytes after decompression, as declared.
        checksum: CRC-32 of the content; 0 = none.
    """

    at: int
    size: int
    compression: str
    full_size: int
    checksum: int = 0


class Kept:
    """The contents of chunks that were read last, for all threads; a bag may have hundreds of files."""

    def __init__(self) -> None:
        self._contents: OrderedDict[tuple[Chunks, int], bytes] = OrderedDict()
        self._lock = Lock()

    def get(self, chunks: Chunks, number: int) -> bytes:
        """Returns the content of a chunk as far as it is kept."""
        with self._lock:
            return self._contents.get((chunks, number), b"")

    def keep(self, chunks: Chunks, number: int, content: bytes) -> None:
        """Keeps the content of a chunk, and forgets the oldest ones beyond the limits."""
        with self._lock:
            self._contents[chunks, number] = content
            self._contents.move_to_end((chunks, number))
            total = sum(map(len, self._contents.values()))
            while len(self._contents) > 1 and (len(self._contents) > MOST_KEPT or total > MOST_KEPT_BYTES):
                total -= len(self._contents.popitem(last=False)[1])


KEPT = Kept()


class Chunks:
    """Reads the chunks of a file. A chunk is decompressed only as far as its messages are needed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.all: list[Chunk] = []

    def add(self, chunk: Chunk) -> int:
        """Adds a chunk and returns its number."""
        self.all.append(chunk)
        return len(self.all) - 1

    def read(self, number: int, start: int, size: int) -> bytes:
        """Reads `size` bytes of a chunk's content from `start`, or as far as it goes; chunk -1 is the file itself.

        Raises:
            ValueError: the chunk is damaged before their end.
            OSError: the file cannot be read.
        """
        require_memory(more_bytes=size)
        if number < 0:
            return self._stored(start, size)
        chunk = self.all[number]
        if chunk.compression in UNCOMPRESSED:
            return self._stored(chunk.at + start, min(size, chunk.size - start)) if start < chunk.size else b""
        end = min(start + size, chunk.full_size)
        content = KEPT.get(self, number)
        if len(content) < end:
            # more than is asked for, so that a chunk of many messages is not decompressed for each of them
            content = self._unpacked(chunk, end, min(max(end, 2 * len(content), PIECE), chunk.full_size))
            KEPT.keep(self, number, content)
        return content[start : start + size]

    def sound(self, number: int) -> bytes:
        """Returns a chunk's content as far as it can be read."""
        chunk = self.all[number]
        return unpack(chunk.compression, self._pieces(chunk), min(chunk.full_size, MOST_BYTES))[0]

    def _unpacked(self, chunk: Chunk, least: int, most: int) -> bytes:
        if most > MOST_BYTES:
            raise ValueError(f"a chunk declares {chunk.full_size} bytes; at most {MOST_BYTES} are supported")
        content, problem = unpack(chunk.compression, self._pieces(chunk), most)
        if len(content) < least:
            raise ValueError(problem)
        if chunk.checksum and len(content) == chunk.full_size and crc32(content) != chunk.checksum:
            raise ValueError("the checksum of a chunk is wrong")
        return content

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
    """Decompresses up to `most` bytes; returns what is sound, and what is wrong ("" if nothing).

    Raises:
        ValueError: an unknown compression.
    """
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
    return b"".join(parts), "" if length >= most else f"a chunk ends after {length} of {most} bytes"


def unpack_message(data: bytes, most: int | None = None) -> bytes:
    """Decompresses a zstd message of a ROS 2 bag in compression mode "message", or its first `most` bytes.

    Raises:
        ValueError: it is damaged.
    """
    content, problem = unpack("zstd", [data], MOST_BYTES if most is None else most)
    if not content or (most is None and "damaged" in problem):
        raise ValueError("a message is not compressed with zstd, or damaged")
    return content


class _Plain:
    """What an uncompressed chunk is "decompressed" with."""

    eof, needs_input = False, True

    def decompress(self, data: bytes, most: int) -> bytes:
        return data[:most]


def _decompressor(compression: str) -> Any:
    if compression in UNCOMPRESSED:
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
