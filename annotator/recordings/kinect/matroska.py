"""Lists the blocks of a Matroska file from its headers, with its tracks, tags and attachments.

A demuxer reads every byte of a file to list its blocks: gigabytes, for minutes of uncompressed depth. Here only the
headers are read, and the content between them is skipped. After a damaged part, reading continues at the next cluster.

Formats: RFC 8794 (EBML: ids and sizes), RFC 9559 (Matroska: elements, block headers).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from annotator.files import open_file

EBML, SEGMENT, INFO, TRACKS, CLUSTER = 0x1A45DFA3, 0x18538067, 0x1549A966, 0x1654AE6B, 0x1F43B675
TAGS, TAG_NAME, TAG_STRING, ATTACHMENTS, FILE_NAME, FILE_DATA = 0x1254C367, 0x45A3, 0x4487, 0x1941A469, 0x466E, 0x465C
TRACK_ENTRY = 0xAE
# A tag, a simple tag, an attached file, and what is video of a track.
GROUPS = frozenset({0x7373, 0x67C8, 0x61A7, 0xE0})
BLOCK_GROUP, BLOCK, SIMPLE_BLOCK, TIMESTAMP, TIMESTAMP_SCALE = 0xA0, 0xA1, 0xA3, 0xE7, 0x2AD7B1
# Elements whose children are read; their own size may be unknown.
ENTERED = frozenset({SEGMENT, CLUSTER, BLOCK_GROUP})
READ = frozenset({INFO, TRACKS, TAGS, ATTACHMENTS, TIMESTAMP, BLOCK, SIMPLE_BLOCK})
# Seek head, cues, chapters, void, checksum, and other elements of clusters and block groups.
SKIPPED = frozenset(
    {EBML, 0x114D9B74, 0x1C53BB6B, 0x1043A770, 0xEC, 0xBF}
    | {0xA7, 0xAB, 0x5854, 0x9B, 0xFB, 0xFA, 0xFD, 0x75A1, 0x75A2, 0xA4, 0xAF, 0x8E}
)
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

    name: str
    codec: str
    private: bytes
    number: int
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


@dataclass
class MatroskaIndex:
    """What a file has: blocks in file order, the others by name."""

    tracks: dict[str, Track] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)


def read_index(path: Path, until: int | None = None) -> MatroskaIndex | None:
    """Returns what a Matroska file has, up to the first element `until`; None for a file of another type."""
    with open_file(path, buffering=0) as file:
        return _Reader(file, path.stat().st_size).index(until) if file.read(4) == EBML.to_bytes(4) else None


class _Reader:
    def __init__(self, file: BinaryIO, end: int) -> None:
        self._file, self._end = file, end
        self._scale_ns, self._cluster_time = 1_000_000, 0
        self._found = MatroskaIndex()

    def index(self, until: int | None) -> MatroskaIndex:
        # limit: the end of the current cluster, if known; an element that reaches beyond it has a damaged size
        at, limit = 0, NO_LIMIT
        while at < self._end:
            kind, size, length = element_head(self._read(at, LONGEST_HEAD))
            if kind not in ENTERED | READ | SKIPPED:
                at = self._next_cluster(at + 1)
                continue
            at += length
            if kind == CLUSTER:
                limit = NO_LIMIT if size is None else at + size
            if kind in ENTERED:
                continue
            if size is None or (at < limit < at + size):
                at = self._next_cluster(at)
                continue
            if kind in READ:
                self._read_element(kind, at, size)
            at += size
            if kind == until:
                break
        return self._found

    def _read_element(self, kind: int, at: int, size: int) -> None:
        found = self._found
        if kind in (BLOCK, SIMPLE_BLOCK):
            self._add_block(at, size)
        elif kind == TIMESTAMP:
            self._cluster_time = int.from_bytes(self._read(at, min(size, 8)))
        elif kind in (INFO, TRACKS, TAGS, ATTACHMENTS):
            name = ""
            for child, content in children(self._read(at, min(size, MOST_HEADER_BYTES))):
                if child == TIMESTAMP_SCALE:
                    self._scale_ns = int.from_bytes(content)
                elif child == TRACK_ENTRY:
                    track = _track(content)
                    found.tracks[track.name] = track
                elif child in (TAG_NAME, FILE_NAME):
                    name = _text(content)
                elif child == TAG_STRING:
                    found.tags[name] = _text(content)
                elif child == FILE_DATA:
                    found.attachments[name] = content

    def _add_block(self, at: int, size: int) -> None:
        head = self._read(at, min(size, LONGEST_HEAD))
        track, length = _vint(head, 0)
        if not length or len(head) < length + 3:
            return
        time_ns = (self._cluster_time + int.from_bytes(head[length : length + 2], signed=True)) * self._scale_ns
        before = length + 3
        if abs(time_ns) <= MOST_NS:
            is_laced = bool(head[length + 2] & LACING_BITS)
            self._found.blocks.append(Block(track, time_ns, at + before, size - before, is_laced))

    def _next_cluster(self, at: int) -> int:
        """Returns the offset of the next cluster, at `at` or later; the file's end if there is none."""
        cluster = CLUSTER.to_bytes(4)
        while at < self._end:
            chunk = self._read(at, CHUNK_BYTES)
            offset = chunk.find(cluster)
            if offset >= 0:
                return at + offset
            # a cluster's id may span two chunks
            at += max(len(chunk) - len(cluster) + 1, 1)
        return self._end

    def _read(self, at: int, size: int) -> bytes:
        self._file.seek(at)
        return self._file.read(size)


def element_head(data: bytes) -> tuple[int, int | None, int]:
    """Returns an element's id (0 = damaged), its content's size (None: unknown) and the length of this head."""
    id_length = 9 - data[0].bit_length() if data else 9
    value, length = _vint(data, id_length)
    if id_length > 4 or not length:
        return 0, None, 0
    is_unknown = value == (1 << 7 * length) - 1
    return int.from_bytes(data[:id_length]), None if is_unknown else value, id_length + length


def children(data: bytes, depth: int = 3) -> Iterator[tuple[int, bytes]]:
    """Yields id and content of an element's children, and of those of `GROUPS`, up to the first damaged one."""
    at = 0
    while True:
        kind, size, length = element_head(data[at : at + LONGEST_HEAD])
        at += length
        if not kind or size is None or at + size > len(data):
            return
        content = data[at : at + size]
        yield from children(content, depth - 1) if kind in GROUPS and depth else [(kind, content)]
        at += size


def _vint(data: bytes, at: int) -> tuple[int, int]:
    """Returns a number of variable length and its length in bytes, 0 if it is damaged."""
    length = 9 - data[at].bit_length() if at < len(data) else 9
    if length > 8 or at + length > len(data):
        return 0, 0
    return int.from_bytes(data[at : at + length]) & ((1 << 7 * length) - 1), length


def _text(content: bytes) -> str:
    return content.rstrip(b"\0").decode("utf-8", "replace")


def _track(entry: bytes) -> Track:
    of = defaultdict(bytes, children(entry))
    numbers = (int.from_bytes(of[kind]) for kind in (0xD7, 0xB0, 0xBA, 0x23E383))
    # the format of a codec, or of raw pixels
    return Track(_text(of[0x536E]), _text(of[0x86]), of[0x63A2] or of[0x2EB524], *numbers)
