"""Recordings in storage that fsspec reads (`s3://`, `gs://`, `https://`, `file://`, ...), copied file by file.

A reader lists a recording's folder when it opens it, and reads the files of one frame when that is requested. So the
local copy has all file names from the start, as empty files. Files of a frame, and shared files (calibrations, times),
are downloaded before they are read. The least recently used frames are emptied again, so that the copy stays within its
limit. A recording that is a single file (`.mkv`, `.r3d`, `.bag`), and the files of a ROS 2 folder, are copied whole.

A file's frame follows from its name: `KEY.suffix` in any folder, or a scene folder whose path is the key. Readers of
other formats tell it (`file_owners`).
"""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from scipy.spatial.transform import RigidTransform

from annotator.files import unfinished_folder
from annotator.recordings.open import NO_OPTIONS, open_recording
from annotator.recordings.recording import ReaderOptions, Recording
from annotator.recordings.sunrgbd import KEY_SEPARATOR
from annotator.text import normal
from annotator.types import Frame
from annotator.types.errors import RecordingError

# Ends of the names of files beside a recording's folders that readers need when they open it.
DESCRIPTIONS = (".json", ".txt", ".log", ".xml", ".csv", ".yaml", ".yml", "metadata")
# An hour of poses is smaller.
LARGEST_DESCRIPTION_BYTES = 3 * 10**7
# Files of a folder of ROS 2, which hold all frames.
WHOLE = (".mcap", ".db3")


def open_mirror(url: str, folder: Path, limit_bytes: int, options: ReaderOptions = NO_OPTIONS) -> Mirror:
    """Opens the recording at a URL.

    Args:
        folder: parent folder of the local copies. A copy is removed with its recording; copies of killed processes are
            removed when the next one is made.
        limit_bytes: maximum size of the local copy at any time.
    """
    with _storage_errors(url):
        from fsspec.core import url_to_fs

        system, root = url_to_fs(url)
        sizes = {path: int(info.get("size") or 0) for path, info in system.find(root, detail=True).items()}
    name = PurePosixPath(root).name or "recording"
    is_file = list(sizes) == [root]
    files = {name: (root, sizes[root])} if is_file else dict(_below(url, root, sizes))
    if not files:
        raise RecordingError(f"{url}: has no files; give the URL of a recording")
    # what killed processes have left is removed
    with ExitStack() as stack:
        place = stack.enter_context(unfinished_folder(folder, "recording"))
        store = _Store(url, system, place if is_file else place / name, files, limit_bytes)
        store.empty(files)
        for path, (_, size) in files.items():
            is_small = path.lower().endswith(DESCRIPTIONS) and size <= LARGEST_DESCRIPTION_BYTES
            if is_file or ("/" not in path and (is_small or path.lower().endswith(WHOLE))):
                store.fetch([path])
        with store.url_in_errors():
            opened = open_recording(place / name, options)
        keys = {normal(key): key for key in opened.keys}
        listed: dict[str, str] = getattr(opened, "file_owners", {})
        of_key: dict[str, list[str]] = {}
        shared = list[str]()
        for path in files:
            owner = listed.get(path) or _owner(path, keys)
            (shared if owner is None else of_key.setdefault(owner, [])).append(path)
        removed = weakref.finalize(store, stack.pop_all().close)
        return Mirror(opened.path, opened.keys, opened, store, removed, of_key, shared)


@dataclass(frozen=True, eq=False)
class Mirror(Recording):
    """A `Recording` in remote storage; its files are downloaded when frames are read. `path` is the local copy.

    `removed` removes the copy, also when it is garbage; `of_key` has the files of each frame, relative to its folder.
    """

    opened: Recording
    store: _Store
    removed: weakref.finalize[Any, Any]
    of_key: dict[str, list[str]]
    shared: list[str]

    @property
    def format(self) -> str:  # type: ignore[override]
        return self.opened.format

    @property
    def is_sequence(self) -> bool:  # type: ignore[override]
        return self.opened.is_sequence

    @property
    def root(self) -> Path:
        return self.opened.root

    @property
    def name(self) -> str:
        return self.opened.name

    @property
    def notes(self) -> tuple[str, ...]:
        return self.opened.notes

    @property
    def pose_source(self) -> str | None:
        return self.opened.pose_source

    def frame(self, i: int) -> Frame:
        with self._fetched(i):
            return self.opened.frame(i)

    def pose(self, i: int) -> RigidTransform | None:
        with self._fetched(i):
            return self.opened.pose(i)

    @contextmanager
    def _fetched(self, i: int) -> Iterator[None]:
        key = self.key(i)
        # one by one: those that have arrived stay if a later one fails
        for path in self.shared:
            self.store.fetch([path])
        self.store.fetch(self.of_key.get(key, []), key)
        with self.store.url_in_errors():
            yield

    def close(self) -> None:
        """Removes the copy; no frame can be read afterwards. Garbage collection also removes it."""
        self.removed()


