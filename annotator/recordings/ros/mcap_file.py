"""The messages of an MCAP file, listed without reading them.

Format: the MCAP specification (mcap.dev/spec), version 0. Messages are in chunks, each followed by an index, or outside
of chunks. The reader of rosbags refuses files that are not of ROS 2 (Foxglove's protobuf and JSON), unfinished and
damaged ones, and decompresses whole chunks for the time of a message.
"""

from __future__ import annotations

import os
import struct
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np

from annotator.files import TABLE_BYTES, open_file
from annotator.recordings.ros.bag_files import HEAD_OF_MESSAGE, Channel, Chunk, ChunkedFile, Messages, unpacked_message
from annotator.types.messages import amount

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
    """An MCAP file, of ROS 2 or not. The summary at its end names the chunks; without it, the file is walked through.

    Args:
        are_compressed: each message is compressed with zstd (a mode of ROS 2).
    """

    def __init__(self, path: Path, are_compressed: bool = False) -> None:
        super().__init__(path)
        self._are_compressed = are_compressed
        self._messages = Messages()
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._described: dict[int, tuple[int, str, str]] = {}
        notes: list[str] = []
        with open_file(path) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                raise ValueError("is not an MCAP file")
            ranges = _ranges(file, size)
            for start, end in ranges or [(len(MCAP_MAGIC), size)]:
                at, is_closed = self._list(file, start, end)
                if ranges and at < end:
                    notes.append(f"is damaged at byte {at}; {amount(end - at, 'byte is', 'bytes are')} lost")
        if len(notes) > MOST_NAMED:
            notes = [*notes[:MOST_NAMED], f"is damaged at {amount(len(notes) - MOST_NAMED, 'more place')}"]
        if not ranges and not is_closed:
            notes.append(
                f"was not closed by its recorder, or is damaged: it is read up to byte {min(at, size)} of {size} "
                "(mcap recover may restore more)"
            )
        for number, chunk in self._messages.first_chunk.items():
            if number not in self._described and chunk >= 0:
                self._search(chunk, only_described=True)
        lost = self._messages.first_chunk.keys() - self._described.keys()
        if lost:
            notes.append(f"has messages of {amount(len(lost), 'topic')} that it does not describe; they are not used")
        self.channels = tuple(self._channel(number) for number in sorted(self._described))
        self.notes = tuple(f"{path.name} {note}" for note in notes)

    def read(self, channel: Channel, i: int, most: int | None = None) -> bytes:
        chunk, at = int(channel.chunk[i]), int(channel.offset[i])
        if not self._are_compressed:
            return self._as_stored(channel, chunk, at, most)
        return unpacked_message(self._as_stored(channel, chunk, at, most and HEAD_OF_MESSAGE), most)

    def _as_stored(self, channel: Channel, chunk: int, at: int, most: int | None) -> bytes:
        """Returns a message as it is stored, or its first `most` bytes."""
        before = RECORD.size + MESSAGE_HEAD.size
        head = self.content(chunk, at, before + (most or 0))
        if len(head) < before:
            raise ValueError("a message's header is truncated")
        kind, size = RECORD.unpack_from(head)
        number = MESSAGE_HEAD.unpack_from(head, RECORD.size)[0]
        if kind != MESSAGE or size < MESSAGE_HEAD.size or number != channel.number:
            raise ValueError("the index points to something that is not this message")
        wanted = size - MESSAGE_HEAD.size if most is None else min(size - MESSAGE_HEAD.size, most)
        data = self.content(chunk, at + before, wanted) if most is None else head[before : before + wanted]
        if len(data) < wanted:
            raise ValueError(f"a message ends after {len(data)} of {wanted} bytes")
        return data

    def _list(self, file: BinaryIO, at: int, end: int, chunk: int = -1, describe: bool = False) -> tuple[int, bool]:
        """Adds what the records of a part of the file say, or of a chunk's content, up to the first damaged one.

        Args:
            chunk: whose content it is; -1 = of the file itself.
            describe: only schemas and channels are added.

        Returns:
            Where it ended, and whether that was at the file's footer.
        """
        open_chunk, is_closed = -1, False
        loose: dict[int, list[tuple[int, int]]] = {}
        while at + RECORD.size <= end and not is_closed:
            file.seek(at)
            kind, length = RECORD.unpack(file.read(RECORD.size))
            after = at + RECORD.size + length
            # a cut chunk is searched as far as it goes
            if not 0 < kind < 0x80 or (after > end and (kind != CHUNK or chunk >= 0)):
                break
            if kind != INDEX and open_chunk >= 0:
                self._search(open_chunk)
                open_chunk = -1
            if kind == MESSAGE and not describe and length >= MESSAGE_HEAD.size:
                number, _, log_ns, _ = MESSAGE_HEAD.unpack(file.read(MESSAGE_HEAD.size))
                loose.setdefault(number, []).append((log_ns, at))
            elif kind == CHUNK and chunk < 0:
                open_chunk = self._add_chunk(file, at, end)
            elif kind == INDEX and chunk < 0 and self.chunks:
                self._add_index(file.read(min(length, TABLE_BYTES)))
                open_chunk = -1
            elif kind in (SCHEMA, CHANNEL):
                self._describe(kind, file.read(min(length, TABLE_BYTES)))
            is_closed = kind == FOOTER and length == 20
            at = after
        if open_chunk >= 0:
            self._search(open_chunk)
        for number, entries in loose.items():
            table = np.array(entries, ENTRY)
            self._messages.add(number, table["log_ns"], chunk, table["offset"])
        return at, is_closed

    def _search(self, chunk: int, only_described: bool = False) -> None:
        """Adds messages, schemas and channels of a chunk without an index, as far as it is sound."""
        content = self.sound(chunk)
        self._list(BytesIO(content), 0, len(content), chunk, only_described)

    def _add_chunk(self, file: BinaryIO, at: int, end: int) -> int:
        """Adds the chunk whose record is at `at`; returns its number, or -1 if its head is damaged."""
        head = file.read(CHUNK_HEAD.size + LONGEST_NAME + 8)
        if len(head) < CHUNK_HEAD.size:
            return -1
        _, _, full_size, checksum, name_length = CHUNK_HEAD.unpack_from(head)
        stored_at = CHUNK_HEAD.size + name_length
        if name_length > LONGEST_NAME or len(head) < stored_at + 8:
            return -1
        compression = head[CHUNK_HEAD.size : stored_at].decode("ascii", "replace")
        start = at + RECORD.size + stored_at + 8
        stored = min(int.from_bytes(head[stored_at : stored_at + 8], "little"), end - start)
        self.chunks.append(Chunk(start, stored, compression, full_size, checksum))
        return len(self.chunks) - 1

    def _add_index(self, data: bytes) -> None:
        body = data[6:]
        entries = np.frombuffer(body[: len(body) // ENTRY.itemsize * ENTRY.itemsize], ENTRY)
        if len(entries):
            number = int.from_bytes(data[:2], "little")
            self._messages.add(number, entries["log_ns"], len(self.chunks) - 1, entries["offset"])

    def _describe(self, kind: int, data: bytes) -> None:
        """Adds a schema or a channel; damaged ones are left out."""
        number = int.from_bytes(data[:2], "little")
        try:
            if kind == SCHEMA:
                name, at = _text(data, 2)
                encoding, at = _text(data, at)
                length = int.from_bytes(data[at : at + 4], "little")
                self._schemas.setdefault(number, (name, encoding, data[at + 4 : at + 4 + length]))
            else:
                topic, at = _text(data, 4)
                encoding, at = _text(data, at)
                self._described.setdefault(number, (int.from_bytes(data[2:4], "little"), topic, encoding))
        except ValueError:
            return

    def _channel(self, number: int) -> Channel:
        schema, topic, encoding = self._described[number]
        kind, schema_encoding, definition = self._schemas.get(schema, ("unknown", "", b""))
        return Channel(topic, kind, encoding, schema_encoding, definition, "", number, *self._messages.arrays(number))


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Returns the text at `at`, and where it ends; raises ValueError if it is cut or not UTF-8."""
    length = int.from_bytes(data[at : at + 4], "little")
    end = at + 4 + length
    if at + 4 > len(data) or end > len(data):
        raise ValueError("a text is cut")
    return data[at + 4 : end].decode(), end


def _ranges(file: BinaryIO, size: int) -> list[tuple[int, int]]:
    """Returns the parts of a file by its summary: each chunk with its indices, what is between, the summary itself.

    Empty without a sound summary, or if it lists no chunks.
    """
    file.seek(max(size - FOOTER_BYTES, 0))
    footer = file.read()
    if len(footer) < FOOTER_BYTES or footer[-len(MCAP_MAGIC) :] != MCAP_MAGIC or footer[0] != FOOTER:
        return []
    summary, end = int.from_bytes(footer[RECORD.size : RECORD.size + 8], "little"), size - FOOTER_BYTES
    ranges, at = [], summary
    while len(MCAP_MAGIC) < at < end:
        file.seek(at)
        kind, length = RECORD.unpack(file.read(RECORD.size))
        if kind == CHUNK_INDEX and length >= 40:
            head = file.read(min(length, TABLE_BYTES))
            start, chunk_bytes = struct.unpack_from("<QQ", head, 16)
            offsets = int.from_bytes(head[32:36], "little")
            index_bytes = int.from_bytes(head[36 + offsets : 44 + offsets], "little")
            if not len(MCAP_MAGIC) < start < start + chunk_bytes + index_bytes <= summary:
                return []
            ranges.append((start, start + chunk_bytes + index_bytes))
        at += RECORD.size + length
    if not ranges or at != end:
        return []
    parts, at = [], len(MCAP_MAGIC)
    for start, after in [*sorted(ranges), (summary, end)]:
        parts += [(at, start)] * (start > at) + [(start, after)]
        at = after
    return parts
