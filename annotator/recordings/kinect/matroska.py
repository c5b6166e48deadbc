"""Lists the blocks of a Matroska file from its headers.

A demuxer reads every byte of a file to list its blocks: gigabytes, for minutes of uncompressed depth. Here only the
headers are read, and the content between them is skipped. After a damaged part, reading continues at the next cluster.

Formats: RFC 8794 (EBML: ids and sizes), RFC 9559 (Matroska: elements, block headers).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from annotator.files import open_file

EBML, SEGMENT, INFO, TRACKS, CLUSTER = 0x1A45DFA3, 0x18538067, 0x1549A966, 0x1654AE6B, 0x1F43B675
TRACK_ENTRY, VIDEO = 0xAE, 0xE0
BLOCK_GROUP, BLOCK, SIMPLE_BLOCK, TIMESTAMP, TIMESTAMP_SCALE = 0xA0, 0xA1, 0xA3, 0xE7, 0x2AD7B1
# Elements whose children are read; their own size may be unknown.
ENTERED = frozenset({SEGMENT, CLUSTER, BLOCK_GROUP})
# Seek head, cues, attachments, chapters, tags, void, checksum, and other elements of clusters and block groups.
SKIPPED = frozenset(
    {EBML, 0x114D9B74, 0x1C53BB6B, 0x1941A469, 0x1043A770, 0x1254C367, 0xEC, 0xBF}
    | {0xA7, 0xAB, 0x5854, 0x9B, 0xFB, 0xFA, 0xFD, 0x75A1, 0x75A2, 0xA4, 0xAF, 0x8E}
)
KNOWN = ENTERED | SKIPPED | {INFO, TRACKS, TIMESTAMP, BLOCK, SIMPLE_BLOCK}
CLUSTER_ID = CLUSTER.to_bytes(4)
# Larger than any offset, since sizes have 56 bits.
NO_LIMIT = 1 << 60
LACING_BITS = 0x06
LONGEST_HEAD = 12
MOST_HEADER_BYTES = 1 << 20
# A century; sums and differences of two such times fit into 64 bits.
MOST_NS = 1 << 62
# Bytes that are searched at once after a damaged part.
CHUNK_BYTES = 1 << 16


@dataclass(frozen=True)
class Track:
    """One track's description; 0 and "" for missing values."""

    number: int
    name: str
    codec: str
    private: bytes
    width_px: int
    height_px: int
    period_ns: int


@dataclass(frozen=True, slots=True)
class Block:
    """One block: `size` bytes at `offset`, which may reach beyond the end of a truncated file."""

    track: int
    time_ns: int
    offset: int
    size: int
    is_laced: bool


@dataclass(frozen=True)
class MatroskaIndex:
    """A file's tracks and blocks, in file order.

    Attributes:
        is_truncated: the file ends in the middle of an element.
    """

    tracks: tuple[Track, ...]
    blocks: tuple[Block, ...]
    is_truncated: bool


def read_index(path: Path) -> MatroskaIndex | None:
    """Returns the tracks and blocks of a Matroska file; None for a file of another type."""
    with open_file(path, buffering=0) as file:
        if file.read(4) != EBML.to_bytes(4):
            return None
        return _IndexReader(path, file).index()


