"""The records of a ROS 1 bag, listed without reading its messages.

Format: "Bags/Format/2.0" of the ROS wiki. A file is a list of records, each a header of named fields and data: chunks
of messages, each followed by the index of its messages, and at the end all connections. A bag that was not closed lacks
the end; the chunks before are complete. A chunk without an index is searched for its messages.
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
from annotator.recordings.ros.chunks import Chunk, Chunks
from annotator.types.messages import amount

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
LONGEST_HEADER = 1 << 20
# A message's header is 43 bytes in every known writer.
MESSAGE_HEADER = 128
ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])
Fields = dict[bytes, bytes]


class Ros1File:
    """The content of a ROS 1 bag; a `BagFile`."""

    def __init__(self, path: Path) -> None:
        """Lists the messages.

        Raises:
            ValueError: not a bag of version 2.0.
            OSError: the file cannot be read.
        """
        self.path = path
        self.channels: tuple[Channel, ...] = ()
        self.notes: tuple[str, ...] = ()
        self._chunks = Chunks(path)
        self._messages = ChannelBuilder()
        self._connections: dict[int, tuple[Fields, Fields]] = {}
        self._list_records()

    def read(self, channel: Channel, i: int, most: int | None = None) -> bytes:
        """Reads message `i` of a channel, or its first `most` bytes."""
        chunk, at = int(channel.chunk[i]), int(channel.offset[i])
        while True:
            head = self._chunks.read(chunk, at, MESSAGE_HEADER + (most or 0))
            length = _uint32(head)
            if length is not None and length + 8 > len(head):
                head = self._chunks.read(chunk, at, min(length, LONGEST_HEADER) + 8 + (most or 0))
            fields = None if length is None else _fields(head[4 : 4 + length])
            size = None if length is None else _uint32(head[4 + length :])
            if fields is None or size is None or length is None:
                raise ValueError("a message's header is damaged or truncated")
            start = at + 8 + length
            if _op(fields) != CONNECTION:
                break
            at = start + size
        if _op(fields) != MESSAGE or _uint32(fields.get(b"conn", b"")) != channel.number:
            raise ValueError("the index points to something that is not this message")
        wanted = size if most is None else min(size, most)
        data = self._chunks.read(chunk, start, wanted)
        if len(data) < wanted:
            raise ValueError(f"a message ends after {len(data)} of {size} bytes")
        return data

    @property
    def is_slow(self) -> bool:
        """True if its chunks are compressed with bz2, which takes half a second for 8 MB."""
        return any(chunk.compression == "bz2" for chunk in self._chunks.all)

    def many(self) -> AbstractContextManager[None]:
        """Does nothing: opening the file takes little time."""
        return nullcontext()

    def _list_records(self) -> None:
        notes: list[str] = []
        with open_file(self.path) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            if file.read(len(MAGIC)) != MAGIC:
                raise ValueError("is not a ROS bag of version 2.0")
            at, index_at, open_chunk = len(MAGIC), 0, -1
            places: list[int] | None = None
            while at < size:
                record = _record(file, at)
                op = -1 if record is None else _op(record[0])
                if record is None or op not in (MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION):
                    places = _chunk_places(file, index_at, size) if places is None else places
                    later = bisect_right(places, at)
                    is_last = later == len(places)
                    notes.append(
                        f"is damaged at byte {at}; "
                        + (
                            f"{amount(size - at, 'byte is', 'bytes are')} not used"
                            if is_last
                            else f"{amount(places[later] - at, 'byte is', 'bytes are')} lost"
                        )
                    )
                    if is_last:
                        break
                    at = places[later]
                    continue
                fields, data_at, data_size = record
                if op in (CHUNK, CHUNK_INFO, CONNECTION) and open_chunk >= 0:
                    self._search(open_chunk)
                    open_chunk = -1
                if op == BAG:
                    index_at = int.from_bytes(fields.get(b"index_pos", b""), "little")
                elif op == CHUNK:
                    compression = fields.get(b"compression", b"").decode("ascii", "replace")
                    full = _uint32(fields.get(b"size", b"")) or 0
                    stored = min(data_size, size - data_at)
                    open_chunk = self._chunks.add(Chunk(data_at, stored, compression, full))
                elif op == INDEX and self._chunks.all:
                    self._add_index(file, fields, data_at, data_size)
                    open_chunk = -1
                elif op == CONNECTION:
                    self._add_connection(fields, _read(file, data_at, data_size))
                at = data_at + data_size
        if open_chunk >= 0:
            self._search(open_chunk)
        notes = shortened(notes)
        if not index_at:
            notes.append("was not closed by its recorder; it is read as far as it is sound")
        elif at > size:
            notes.append(f"is truncated: {amount(at - size, 'byte is', 'bytes are')} missing")
        for number in self._messages.first_chunk.keys() - self._connections.keys():
            self._search(self._messages.first_chunk[number], only_connections=True)
        lost = self._messages.first_chunk.keys() - self._connections.keys()
        if lost:
            notes.append(f"has messages of {amount(len(lost), 'topic')} that it does not describe; they are not used")
        self.channels = tuple(self._channel(number) for number in sorted(self._connections))
        self.notes = tuple(f"{self.path.name} {note}" for note in notes)

    def _add_index(self, file: BinaryIO, fields: Fields, at: int, size: int) -> None:
        number = _uint32(fields.get(b"conn", b""))
        data = _read(file, at, size)
        if number is not None:
            self._add(number, np.frombuffer(data[: len(data) // ENTRY.itemsize * ENTRY.itemsize], ENTRY))

    def _add(self, number: int, entries: np.ndarray, chunk: int = -1) -> None:
        log_ns = entries["sec"].astype(np.int64) * 10**9 + entries["nsec"]
        self._messages.add(number, log_ns, chunk if chunk >= 0 else len(self._chunks.all) - 1, entries["offset"])

    def _search(self, chunk: int, only_connections: bool = False) -> None:
        """Adds the messages and connections of a chunk without an index, as far as it is sound."""
        try:
            content = self._chunks.sound(chunk)
        except ValueError:  # an unknown compression: its messages are not known
            return
        found: dict[int, list[tuple[int, int, int]]] = {}
        at = 0
        while at + 4 <= len(content):
            length = _uint32(content[at : at + 4]) or 0
            fields = _fields(content[at + 4 : at + 4 + length])
            size = _uint32(content[at + 4 + length : at + 8 + length])
            end = at + 8 + length + (size or 0)
            if fields is None or size is None or end > len(content):
                break
            if _op(fields) == CONNECTION:
                self._add_connection(fields, content[at + 8 + length : end])
            elif _op(fields) == MESSAGE and not only_connections and len(fields.get(b"time", b"")) == 8:
                number = _uint32(fields.get(b"conn", b""))
                if number is not None:
                    found.setdefault(number, []).append((*struct.unpack("<II", fields[b"time"]), at))
            at = end
        for number, entries in found.items():
            self._add(number, np.array(entries, ENTRY), chunk)

    def _add_connection(self, fields: Fields, data: bytes) -> None:
        number, described = _uint32(fields.get(b"conn", b"")), _fields(data)
        if number is not None and described is not None and b"type" in described:
            self._connections.setdefault(number, (fields, described))

    def _channel(self, number: int) -> Channel:
        fields, described = self._connections[number]

        def text(name: bytes) -> str:
            return described.get(name, b"").decode("utf-8", "replace")

        topic = fields.get(b"topic", b"").decode("utf-8", "replace")
        # names of one topic may differ in slashes
        topic = "/" * topic.startswith("/") + "/".join(part for part in topic.split("/") if part)
        return Channel(
            topic, text(b"type"), "ros1", "ros1msg", described.get(b"message_definition", b""), text(b"callerid"),
            number, *self._messages.arrays(number),
        )  # fmt: skip


def _record(file: BinaryIO, at: int) -> tuple[Fields, int, int] | None:
    """Returns a record's fields, and place and size of its data; None if it is damaged or truncated."""
    length = _uint32(_read(file, at, 4))
    if length is None or length > LONGEST_HEADER:
        return None
    head = file.read(length + 4)
    fields, size = _fields(head[:length]), _uint32(head[length:])
    return None if fields is None or size is None else (fields, at + 8 + length, size)