@dataclass(eq=False)
class _Store:
    """The files of a local copy, downloaded or empty.

    Attributes:
        files: path relative to the folder -> path in the storage, and size in bytes.
        limit_bytes, used_bytes: of what is downloaded.
        present: downloaded files.
        filled: those that may be emptied, by frame key, least recently used first.
    """

    url: str
    system: Any
    folder: Path
    files: dict[str, tuple[str, int]]
    limit_bytes: int
    used_bytes: int = 0
    present: set[str] = field(default_factory=set)
    filled: OrderedDict[str, list[str]] = field(default_factory=OrderedDict)

    def empty(self, paths: Iterable[str]) -> None:
        for path in paths:
            place = self.folder / path
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(b"")

    def fetch(self, paths: Iterable[str], key: str | None = None) -> None:
        """Downloads files: those of a frame until others need the room, without a key for good."""
        missing = [path for path in paths if path not in self.present]
        if key is not None and key in self.filled:
            self.filled.move_to_end(key)
        if not missing:
            return
        needed = sum(self.files[path][1] for path in missing)
        while self.filled and self.used_bytes + needed > self.limit_bytes:
            oldest = self.filled.popitem(last=False)[1]
            self.used_bytes -= sum(self.files[path][1] for path in oldest)
            self.present.difference_update(oldest)
            self.empty(oldest)
        if self.used_bytes + needed > self.limit_bytes:
            raise RecordingError(
                f"{self.url}: no room in the local copy for {', '.join(missing[:3])} ({needed / 1e6:.1f} MB; limit "
                f"{self.limit_bytes / 1e6:.1f} MB, used {self.used_bytes / 1e6:.1f} MB); raise --cache-mb"
            )
        try:
            for path in missing:
                with _storage_errors(f"{self.url}/{path}"):
                    self.system.get_file(self.files[path][0], str(self.folder / path))
        except BaseException:  # files that belong to no entry of `filled` would never be emptied
            self.empty(missing)
            raise
        for path in missing:
            # some web servers do not report it in listings
            size = (self.folder / path).stat().st_size
            self.files[path] = (self.files[path][0], size)
            self.used_bytes += size
        self.present.update(missing)
        if key is not None:
            self.filled[key] = missing

    @contextmanager
    def url_in_errors(self) -> Iterator[None]:
        """Replaces the copy's path by the URL in error messages."""
        try:
            yield
        except RecordingError as error:
            error.args = (str(error).replace(str(self.folder), self.url),)
            raise


@contextmanager
def _storage_errors(url: str) -> Iterator[None]:
    """Converts any error of fsspec and its storage libraries into a RecordingError."""
    try:
        yield
    except Exception as error:  # each storage library has its own exception types
        reason = str(error) or type(error).__name__
        problem = (
            f"{url}: cannot be reached: {reason}; check the URL, your permissions, and that fsspec's package for this "
            "storage is installed"
        )
        raise RecordingError(problem) from error


def _below(url: str, root: str, sizes: dict[str, int]) -> Iterator[tuple[str, tuple[str, int]]]:
    """Yields path relative to the root, path in the storage and size; rejects names that lead out of the folder."""
    for path, size in sizes.items():
        relative = PurePosixPath(path).relative_to(root)
        if ".." in relative.parts or relative.is_absolute():
            raise RecordingError(f"{url}: has a file called {path!r}, which leads out of its folder; rename it")
        if relative.parts:
            yield str(relative), (path, size)


def _owner(path: str, keys: Mapping[str, str]) -> str | None:
    """Returns the key of the frame that a file belongs to, by their `normal` names; None for shared files."""
    *folders, name = PurePosixPath(normal(path)).parts
    scenes = (KEY_SEPARATOR.join(folders[:count]) for count in range(len(folders), 0, -1))
    return next((keys[each] for each in (PurePosixPath(name).stem, *scenes) if each in keys), None)
