"""The folders that recordings may be picked from, under names that say nothing of where they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.recordings import detect_format
from annotator.types.errors import NotFoundError, RecordingError

# More of a folder is not shown: nobody clicks through it, and it would take long to look into each.
MOST_ENTRIES = 1000


@dataclass(frozen=True)
class Entry:
    """One thing in a folder.

    Attributes:
        path: `ROOT/sub/...`, as a browser names it.
        recording: the format where it is a recording, else None.
        is_folder: there may be more in it, also where it is a recording.
    """

    name: str
    path: str
    recording: str | None
    is_folder: bool


@dataclass(frozen=True)
class Listing:
    """What is in a folder; `parent` is None at the top, where the roots are listed."""

    path: str
    parent: str | None
    entries: tuple[Entry, ...]


class Folders:
    """Turns the paths of browsers into paths of this computer, and never leaves the registered folders."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._roots = dict(_named(folders))

    def list(self, path: str) -> Listing:
        """What is in a folder: sub-folders, and files that are recordings; "" lists the roots.

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

    def places(self) -> tuple[tuple[Path, str], ...]:
        """The roots with their names, inner ones first."""
        inner_first = sorted(self._roots.items(), key=lambda entry: -len(entry[1].parts))
        return tuple((root, name) for name, root in inner_first)

    def find(self, path: str) -> Path:
        """The real path of something below a root.

        Raises:
            NotFoundError: no such thing, or it lies outside, also by way of a link.
        """
        name, *parts = path.split("/")
        root = self._roots.get(name)
        # a backslash and a colon separate nothing here, but they do on other systems
        if root is None or any(part in ("", ".", "..") or part.startswith(".") or _odd(part) for part in parts):
            raise _missing(path)
        try:
            top = root.resolve(strict=True)
            found = root.joinpath(*parts).resolve(strict=True)
        except (OSError, RuntimeError, ValueError) as error:
            raise _missing(path) from error
        if not found.is_relative_to(top):
            raise _missing(path)
        return found

    def _children(self, path: str, folder: Path) -> Iterator[tuple[str, Path]]:
        try:
            names = sorted(child.name for child in folder.iterdir() if not child.name.startswith("."))
        except OSError as error:
            raise NotFoundError(f"{path}: cannot be read ({error.strerror})") from error
        for name in names[:MOST_ENTRIES]:
            try:
                yield name, self.find(f"{path}/{name}")
            except NotFoundError:  # a link that leads out of the root, or nowhere
                continue


def _entry(name: str, path: str, place: Path) -> Entry:
    try:
        recording = detect_format(place)
    except RecordingError:  # of a clear format but without frames, or not to be read
        recording = None
    return Entry(name, path, recording, place.is_dir())


def _odd(part: str) -> bool:
    return not part.isprintable() or "\\" in part or "\0" in part


def _missing(path: str) -> NotFoundError:
    return NotFoundError(f"there is no folder or recording {path!r} in the server's folders")


def _named(folders: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """Each root by its last name; where two have the same, "-2", "-3" ... is appended."""
    taken: set[str] = set()
    for folder in dict.fromkeys(path.resolve() for path in folders):
        base = name = folder.name or "root"
        number = 1
        while name in taken:
            number += 1
            name = f"{base}-{number}"
        taken.add(name)
        yield name, folder