def _chunk_places(file: BinaryIO, index_at: int, size: int) -> list[int]:
    """Returns the places of all chunks from the index at the end, as far as it is sound."""
    places, at = [], index_at
    while 0 < at < size and (record := _record(file, at)) is not None:
        fields, data_at, data_size = record
        if _op(fields) == CHUNK_INFO:
            places.append(int.from_bytes(fields.get(b"chunk_pos", b""), "little"))
        at = data_at + data_size
    return sorted(places)


def _fields(data: bytes) -> Fields | None:
    """Returns the named fields of a header; None if it is damaged."""
    fields: Fields = {}
    at = 0
    while at < len(data):
        size = _uint32(data[at : at + 4])
        if size is None or at + 4 + size > len(data):
            return None
        name, sign, value = data[at + 4 : at + 4 + size].partition(b"=")
        if not sign:
            return None
        fields[name] = value
        at += 4 + size
    return fields


def _op(fields: Fields) -> int:
    return int.from_bytes(fields.get(b"op", b"\xff")[:1])


def _uint32(data: bytes) -> int | None:
    return int.from_bytes(data[:4], "little") if len(data) >= 4 else None


def _read(file: BinaryIO, at: int, size: int) -> bytes:
    """Reads as far as the file goes; a damaged size must not allocate more memory."""
    end = file.seek(0, os.SEEK_END)
    file.seek(at)
    return file.read(max(min(size, end - at, TABLE_BYTES), 0))
