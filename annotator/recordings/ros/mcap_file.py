"""The records of an MCAP file, listed without reading its messages.

Format: the MCAP specification (mcap.dev/spec), version 0. A record is a byte, its kind, a length of eight bytes and its
content. Messages are in chunks, each followed by an index per channel, or outside of chunks. The summary at the end
repeats schemas and channels. A file that was not closed lacks it: then the chunks are searched for them.
"""

from __future__ import annotations

import os
import struct
from bisect import bisect_right
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import BinaryIO

import numpy as np

from annotator.files import TABLE_BYTES, open_file
from annotator.recordings.ros.bag import Channel, ChannelBuilder, shortened
from annotator.recordings.ros.chunks import HEAD_OF_MESSAGE, Chunk, Chunks, unpack_message
from annotator.types.messages import amount

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX, DATA_END = 1, 2, 3, 4, 5, 6, 7, 8, 15
LAST_KIND = 15
RECORD = struct.Struct("<BQ")
# channel, sequence, log time, publish time
MESSAGE_HEAD = struct.Struct("<HIQQ")
# start, end, full size, checksum, length of the compression's name
CHUNK_HEAD = struct.Struct("<QQQII")
FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)
ENTRY = np.dtype([("log_ns", "<u8"), ("offset", "<u8")])
LONGEST_NAME = 64
Described = tuple[int, str, str, str]


