"""Finds the files of a bag and opens them.

PATH.bag           ROS 1, also RealSense's
PATH.mcap          MCAP, of ROS or not
PATH.db3           ROS 2, SQLite
PATH/metadata.yaml, *.mcap or *.db3    a folder of ROS 2; without metadata.yaml the recorder was killed, and the files
                                       must be one, or NAME_0, NAME_1, ... of one kind, the parts of one recording
"""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import Any

from annotator.files import open_file, read_text_file
from annotator.recordings.ros import mcap_file, ros1_file, sqlite_file
from annotator.recordings.ros.bag import Bag, BagFile, join
from annotator.recordings.ros.decode import FIELD_ERRORS
from annotator.types.errors import RecordingError
from annotator.types.messages import amount

METADATA = "metadata.yaml"
MAGICS = {".bag": ros1_file.MAGIC, ".mcap": mcap_file.MAGIC, ".db3": sqlite_file.MAGIC}
SUFFIXES = tuple(MAGICS)
LOOKED_FOR = "a .bag, .mcap or .db3 file, or a folder of ROS 2 with such files"
LARGEST_METADATA = 1 << 24


def is_bag(path: Path) -> bool:
    """True for a bag, by the names and first bytes of its files.

    Raises:
        OSError: a file cannot be read.
    """
    files = [path] if path.is_file() else _files_in(path)
    return bool(files) and all(_has_magic(file) for file in files[:1])


def open_bag(path: Path) -> Bag | None:
    """Opens the bag at `path`, listing its messages; None if it is not one. Bags are cached until they change.

    Raises:
        RecordingError: a file is missing or cannot be used.
        OSError: a file cannot be read.
    """
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
        if path.suffix.lower() == ".bag":
            return ros1_file.Ros1File(path)
        if path.suffix.lower() == ".mcap":
            return mcap_file.McapFile(path, are_compressed)
        return sqlite_file.SqliteFile(path, are_compressed)
    except FIELD_ERRORS as error:
        raise RecordingError(f"{path}: {error}; record or copy it again") from error


def _metadata(folder: Path) -> dict[str, Any]:
    """Returns the content of `metadata.yaml`; empty without that file."""
    import yaml

    path = folder / METADATA
    if not path.is_file():
        return {}
    if path.stat().st_size > LARGEST_METADATA:
        raise RecordingError(f"{path}: is too large; remove it to read the bag without it")
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
    magic = MAGICS.get(path.suffix.lower())
    if magic is None:
        return False
    with open_file(path) as file:
        return file.read(len(magic)) == magic
