"""The compressed parts of ROS 1 bags and MCAP files."""

from __future__ import annotations

import bz2
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from zlib import crc32

from annotator.types.errors import MissingExtraError

# Limit of a chunk's content; recorders write some megabytes.
MOST_BYTES = 1 << 29
# Chunks kept decompressed: the messages of a frame are often in the same ones.
MOST_KEPT = 2
PIECE = 1 << 20
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


class Chunks:
    """Reads the chunks of a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.all: list[Chunk] = []
        self._kept: Callable[[int], bytes] = lru_cache(maxsize=MOST_KEPT)(self._whole)

    def add(self, chunk: Chunk) -> int:
        """Adds a chunk and returns its number."""
        self.all.append(chunk)
        return len(self.all) - 1

    def read(self, number: int, start: int, size: int, is_head: bool = False) -> bytes:
        """Reads `size` bytes of a chunk's content from `start`, or as far as it goes; chunk -1 is the file itself.

        Args:
            is_head: only the first bytes of messages are read, so a chunk is decompressed only as far as needed.

        Raises:
            ValueError: the chunk is damaged.
            OSError: the file cannot be read.
        """
        if number < 0:
            return self._stored(start, size)
        chunk = self.all[number]
        if chunk.compression in UNCOMPRESSED:
            return self._stored(chunk.at + start, min(size, chunk.size - start)) if start < chunk.size else b""
        if is_head:
            content, _ = unpack(chunk.compression, self._stored(chunk.at, chunk.size), start + size)
        else:
            content = self._kept(number)
        return content[start : start + size]

    def sound(self, number: int) -> bytes:
        """Returns a chunk's content as far as it can be read."""
        chunk = self.all[number]
        stored = self._stored(chunk.at, chunk.size)
        return unpack(chunk.compression, stored, min(chunk.full_size, MOST_BYTES))[0]

    def _whole(self, number: int) -> bytes:
        chunk = self.all[number]
        if chunk.full_size > MOST_BYTES:
            raise ValueError(f"a chunk declares {chunk.full_size} bytes; at most {MOST_BYTES} are supported")
        content, problem = unpack(chunk.compression, self._stored(chunk.at, chunk.size), chunk.full_size)
        if problem:
            raise ValueError(problem)
        if chunk.checksum and crc32(content) != chunk.checksum:
            raise ValueError("the checksum of a chunk is wrong")
        return content

    def _stored(self, at: int, size: int) -> bytes:
        with self.path.open("rb") as file:
            file.seek(at)
            return file.read(max(size, 0))


def unpack(compression: str, data: bytes, most: int) -> tuple[bytes, str]:
    """Decompresses up to `most` bytes; returns what is sound, and what is wrong ("" if nothing).

    Raises:
        ValueError: an unknown compression.
    """
    if compression in UNCOMPRESSED:
        return data[:most], ""
    stream, parts, length = _decompressor(compression), [], 0
    for start in range(0, len(data), PIECE):
        try:
            parts.append(stream.decompress(data[start : start + PIECE], most - length))
            length += len(parts[-1])
            while length < most and not stream.eof and not stream.needs_input:
                parts.append(stream.decompress(b"", most - length))
                length += len(parts[-1])
        except Exception as error:  # each library has its own
            return b"".join(parts), f"a chunk is damaged ({error})"
        if length >= most or stream.eof:
            break
    return b"".join(parts), "" if length >= most else f"a chunk ends after {length} of {most} bytes"


def unpack_message(data: bytes) -> bytes:
    """Decompresses a zstd message of a ROS 2 bag in compression mode "message".

    Raises:
        ValueError: it is damaged.
    """
    content, _ = unpack("zstd", data, MOST_BYTES)
    if not content:
        raise ValueError("a message is not compressed with zstd")
    return content


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
