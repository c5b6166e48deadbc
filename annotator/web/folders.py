"""The folders that recordings may be added from, under names that do not reveal their paths."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.recordings import detect_format
from annotator.types.errors import NotFoundError, RecordingError

# Maximum number of listed entries per folder: detecting the format of each takes time.
MOST_ENTRIES = 1000


@dataclass(frozen=True)
class Entry:
    """One entry of a folder.

    Attributes:
        path: `ROOT/sub/...`, the path for browsers.
        recording: its format if it is a recording, else None.
        is_folder: True for a folder that can be listed; a recording may be one, too.
    """

    name: str
    path: str
    recording: str | None
    is_folder: bool


@dataclass(frozen=True)
class Listing:
    """The content of a folder; `parent` is None for the list of roots."""

    path: str
    parent: str | None
    entries: tuple[Entry, ...]


class Folders:
    """Maps paths of browsers to paths on this computer; paths outside the registered folders are refused."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._roots = dict(_named(folders))

    def list(self, path: str) -> Listing:
        """Lists the sub-folders and recordings of a folder; "" lists the roots.

        Raises:
            NotFoundError: no such folder.
        """
        if not path:
            return Listing("", None, tuple(_entry(name, name, root) for name, root in self._roots.items()))
        folder = self.find(path)
        if not folder.is_dir():
            raise _missing(path)
        parent = path.rpartition("/")[0]
        entries = (_entry(name, f"{path}/{name}", place) for name, place in self._children(path, folder))
        return Listing(path, parent, tuple(e for e in entries if e.is_folder or e.recording is not None))

    def roots(self) -> tuple[tuple[Path, str], ...]:
        """The roots with their names, nested ones first."""
        nested_first = sorted(self._roots.items(), key=lambda entry: -len(entry[1].parts))
        return tuple((root, name) for name, root in nested_first)

    def find(self, path: str) -> Path:
        """The real path of a file or folder below a root.

        Raises:
            NotFoundError: no such path, or it leads outside the roots, such as through a link.
        """
        name, *parts = path.split("/")
        root = self._roots.get(name)
        # a backslash separates components on other systems
        if root is None or any(part in ("", ".", "..") or part.startswith(".") or _is_unsafe(part) for part in parts):
            raise _missing(path)
        try:
            top = root.resolve(strict=True)
            resolved = root.joinpath(*parts).resolve(strict=True)
        except (OSError, RuntimeError, ValueError) as error:
            raise _missing(path) from error
        if not resolved.is_relative_to(top):
            raise _missing(path)
        return resolved

    def _children(self, path: str, folder: Path) -> Iterator[tuple[str, Path]]:
        try:
            names = sorted(child.name for child in folder.iterdir() if not child.name.startswith("."))
        except OSError as error:
            raise NotFoundError(f"{path}: cannot be read ({error.strerror})") from error
        for name in names[:MOST_ENTRIES]:
            try:
                yield name, self.find(f"{path}/{name}")
            except NotFoundError:  # a link that is broken or leads out of the root
                continue


def _entry(name: str, path: str, place: Path) -> Entry:
    try:
        recording = detect_format(place)
    except RecordingError:  # a known format, but without frames or unreadable
        recording = None
    return Entry(name, path, recording, place.is_dir())


def _is_unsafe(part: str) -> bool:
    return not part.isprintable() or "\\" in part or "\0" in part


def _missing(path: str) -> NotFoundError:
    return NotFoundError(f"there is no folder or recording {path!r} in the server's folders")


def _named(folders: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """Names each root by its last path component; "-2", "-3" ... is appended to duplicates."""
    taken: set[str] = set()
    for folder in dict.fromkeys(path.resolve() for path in folders):
        base = name = folder.name or "root"
        number = 1
        while name in taken:
            number += 1
            name = f"{base}-{number}"
        taken.add(name)
        yield name, folder
