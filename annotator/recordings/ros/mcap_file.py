"""The messages of an MCAP file, listed without reading them.

Format: the MCAP specification (mcap.dev/spec), version 0. Messages are in chunks, each followed by an index, or outside
of chunks. The reader of rosbags refuses files that are not of ROS 2 (Foxglove's protobuf and JSON), unfinished and
damaged ones, and decompresses whole chunks for the time of a message.
"""

from __future__ import annotations

import os
import struct
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np

from annotator.files import TABLE_BYTES, open_file
from annotator.frame_limits import frame_memory
from annotator.recordings.ros.bag_files import HEAD_OF_MESSAGE, Channel, Chunk, ChunkedFile, listed, unpacked_message
from annotator.types.messages import amount, first_few

# Damaged places of a file that are named.
MOST_NAMED = 8
MCAP_MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX = range(2, 9)
# A record is a byte, its kind, a length of eight bytes and its content.
RECORD = struct.Struct("<BQ")
# channel, sequence, log time, publish time
MESSAGE_HEAD = struct.Struct("<HIQQ")
# start, end, full size, checksum, length of the compression's name
CHUNK_HEAD = struct.Struct("<QQQII")
FOOTER_BYTES = RECORD.size + 20 + len(MCAP_MAGIC)
ENTRY = np.dtype([("log_ns", "<u8"), ("offset", "<u8")])
LONGEST_NAME = 64


