"""A bag: messages by topic, in the order of their log times, each read on request.

The readers of the file formats (`ros1_file`, `mcap_file`, `sqlite_file`) list the messages without reading them. They
are our own because libraries refuse bags without an index or with one damaged chunk, and read whole files to list them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64

from annotator.types.messages import amount


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


@runtime_checkable
class BagFile(Protocol):
    """One file of a bag.

    Attributes:
        path: the file.
        channels: its channels.
        notes: what is damaged or missing, as sentences.
    """

    path: Path
    channels: tuple[Channel, ...]
    notes: tuple[str, ...]

    @property
    def is_slow(self) -> bool:
        """True if reading takes so long that it is worth several threads."""

    def read(self, channel: Channel, i: int, most: int | None = None) -> bytes:
        """Reads message `i` of a channel, or its first `most` bytes or a few more.

        Raises:
            ValueError: damaged or truncated.
            OSError: the file cannot be read.
        """

    def many(self) -> AbstractContextManager[None]:
        """Makes the reading of many messages faster, by this thread and within the block."""


# Damaged places of a file that are named.
MOST_NAMED = 8


def shortened(damages: list[str]) -> list[str]:
    """Returns sentences about the first damaged places of a file, and how many more there are."""
    more = len(damages) - MOST_NAMED
    return [*damages[:MOST_NAMED], f"is damaged at {amount(more, 'more place')}"] if more > 0 else damages


class ChannelBuilder:
    """Collects the messages of a file while its records are listed."""

    def __init__(self) -> None:
        self._parts: dict[int, list[tuple[np.ndarray, int, np.ndarray]]] = {}
        self.first_chunk: dict[int, int] = {}

    def add(self, number: int, log_ns: np.ndarray, chunk: int, offset: np.ndarray) -> None:
        """Adds messages of channel `number`: times and offsets in a chunk."""
        self._parts.setdefault(number, []).append((log_ns.astype(np.int64), chunk, offset.astype(np.int64)))
        self.first_chunk.setdefault(number, chunk)

    def arrays(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns log_ns, chunk and offset of a channel's messages."""
        parts = self._parts.get(number, [])
        if not parts:
            return tuple(np.empty(0, np.int64) for _ in range(3))  # type: ignore[return-value]
        times, chunks, offsets = zip(*parts, strict=True)
        lengths = [len(time) for time in times]
        return np.concatenate(times), np.repeat(np.array(chunks, np.int64), lengths), np.concatenate(offsets)


@dataclass(frozen=True, eq=False)
class Topic:
    """All messages of a topic, sorted by log time.

    Attributes:
        name, type: of the topic; the type as `package/Name` (`sensor_msgs/Image`, `foxglove/RawImage`).
        sources: file and channel of each publisher.
        log_ns: (n,) times of recording.
        source, number: (n,) which of the sources has the message, and its number there.
    """

    name: str
    type: str
    sources: tuple[tuple[BagFile, Channel], ...]
    log_ns: Int64[np.ndarray, "n"]
    source: Int64[np.ndarray, "n"]
    number: Int64[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.log_ns)

    @property
    def rate_hz(self) -> float | None:
        """Messages per second, by the median of their distances, or their mean if several have the same time."""
        if len(self) < 2:
            return None
        distances = np.diff(self.log_ns)
        period_ns = float(np.median(distances)) or float(np.mean(distances))
        return 1e9 / period_ns if period_ns > 0 else None

    @property
    def is_slow(self) -> bool:
        """True if reading takes so long that it is worth several threads."""
        return any(file.is_slow for file, _ in self.sources)

    def read(self, i: int, most: int | None = None) -> tuple[Channel, bytes]:
        """Reads message `i` (or its first `most` bytes), with its channel.

        Raises:
            ValueError: damaged or truncated.
            OSError: the file cannot be read.
        """
        file, channel = self.sources[int(self.source[i])]
        return channel, file.read(channel, int(self.number[i]), most)

    @contextmanager
    def many(self) -> Iterator[None]:
        """Makes the reading of many messages faster, by this thread and within the block.

        Raises:
            ValueError: a file is damaged.
        """
        with ExitStack() as files:
            for file in {id(file): file for file, _ in self.sources}.values():
                files.enter_context(file.many())
            yield

    def nearest(self, log_ns: int) -> int:
        """Returns the number of the message whose log time is nearest; the topic must have messages."""
        return int(np.argmin(np.abs(self.log_ns - log_ns)))

    def between(self, first_ns: int, last_ns: int) -> range:
        """Returns the numbers of the messages logged from `first_ns` to `last_ns`."""
        return range(*np.searchsorted(self.log_ns, [first_ns, last_ns + 1]).tolist())


@dataclass(frozen=True, eq=False)
class Bag:
    """An open bag.

    Attributes:
        path: the file or folder that was opened.
        topics: by name, those without messages, too.
        notes: what is damaged or missing, as sentences.
    """

    path: Path
    topics: dict[str, Topic]
    notes: tuple[str, ...] = field(default=())

    def of_type(self, *types: str) -> list[Topic]:
        """Returns the topics of these types that have messages, by name."""
        return [topic for _, topic in sorted(self.topics.items()) if topic.type in types and len(topic)]


def join(path: Path, files: Sequence[BagFile]) -> Bag:
    """Joins the files of a bag."""
    notes = [note for file in files for note in file.notes]
    by_topic: dict[str, dict[str, list[tuple[BagFile, Channel]]]] = {}
    for file in files:
        for channel in file.channels:
            by_type = by_topic.setdefault(channel.topic, {})
            by_type.setdefault(short_type(channel.type), []).append((file, channel))
    topics = {}
    for name, by_type in by_topic.items():
        for kind, sources in by_type.items():
            # a topic with messages of two types is two topics
            shown = name if len(by_type) == 1 else f"{name} ({kind})"
            topics[shown] = _topic(shown, kind, sources)
        if len(by_type) > 1:
            notes.append(f"the topic {name} has messages of several types: {', '.join(sorted(by_type))}")
        for sources in by_type.values():
            publishers = {channel.publisher for _, channel in sources if len(channel.log_ns)}
            if len(publishers) > 1 and not name.startswith("/tf"):
                notes.append(f"the topic {name} has {len(publishers)} publishers ({', '.join(sorted(publishers))})")
    return Bag(path, topics, tuple(notes))


def _topic(name: str, kind: str, sources: list[tuple[BagFile, Channel]]) -> Topic:
    log_ns = np.concatenate([channel.log_ns for _, channel in sources])
    source = np.repeat(np.arange(len(sources)), [len(channel.log_ns) for _, channel in sources])
    number = np.concatenate([np.arange(len(channel.log_ns)) for _, channel in sources])
    order = np.argsort(log_ns, kind="stable")
    return Topic(name, kind, tuple(sources), log_ns[order], source[order], number[order])


def short_type(name: str) -> str:
    """Returns a message type as `package/Name`, for all spellings."""
    parts = [part for part in name.replace(".", "/").split("/") if part != "msg"]
    if parts[0] == "foxglove_msgs":
        parts[0] = "foxglove"
    return "/".join(parts)
