"""A bag: messages by topic, in the order of their log times, each read on request; and which files are one.

PATH.bag           ROS 1, also RealSense's
PATH.mcap          MCAP, of ROS or not
PATH.db3           ROS 2, SQLite
PATH/metadata.yaml, *.mcap or *.db3    a folder of ROS 2; without metadata.yaml the recorder was killed, and the files
                                       must be one, or NAME_0, NAME_1, ... of one kind, the parts of one recording
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from annotator.files import open_file, read_text_file
from annotator.recordings.ros.bag_files import MESSAGE, ROS1_MAGIC, SQLITE_MAGIC, BagFile, Channel, Ros1File, SqliteFile
from annotator.recordings.ros.mcap_file import MCAP_MAGIC, McapFile
from annotator.types.errors import RecordingError
from annotator.types.messages import amount

METADATA = "metadata.yaml"
# The first bytes of a file, and what lists it, given whether its messages are compressed.
KINDS: dict[str, tuple[bytes, Callable[[Path, bool], BagFile]]] = {
    ".bag": (ROS1_MAGIC, lambda path, _: Ros1File(path)),
    ".mcap": (MCAP_MAGIC, McapFile),
    ".db3": (SQLITE_MAGIC, SqliteFile),
}


@dataclass(frozen=True, eq=False)
class Topic:
    """All messages of a topic, sorted by log time.

    `type` is `package/Name` (`sensor_msgs/Image`, `foxglove/RawImage`); `messages` is (n,), of the type `MESSAGE`.
    """

    name: str
    type: str
    files: tuple[BagFile, ...]
    messages: np.ndarray

    def __len__(self) -> int:
        return len(self.messages)

    @cached_property
    def log_ns(self) -> Int64[np.ndarray, "n"]:
        """The times of recording."""
        return np.ascontiguousarray(self.messages["log_ns"])

    @property
    def rate_hz(self) -> float | None:
        """Messages per second, by the median of their distances, or their mean if several have the same time."""
        if len(self) < 2:
            return None
        distances = np.diff(self.log_ns)
        period_ns = float(np.median(distances)) or float(np.mean(distances))
        return 1e9 / period_ns if period_ns > 0 else None

    def read(self, i: int, most: int | None = None) -> tuple[Channel, bytes]:
        """Reads message `i` (or its first `most` bytes), with its channel."""
        message = self.messages[i]
        file = self.files[message["file"]]
        return file.channels[int(message["channel"])], file.read(message, most)

    def nearest(self, log_ns: int) -> int:
        """Returns the number of the message whose log time is nearest; the topic must have messages."""
        return int(np.argmin(np.abs(self.log_ns - log_ns)))

    def between(self, first_ns: int, last_ns: int) -> range:
        return range(*np.searchsorted(self.log_ns, [first_ns, last_ns + 1]).tolist())


@dataclass(frozen=True, eq=False)
class Bag:
    """An open bag: its topics by name, also those without messages, and notes on what is damaged or missing."""

    path: Path
    topics: dict[str, Topic]
    notes: tuple[str, ...] = field(default=())

    def of_type(self, *types: str) -> list[Topic]:
        """Returns the topics of these types that have messages, by name."""
        return [topic for _, topic in sorted(self.topics.items()) if topic.type in types and len(topic)]


def join(path: Path, files: Sequence[BagFile]) -> Bag:
    notes = [note for file in files for note in file.notes]
    # by name and type: a topic with messages of two types is two topics
    sources: dict[str, dict[str, list[tuple[Channel, np.ndarray]]]] = {}
    for at, file in enumerate(files):
        messages = _by_channel(file, at)
        for number, channel in file.channels.items():
            found = channel, messages.get(number, np.empty(0, MESSAGE))
            sources.setdefault(channel.topic, {}).setdefault(short_type(channel.type), []).append(found)
    topics = {}
    for name, by_type in sources.items():
        for kind, parts in by_type.items():
            shown = name if len(by_type) == 1 else f"{name} ({kind})"
            together = np.concatenate([messages for _, messages in parts])
            together = together[np.argsort(together["log_ns"], kind="stable")]
            topics[shown] = Topic(shown, kind, tuple(files), together)
            publishers = {channel.publisher for channel, messages in parts if len(messages)}
            if len(publishers) > 1 and not name.startswith("/tf"):
                notes.append(f"the topic {name} has {len(publishers)} publishers ({', '.join(sorted(publishers))})")
        if len(by_type) > 1:
            notes.append(f"the topic {name} has messages of several types: {', '.join(sorted(by_type))}")
    return Bag(path, topics, tuple(notes))


def _by_channel(file: BagFile, at: int) -> dict[int, np.ndarray]:
    """Returns the messages of file number `at`, of the type `MESSAGE`, by the number of their channel."""
    messages = file.messages[np.argsort(file.messages["channel"], kind="stable")]
    messages["file"] = at
    numbers, starts = np.unique(messages["channel"], return_index=True)
    return dict(zip(numbers.tolist(), np.split(messages, starts[1:]), strict=False))


def short_type(name: str) -> str:
    """Returns a message type as `package/Name`, for all spellings."""
    parts = [part for part in name.replace(".", "/").split("/") if part != "msg"]
    if parts[0] == "foxglove_msgs":
        parts[0] = "foxglove"
    return "/".join(parts)


def is_bag(path: Path) -> bool:
    """True for a bag, by the names and first bytes of its files."""
    files = [path] if path.is_file() else _files_in(path)
    return bool(files) and _has_magic(files[0])


def open_bag(path: Path) -> Bag | None:
    """Opens the bag at `path`, listing its messages; None if it is not one. Bags are cached until they change."""
    if not is_bag(path):
        return None
    files = [path] if path.is_file() else [*_files_in(path), *path.glob(METADATA)]
    stats = [(str(file), (stat := file.stat()).st_mtime_ns, stat.st_size) for file in files]
    return _open(path, tuple(stats))


@lru_cache(maxsize=4)
def _open(path: Path, state: tuple[tuple[str, int, int], ...]) -> Bag:
    """Opens a bag whose files are in this `state`: adding a recording opens it several times."""
    if path.is_file():
        return join(path, [_open_file(path)])
    metadata, files = _metadata(path), _files_in(path)
    names = metadata.get("relative_file_paths")
    declared = [path / Path(str(name)).name for name in names] if isinstance(names, list) else []
    missing = [file.name for file in declared if not file.is_file()]
    compression = str(metadata.get("compression_mode") or "").lower()
    if missing:
        raise RecordingError(
            f"{path}: {', '.join(missing[:3])} is missing; copy it there, or remove {METADATA} to read the other files"
        )
    bag = join(path, [_open_file(file, compression == "message") for file in files])
    count, expected = sum(map(len, bag.topics.values())), metadata.get("message_count")
    notes = bag.notes
    if not metadata:
        notes += (f"has no {METADATA}, so its recorder was not closed; its files are read as far as they are sound",)
    elif isinstance(expected, int) and expected != count:
        notes += (f"{METADATA} declares {amount(expected, 'message')}, but the files have {count}",)
    return Bag(path, bag.topics, notes)


def _open_file(path: Path, are_compressed: bool = False) -> BagFile:
    try:
        return KINDS[path.suffix.lower()][1](path, are_compressed)
    except (ValueError, TypeError, LookupError, ArithmeticError) as error:
        raise RecordingError(f"{path}: {error}; record or copy it again") from error


def _metadata(folder: Path) -> dict[str, Any]:
    """Returns the content of `metadata.yaml`; empty without that file."""
    import yaml

    path = folder / METADATA
    if not path.is_file():
        return {}
    try:
        content = yaml.safe_load(read_text_file(path))
        info = content["rosbag2_bagfile_information"]
    # ValueError: not UTF-8, or a date that does not exist
    except (yaml.YAMLError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordingError(
            f"{path}: is not the description of a bag ({str(error)[:100]}); remove it to read the bag without it"
        ) from error
    return info if isinstance(info, dict) else {}


def _files_in(folder: Path) -> list[Path]:
    """Returns the files of a ROS 2 folder, in the order of their numbers; empty if they are several recordings."""
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        named = [entry for entry in entries if entry.name.lower().endswith((".mcap", ".db3"))]
        files = [folder / entry.name for entry in named if entry.name[0] != "." and entry.is_file()]
    files.sort(key=lambda file: (len(file.name), file.name))
    if not (folder / METADATA).is_file():
        return files if _are_parts(files) else []
    if not files and any(folder.glob("*.zstd")):
        raise RecordingError(f"{folder}: its files are compressed as a whole; run zstd -d {folder}/*.zstd")
    return files


def _are_parts(files: list[Path]) -> bool:
    """True if the files, in the order of their numbers, are parts of one recording by their names."""
    name = files[0].stem.rpartition("_")[0] if files else ""
    expected = [f"{name}_{number}{files[0].suffix}" for number in range(len(files))]
    return len(files) < 2 or [file.name for file in files] == expected


def _has_magic(path: Path) -> bool:
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        return False
    with open_file(path) as file:
        return file.read(len(kind[0])) == kind[0]