class McapFile(ChunkedFile):
    """An MCAP file, of ROS 2 or not. After a damaged place, it is read from the next chunk that its summary names.

    `are_compressed`: each message is compressed with zstd (a mode of ROS 2).
    """

    def __init__(self, path: Path, are_compressed: bool = False) -> None:
        super().__init__(path)
        self._are_compressed = are_compressed
        self._parts = [self.messages]
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        # id of the schema, topic, encoding
        self._described: dict[int, tuple[int, str, str]] = {}
        damaged: list[str] = []
        with open_file(path) as file:
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                raise ValueError("is not an MCAP file")
            size = file.seek(0, os.SEEK_END)
            starts = _chunk_starts(file, size)
            for start, end in pairwise(sorted({len(MCAP_MAGIC), *starts, size})):
                at, is_closed = self._list(file, start, end)
                if starts and at < end and not is_closed:
                    damaged.append(f"byte {at} ({amount(end - at, 'byte is', 'bytes are')} lost)")
        self.messages = np.concatenate(self._parts)
        for number, first in zip(*np.unique(self.messages["channel"], return_index=True), strict=True):
            chunk = int(self.messages["chunk"][first])
            if int(number) not in self._described and chunk >= 0:
                self._search(chunk, describe=True)
        for number, (schema, topic, encoding) in sorted(self._described.items()):
            kind, schema_encoding, definition = self._schemas.get(schema, ("unknown", "", b""))
            self.channels[number] = Channel(topic, kind, encoding, schema_encoding, definition)
        notes = [f"is damaged at {first_few(damaged, MOST_NAMED)}"] if damaged else []
        if not starts and not is_closed:
            notes.append(
                f"was not closed by its recorder, or is damaged: it is read up to byte {min(at, size)} of {size} "
                "(mcap recover may restore more)"
            )
        lost = {*self.messages["channel"].tolist()} - self.channels.keys()
        if lost:
            notes.append(f"has messages of {amount(len(lost), 'topic')} that it does not describe; they are not used")
        self.notes = tuple(f"{path.name} {note}" for note in notes)

    def read(self, message: np.void, most: int | None = None) -> bytes:
        before, stored = RECORD.size + MESSAGE_HEAD.size, HEAD_OF_MESSAGE if most and self._are_compressed else most
        chunk, at = int(message["chunk"]), int(message["offset"])
        data = self.content(chunk, at, before + (stored or 0))
        if len(data) < before:
            raise ValueError("a message's header is truncated")
        kind, size = RECORD.unpack_from(data)
        number = MESSAGE_HEAD.unpack_from(data, RECORD.size)[0]
        if kind != MESSAGE or size < MESSAGE_HEAD.size or number != message["channel"]:
            raise ValueError("the index points to something that is not this message")
        wanted = size - MESSAGE_HEAD.size if stored is None else min(size - MESSAGE_HEAD.size, stored)
        data = data[before : before + wanted] if stored else self.content(chunk, at + before, wanted)
        if len(data) < wanted:
            raise ValueError(f"a message ends after {len(data)} of {wanted} bytes: the file is damaged there")
        return unpacked_message(data, most) if self._are_compressed else data

    def _list(self, file: BinaryIO, at: int, end: int, chunk: int = -1, describe: bool = False) -> tuple[int, bool]:
        """Adds what the records of a part of the file say, or of a chunk's content, up to the first damaged one.

        `describe` adds schemas and channels only. Returns where it ended, and whether that was at the file's footer.
        """
        first, indexed, is_closed = len(self.chunks), set(), False
        loose: dict[int, list[tuple[int, int]]] = {}
        while at + RECORD.size <= end and not is_closed:
            file.seek(at)
            kind, length = RECORD.unpack(file.read(RECORD.size))
            after = at + RECORD.size + length
            # a cut chunk is searched as far as it goes
            if not 0 < kind < 0x80 or (after > end and (kind != CHUNK or chunk >= 0)):
                break
            if kind == MESSAGE and not describe and length >= MESSAGE_HEAD.size:
                number, _, log_ns, _ = MESSAGE_HEAD.unpack(file.read(MESSAGE_HEAD.size))
                loose.setdefault(number, []).append((log_ns, at))
            elif kind == CHUNK and chunk < 0:
                self._add_chunk(file, at, end)
            elif kind == INDEX and len(self.chunks) > first:
                data = file.read(min(length, TABLE_BYTES))
                count, number = max(len(data) - 6, 0) // ENTRY.itemsize, int.from_bytes(data[:2], "little")
                self._add(number, len(self.chunks) - 1, np.frombuffer(data, ENTRY, count, 6 * (count > 0)))
                indexed.add(len(self.chunks) - 1)
            elif kind in (SCHEMA, CHANNEL):
                self._describe(kind, file.read(min(length, TABLE_BYTES)))
            is_closed = kind == FOOTER and length == 20
            at = after
        for number, entries in loose.items():
            self._add(number, chunk, np.array(entries, ENTRY))
        for number in range(first, len(self.chunks)):
            if number not in indexed:
                self._search(number)
        return at, is_closed

    def _add(self, number: int, chunk: int, entries: np.ndarray) -> None:
        self._parts.append(listed(number, entries["log_ns"], chunk, entries["offset"]))

    def _search(self, chunk: int, describe: bool = False) -> None:
        """Adds messages, schemas and channels of a chunk without an index, as far as it is sound."""
        try:
            # its messages are told to be damaged when they are read
            content = self.content(chunk, 0, min(self.chunks[chunk].full_size or 0, frame_memory()), is_checked=False)
        except ValueError:  # compressed in an unknown way
            return
        self._list(BytesIO(content), 0, len(content), chunk, describe)

    def _add_chunk(self, file: BinaryIO, at: int, end: int) -> None:
        """Adds the chunk whose record is at `at`, unless its head is damaged."""
        head = file.read(CHUNK_HEAD.size + LONGEST_NAME + 8).ljust(CHUNK_HEAD.size, b"\xff")
        _, _, full_size, checksum, name_length = CHUNK_HEAD.unpack_from(head)
        stored_at = CHUNK_HEAD.size + name_length
        if len(head) >= stored_at + 8:
            compression = head[CHUNK_HEAD.size : stored_at].decode("ascii", "replace")
            start = at + RECORD.size + stored_at + 8
            stored = min(int.from_bytes(head[stored_at : stored_at + 8], "little"), end - start)
            self.chunks.append(Chunk(start, stored, compression, full_size, checksum))

    def _describe(self, kind: int, data: bytes) -> None:
        """Adds a schema or a channel; damaged ones are left out."""
        number = int.from_bytes(data[:2], "little")
        try:
            first, at = _text(data, 2 if kind == SCHEMA else 4)
            encoding, at = _text(data, at)
        except ValueError:
            return
        if kind == CHANNEL:
            self._described.setdefault(number, (int.from_bytes(data[2:4], "little"), first, encoding))
        else:
            length = int.from_bytes(data[at : at + 4], "little")
            self._schemas.setdefault(number, (first, encoding, data[at + 4 : at + 4 + length]))


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Returns the text at `at`, and where it ends; raises ValueError if it is cut or not UTF-8."""
    end = at + 4 + int.from_bytes(data[at : at + 4], "little")
    if at + 4 > len(data) or end > len(data):
        raise ValueError("a text is cut")
    return data[at + 4 : end].decode(), end


def _chunk_starts(file: BinaryIO, size: int) -> list[int]:
    """Returns where the chunks begin by the summary of a file; none without a sound one."""
    end = size - FOOTER_BYTES
    file.seek(max(end, 0))
    footer = file.read()
    if len(footer) < FOOTER_BYTES or footer[-len(MCAP_MAGIC) :] != MCAP_MAGIC or footer[0] != FOOTER:
        return []
    at = int.from_bytes(footer[RECORD.size : RECORD.size + 8], "little")
    starts = []
    while len(MCAP_MAGIC) < at < end:
        file.seek(at)
        kind, length = RECORD.unpack(file.read(RECORD.size))
        if kind == CHUNK_INDEX and length >= 40:
            starts.append(int.from_bytes(file.read(24)[16:], "little"))
        at += RECORD.size + length
    return [start for start in starts if len(MCAP_MAGIC) < start < end] if at == end else []