class McapFile:
    """The content of an MCAP file; a `BagFile`."""

    is_slow = False

    def __init__(self, path: Path, are_compressed: bool = False) -> None:
        """Lists the messages.

        Args:
            are_compressed: each message is compressed with zstd (a mode of ROS 2).

        Raises:
            ValueError: not an MCAP file.
            OSError: the file cannot be read.
        """
        self.path = path
        self.channels: tuple[Channel, ...] = ()
        self.notes: tuple[str, ...] = ()
        self._are_compressed = are_compressed
        self._chunks = Chunks(path)
        self._messages = ChannelBuilder()
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._described: dict[int, Described] = {}
        self._list_records()

    def read(self, channel: Channel, i: int, most: int | None = None) -> bytes:
        """Reads message `i` of a channel, or its first `most` bytes."""
        chunk, at = int(channel.chunk[i]), int(channel.offset[i])
        if most is not None and self._are_compressed:
            return unpack_message(self._stored(channel, chunk, at, HEAD_OF_MESSAGE), most)
        data = self._stored(channel, chunk, at, most)
        return unpack_message(data) if self._are_compressed else data

    def _stored(self, channel: Channel, chunk: int, at: int, most: int | None) -> bytes:
        """Returns a message as it is stored, or its first `most` bytes."""
        before = RECORD.size + MESSAGE_HEAD.size
        head = self._chunks.read(chunk, at, before + (most or 0))
        if len(head) < before:
            raise ValueError("a message's header is truncated")
        kind, size = RECORD.unpack_from(head)
        number = MESSAGE_HEAD.unpack_from(head, RECORD.size)[0]
        if kind != MESSAGE or size < MESSAGE_HEAD.size or number != channel.number:
            raise ValueError("the index points to something that is not this message")
        wanted = size - MESSAGE_HEAD.size
        if most is None:
            data = self._chunks.read(chunk, at + before, wanted)
        else:
            wanted = min(wanted, most)
            data = head[before : before + wanted]
        if len(data) < wanted:
            raise ValueError(f"a message ends after {len(data)} of {wanted} bytes")
        return data

    def many(self) -> AbstractContextManager[None]:
        """Does nothing: opening the file takes little time."""
        return nullcontext()

    def _list_records(self) -> None:
        notes: list[str] = []
        is_closed, open_chunk = False, -1
        with open_file(self.path) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            if file.read(len(MAGIC)) != MAGIC:
                raise ValueError("is not an MCAP file")
            at = len(MAGIC)
            loose = _Loose()
            places: list[int] | None = None
            while at + RECORD.size <= size and not is_closed:
                file.seek(at)
                kind, length = RECORD.unpack(file.read(RECORD.size))
                end = at + RECORD.size + length
                is_cut = end > size and kind not in (CHUNK, DATA_END)
                if not 0 < kind < 0x80 or is_cut or (kind == FOOTER and length != 20) or end > size + length:
                    places = _chunk_places(file, size) if places is None else places
                    later = bisect_right(places, at)
                    is_last = later == len(places)
                    sound_at = size if is_last else places[later]
                    if not is_last or end <= size:
                        notes.append(f"is damaged at byte {at}; {amount(sound_at - at, 'byte is', 'bytes are')} lost")
                    if is_last:
                        break
                    at = sound_at
                    continue
                if kind not in (INDEX, HEADER) and open_chunk >= 0:
                    self._search(open_chunk)
                    open_chunk = -1
                if kind == MESSAGE:
                    head = file.read(MESSAGE_HEAD.size)
                    if len(head) == MESSAGE_HEAD.size:
                        loose.add(head, at)
                elif kind == CHUNK:
                    open_chunk = self._add_chunk(file, at, size)
                elif kind == INDEX and self._chunks.all:
                    self._add_index(file.read(min(length, TABLE_BYTES)), len(self._chunks.all) - 1)
                    open_chunk = -1
                elif kind in (SCHEMA, CHANNEL):
                    self._describe(kind, file.read(min(length, TABLE_BYTES)))
                is_closed = kind == FOOTER
                at = end
        if open_chunk >= 0:
            self._search(open_chunk)
        for number, entries in loose.entries.items():
            self._messages.add(number, *_split(entries, -1))
        notes = shortened(notes)
        if not is_closed:
            notes.append("was not closed by its recorder, or its end is missing; it is read as far as it is sound")
        for number in self._messages.first_chunk.keys() - self._described.keys():
            if self._messages.first_chunk[number] >= 0:
                self._search(self._messages.first_chunk[number], only_described=True)
        lost = self._messages.first_chunk.keys() - self._described.keys()
        if lost:
            notes.append(f"has messages of {amount(len(lost), 'topic')} that it does not describe; they are not used")
        self.channels = tuple(self._channel(number) for number in sorted(self._described))
        self.notes = tuple(f"{self.path.name} {note}" for note in notes)

    def _add_chunk(self, file: BinaryIO, at: int, file_size: int) -> int:
        """Adds the chunk whose record is at `at`; returns its number, or -1 if its head is damaged."""
        file.seek(at + RECORD.size)
        head = file.read(CHUNK_HEAD.size + LONGEST_NAME + 8)
        if len(head) < CHUNK_HEAD.size:
            return -1
        _, _, full_size, checksum, name_length = CHUNK_HEAD.unpack_from(head)
        stored_at = CHUNK_HEAD.size + name_length
        if name_length > LONGEST_NAME or len(head) < stored_at + 8:
            return -1
        compression = head[CHUNK_HEAD.size : stored_at].decode("ascii", "replace")
        stored = int.from_bytes(head[stored_at : stored_at + 8], "little")
        start = at + RECORD.size + stored_at + 8
        return self._chunks.add(Chunk(start, min(stored, file_size - start), compression, full_size, checksum))

    def _add_index(self, data: bytes, chunk: int) -> None:
        if len(data) >= 6:
            body = data[6:]
            entries = np.frombuffer(body[: len(body) // ENTRY.itemsize * ENTRY.itemsize], ENTRY)
            if len(entries):
                self._messages.add(int.from_bytes(data[:2], "little"), *_split(entries, chunk))

    def _search(self, chunk: int, only_described: bool = False) -> None:
        """Adds messages, schemas and channels of a chunk without an index, as far as it is sound."""
        try:
            content = self._chunks.sound(chunk)
        except ValueError:  # an unknown compression: its messages are not known
            return
        loose, at = _Loose(), 0
        while at + RECORD.size <= len(content):
            kind, length = RECORD.unpack_from(content, at)
            start, end = at + RECORD.size, at + RECORD.size + length
            if end > len(content):
                break
            if kind == MESSAGE and not only_described and length >= MESSAGE_HEAD.size:
                loose.add(content[start : start + MESSAGE_HEAD.size], at)
            elif kind in (SCHEMA, CHANNEL):
                self._describe(kind, content[start:end])
            at = end
        for number, entries in loose.entries.items():
            self._messages.add(number, *_split(entries, chunk))

    def _describe(self, kind: int, data: bytes) -> None:
        """Adds a schema or a channel; damaged ones are left out."""
        try:
            number = int.from_bytes(data[:2], "little")
            if kind == SCHEMA:
                name, at = _text(data, 2)
                encoding, at = _text(data, at)
                length = int.from_bytes(data[at : at + 4], "little")
                self._schemas.setdefault(number, (name, encoding, data[at + 4 : at + 4 + length]))
            else:
                topic, at = _text(data, 4)
                encoding, at = _text(data, at)
                self._described.setdefault(number, (int.from_bytes(data[2:4], "little"), topic, encoding, ""))
        except ValueError:
            return

    def _channel(self, number: int) -> Channel:
        schema, topic, encoding, publisher = self._described[number]
        kind, schema_encoding, definition = self._schemas.get(schema, ("unknown", "", b""))
        return Channel(
            topic, kind, encoding, schema_encoding, definition, publisher, number, *self._messages.arrays(number)
        )  # fmt: skip


class _Loose:
    """Messages that are found one by one."""

    def __init__(self) -> None:
        self.entries: dict[int, list[tuple[int, int]]] = {}

    def add(self, head: bytes, at: int) -> None:
        number, _, log_ns, _ = MESSAGE_HEAD.unpack(head)
        self.entries.setdefault(number, []).append((log_ns, at))


def _split(entries: np.ndarray | list[tuple[int, int]], chunk: int) -> tuple[np.ndarray, int, np.ndarray]:
    table = np.asarray(entries, ENTRY)
    # times beyond 2262 are damaged
    return np.minimum(table["log_ns"], 2**63 - 1), chunk, np.minimum(table["offset"], 2**62)


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Returns the text at `at`, and where it ends; raises ValueError if it is cut or not UTF-8."""
    length = int.from_bytes(data[at : at + 4], "little")
    end = at + 4 + length
    if at + 4 > len(data) or end > len(data):
        raise ValueError("a text is cut")
    return data[at + 4 : end].decode(), end


def _chunk_places(file: BinaryIO, size: int) -> list[int]:
    """Returns the places of all chunks from the summary, as far as it is sound."""
    file.seek(max(size - FOOTER_BYTES, 0))
    footer = file.read()
    if len(footer) < FOOTER_BYTES or footer[-len(MAGIC) :] != MAGIC or footer[0] != FOOTER:
        return []
    places, at = [], int.from_bytes(footer[RECORD.size : RECORD.size + 8], "little")
    while 0 < at < size - RECORD.size:
        file.seek(at)
        kind, length = RECORD.unpack(file.read(RECORD.size))
        if kind == CHUNK_INDEX:
            places.append(int.from_bytes(file.read(24)[16:], "little"))
        at += RECORD.size + length
    return sorted(places)
