"""Recordings in a storage that fsspec reads (`s3://`, `gs://`, `https://`, `file://`, ...), copied file by file.

A reader lists a recording's folder when it opens it, and reads the files of one frame when it is asked for that. So the
copy has every file's name at once, but nothing in it; the files of a frame, and those that belong to no frame alone
(calibrations, times), are filled before they are read. What was filled longest ago is emptied again, so that the
copy needs no more of the disk than it was allowed. A recording that is one file (`.mkv`) is copied whole.

Names of files decide which frame they belong to: `KEY.suffix` anywhere, or a scene's folder whose path makes the key.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from annotator.recordings.open import open_recording
from annotator.recordings.recording import Recording
from annotator.recordings.sunrgbd_scenes import BETWEEN
from annotator.types import Frame
from annotator.types.errors import RecordingError

# What readers look into when they open a recording: small files beside its folders.
DESCRIPTIONS = (".json", ".txt", ".xml", ".csv", ".yaml", ".yml")
LARGEST_DESCRIPTION_BYTES = 10**6


def open_mirror(url: str, folder: Path, limit_bytes: int) -> Mirror:
    """The recording at a URL.

    Args:
        folder: copies are made below it, each in a folder that goes with the recording, or with the next copy that is
            made after its process was killed.
        limit_bytes: so much of the recording may be there at a time.

    Raises:
        RecordingError: the storage cannot be reached, holds nothing there, or the whole of a recording that is one
            file does not fit.
        UnknownFormatError: no reader recognises what is there.
    """
    with _told(url):
        from fsspec.core import url_to_fs

        system, root = url_to_fs(url)
        found = {path: _size(info) for path, info in system.find(root, detail=True).items()}
    name = PurePosixPath(root).name or "recording"
    is_file = list(found) == [root]
    files = {name: (root, found[root])} if is_file else dict(_below(url, root, found))
    if not files:
        raise RecordingError(f"{url}: holds no files; give the URL of a recording")
    place = _own_folder(folder)
    store = _Store(url, system, place if is_file else place / name, files, limit_bytes)
    try:
        for path, (_, size) in files.items():
            store.empty(path)
            described = "/" not in path and path.lower().endswith(DESCRIPTIONS) and size <= LARGEST_DESCRIPTION_BYTES
            if is_file or described:
                store.keep(path)
        with store.in_words():
            opened = open_recording(place / name)
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)
        raise
    return Mirror(opened, store, weakref.finalize(store, shutil.rmtree, place, True))


class Mirror:
    """A `Recording` in a storage; its files are copied as frames are asked for."""

    def __init__(self, opened: Recording, store: _Store, removed: weakref.finalize[Any, Any]) -> None:
        self._opened, self._store, self._removed = opened, store, removed
        self._of_key: dict[str, list[str]] = {}
        self._shared: list[str] = []
        keys = set(opened.keys)
        for path in store.files:
            owner = _owner(path, keys)
            (self._shared if owner is None else self._of_key.setdefault(owner, [])).append(path)

    @property
    def path(self) -> Path:
        """The copy."""
        return self._opened.path

    @property
    def root(self) -> Path:
        """As of the copy."""
        return self._opened.root

    @property
    def format(self) -> str:
        """The reader's name."""
        return self._opened.format

    @property
    def name(self) -> str:
        """The last part of the URL."""
        return self._opened.name

    @property
    def keys(self) -> tuple[str, ...]:
        """The frames' names, in order."""
        return self._opened.keys

    @property
    def is_sequence(self) -> bool:
        """True where the order of the frames is the order of time."""
        return self._opened.is_sequence

    def __len__(self) -> int:
        return len(self._opened)

    def frame(self, i: int) -> Frame:
        """Frame number `i`, 0-based.

        Raises:
            FrameError: this frame cannot be read.
            RecordingError: its files cannot be copied.
            IndexError: there is no such frame.
        """
        if not 0 <= i < len(self):
            raise IndexError(f"frame {i} of a recording with {len(self)} frames")
        for path in self._shared:
            self._store.keep(path)
        self._store.fill(self.keys[i], self._of_key.get(self.keys[i], []))
        with self._store.in_words():
            return self._opened.frame(i)

    def close(self) -> None:
        """Removes the copy; nothing can be read afterwards. It also goes with the object."""
        self._removed()