@dataclass
class _IndexReader:
    """Reads one file; holds the tracks and blocks read so far."""

    path: Path
    file: BinaryIO
    scale_ns: int = 1_000_000
    cluster_time: int = 0
    tracks: list[Track] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)

    def index(self) -> MatroskaIndex:
        end = self.path.stat().st_size
        at = 0
        # end of the current cluster, if known: an element that reaches beyond it has a damaged size
        limit = NO_LIMIT
        while at < end:
            head = self._read(at, LONGEST_HEAD)
            element = element_head(head)
            if element is None or element[0] not in KNOWN:
                # a truncated file may end within a head
                if end - at < LONGEST_HEAD:
                    return MatroskaIndex(tuple(self.tracks), tuple(self.blocks), True)
                at = self._next_cluster(at + 1, end)
                continue
            kind, size, length = element
            at += length
            if kind == CLUSTER:
                limit = NO_LIMIT if size is None else at + size
            if kind in ENTERED:
                continue
            if size is None or (at < limit < at + size):
                at = self._next_cluster(at, end)
                continue
            self._read_element(kind, at, size)
            at += size
        return MatroskaIndex(tuple(self.tracks), tuple(self.blocks), at > end)

    def _read_element(self, kind: int, at: int, size: int) -> None:
        if kind == INFO:
            for child, content in children(self._read(at, min(size, MOST_HEADER_BYTES))):
                if child == TIMESTAMP_SCALE:
                    self.scale_ns = int.from_bytes(content)
        elif kind == TRACKS:
            entries = children(self._read(at, min(size, MOST_HEADER_BYTES)))
            self.tracks += [_track(content) for child, content in entries if child == TRACK_ENTRY]
        elif kind == TIMESTAMP:
            self.cluster_time = int.from_bytes(self._read(at, min(size, 8)))
        elif kind in (BLOCK, SIMPLE_BLOCK):
            self._add_block(at, size)

    def _add_block(self, at: int, size: int) -> None:
        head = self._read(at, min(size, LONGEST_HEAD))
        number = _vint(head, 0)
        if number is None or len(head) < number[1] + 3:
            return
        track, length = number
        time_ns = (self.cluster_time + int.from_bytes(head[length : length + 2], signed=True)) * self.scale_ns
        if abs(time_ns) > MOST_NS:
            return
        is_laced = bool(head[length + 2] & LACING_BITS)
        before = length + 3
        self.blocks.append(Block(track, time_ns, at + before, size - before, is_laced))

    def _next_cluster(self, at: int, end: int) -> int:
        """Returns the offset of the next cluster, at `at` or later; `end` if there is none."""
        while at < end:
            chunk = self._read(at, CHUNK_BYTES)
            offset = chunk.find(CLUSTER_ID)
            if offset >= 0:
                return at + offset
            # a cluster's id may span two chunks
            at += max(len(chunk) - len(CLUSTER_ID) + 1, 1)
        return end

    def _read(self, at: int, size: int) -> bytes:
        self.file.seek(at)
        return self.file.read(size)


def element_head(data: bytes) -> tuple[int, int | None, int] | None:
    """Returns an element's id, its content's size (None: unknown) and the length of this head; None if damaged."""
    if not data:
        return None
    id_length = 9 - data[0].bit_length()
    size = _vint(data, id_length)
    if id_length > 4 or size is None:
        return None
    value, length = size
    is_unknown = value == (1 << 7 * length) - 1
    return int.from_bytes(data[:id_length]), None if is_unknown else value, id_length + length


def children(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields id and content of an element's children, up to the first damaged one."""
    at = 0
    while element := element_head(data[at : at + LONGEST_HEAD]):
        kind, size, length = element
        at += length
        if size is None or at + size > len(data):
            return
        yield kind, data[at : at + size]
        at += size


def _vint(data: bytes, at: int) -> tuple[int, int] | None:
    """Returns a number of variable length and its length in bytes; None if damaged."""
    if at >= len(data) or data[at] == 0:
        return None
    length = 9 - data[at].bit_length()
    if at + length > len(data):
        return None
    return int.from_bytes(data[at : at + length]) & ((1 << 7 * length) - 1), length


def _track(entry: bytes) -> Track:
    of = dict(children(entry))
    video = dict(children(of.get(VIDEO, b"")))
    return Track(
        number=int.from_bytes(of.get(0xD7, b"")),
        name=of.get(0x536E, b"").rstrip(b"\0").decode("utf-8", "replace"),
        codec=of.get(0x86, b"").rstrip(b"\0").decode("ascii", "replace"),
        private=of.get(0x63A2, b"") or video.get(0x2EB524, b""),
        width_px=int.from_bytes(video.get(0xB0, b"")),
        height_px=int.from_bytes(video.get(0xBA, b"")),
        period_ns=int.from_bytes(of.get(0x23E383, b"")),
    )