@dataclass(eq=False)
class _Store:
    """The files of a copy, full or empty.

    Attributes:
        url: of the recording.
        system: fsspec's file system.
        folder: of the copy.
        files: path below the folder -> path in the storage, and size, bytes.
        limit_bytes: so much may be full.
    """

    url: str
    system: Any
    folder: Path
    files: dict[str, tuple[str, int]]
    limit_bytes: int
    kept: set[str] = field(default_factory=set)
    filled: OrderedDict[str, list[str]] = field(default_factory=OrderedDict)
    used_bytes: int = 0

    def empty(self, path: str) -> None:
        """Leaves nothing of a file but its name."""
        place = self.folder / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(b"")

    def keep(self, path: str) -> None:
        """Fills a file for good."""
        if path not in self.kept:
            self._copy([path])
            self.kept.add(path)

    def fill(self, key: str, paths: list[str]) -> None:
        """Fills the files of a frame; empties those of frames that were not asked for lately."""
        if key not in self.filled:
            wanted = [path for path in paths if path not in self.kept]
            self._copy(wanted)
            self.filled[key] = wanted
        self.filled.move_to_end(key)

    @contextmanager
    def in_words(self) -> Iterator[None]:
        """What is said of the copy is said of the storage."""
        try:
            yield
        except RecordingError as error:
            error.args = (str(error).replace(str(self.folder), self.url),)
            raise

    def _copy(self, paths: list[str]) -> None:
        needed = sum(self.files[path][1] for path in paths)
        while self.filled and self.used_bytes + needed > self.limit_bytes:
            for path in self.filled.popitem(last=False)[1]:
                self.used_bytes -= self.files[path][1]
                self.empty(path)
        if self.used_bytes + needed > self.limit_bytes:
            raise RecordingError(
                f"{self.url}: {', '.join(paths[:3])} of {needed / 1e6:.1f} MB does not fit into the copy, which may "
                f"have {self.limit_bytes / 1e6:.1f} MB and keeps {self.used_bytes / 1e6:.1f}; raise --cache-mb"
            )
        copied: list[str] = []
        try:
            for path in paths:
                self._download(path)
                copied.append(path)
        except BaseException:  # all or nothing: what no frame answers for would never be emptied
            for path in copied:
                self.used_bytes -= self.files[path][1]
                self.empty(path)
            raise

    def _download(self, path: str) -> None:
        remote, _ = self.files[path]
        part = self.folder / f"{path}.part"
        try:
            with _told(f"{self.url}/{path}"):
                self.system.get_file(remote, str(part))
                size = part.stat().st_size  # a web server may not have told it before
                part.replace(self.folder / path)
        finally:
            part.unlink(missing_ok=True)
        self.files[path] = (remote, size)
        self.used_bytes += size


@contextmanager
def _told(url: str) -> Iterator[None]:
    """What fsspec and the libraries behind it raise becomes an error for the user."""
    try:
        yield
    except Exception as error:  # each storage's library has kinds of its own
        reason = str(error) or type(error).__name__
        problem = f"{url}: cannot be reached: {reason}; check the address, the rights, and what is installed here"
        raise RecordingError(problem) from error


def _size(info: dict[str, Any]) -> int:
    return int(info.get("size") or 0)


def _below(url: str, root: str, found: dict[str, int]) -> Iterator[tuple[str, tuple[str, int]]]:
    """Path below the root -> where it is, and size. Storages take any name: one that leads out of it is refused."""
    for path, size in found.items():
        relative = PurePosixPath(path).relative_to(root)
        if ".." in relative.parts or relative.is_absolute():
            raise RecordingError(f"{url}: holds a file of the name {path!r}, which leads out of its folder; rename it")
        if relative.parts:
            yield str(relative), (path, size)


def _owner(path: str, keys: set[str]) -> str | None:
    """The frame that a file belongs to alone, or None."""
    pure = PurePosixPath(path)
    if pure.stem in keys:
        return pure.stem
    folders = pure.parts[:-1]
    joined = (BETWEEN.join(folders[:count]) for count in range(len(folders), 0, -1))
    return next((key for key in joined if key in keys), None)


def _own_folder(folder: Path) -> Path:
    """A new folder of this process; those of processes that have been killed are removed."""
    folder.mkdir(parents=True, exist_ok=True)
    for other in folder.iterdir():
        pid = other.name.partition("-")[0]
        if pid.isdigit() and not _is_alive(int(pid)):
            shutil.rmtree(other, ignore_errors=True)
    return Path(tempfile.mkdtemp(prefix=f"{os.getpid()}-", dir=folder))


def _is_alive(pid: int) -> bool:
    if os.name == "nt":  # there, asking so would end it
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
