"""The folders of a server: those that recordings may be added from, and its projects folder with lock and leftovers."""

from __future__ import annotations

import errno
import logging
import os
import re
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from annotator.files import private_folder, remove_abandoned
from annotator.project.config import BACKUPS as BACKUPS
from annotator.recordings import ADVICE, detect_format, kinds, nearest_formats
from annotator.types.errors import ConfigError, NotFoundError, RecordingError
from annotator.types.messages import amount, first_few
from annotator.web.jobs.records import require_own_files

LOG = logging.getLogger("annotator.web")

# Maximum number of listed entries per folder: detecting the format of each takes time.
MOST_ENTRIES = 1000
# Names and suffixes that a note lists.
MOST_NAMED = 4
NO_ROOTS = "this server offers no folder; whoever runs it can offer some"


@dataclass(frozen=True)
class FolderEntry:
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
class FolderListing:
    """What is in a folder.

    Attributes:
        path: `ROOT/sub/...`; "" for the list of the roots.
        here: the folder or file itself, if it is a recording.
        entries: its sub-folders, and the recordings in it.
        notes: what is not listed and why, and what the folder looks like; one sentence each.
        kinds: what a recording of each format must have; () if there are recordings.
    """

    path: str
    here: FolderEntry | None
    entries: tuple[FolderEntry, ...]
    notes: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()


class Folders:
    """Maps paths of browsers to paths on this computer, under names that do not reveal these.

    Paths that lead outside the registered folders, such as through a link, are not found.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self._roots = dict(_named(folders))

    def list(self, typed: str) -> FolderListing:
        """Lists the sub-folders and recordings of a folder; "" lists the roots.

        Args:
            typed: `ROOT/sub/...`, or the path on this computer of a folder or recording within a root.
        """
        path = self._below_root(typed)
        if not path:
            roots = tuple(_entry(name, name, root) for name, root in self._roots.items())
            return FolderListing("", None, roots, () if roots else (NO_ROOTS,))
        place = self.find(path)
        own = _entry(path.rpartition("/")[2], path, place)
        here = None if own.recording is None else own
        if not place.is_dir():
            if here is None:
                raise _missing(path)
            return FolderListing(path, here, ())
        names, unfollowed, entries = _names(path, place), list[str](), list[FolderEntry]()
        for name in names[:MOST_ENTRIES]:
            try:
                entries.append(_entry(name, f"{path}/{name}", self.find(f"{path}/{name}")))
            except NotFoundError:  # a link that is broken or leads out of the root
                unfollowed.append(name)
        shown = tuple(entry for entry in entries if entry.is_folder or entry.recording is not None)
        is_bare = here is None and not any(entry.recording for entry in shown)
        notes = [
            *_on_files(place, [entry.name for entry in entries if entry not in shown] if is_bare else []),
            *(_nearest(place) if is_bare else []),
            *_on_links(unfollowed),
            *([] if names else ["this folder is empty"]),
            *(
                [f"only the first {MOST_ENTRIES} of {len(names)} entries are listed"]
                if len(names) > MOST_ENTRIES
                else []
            ),
        ]
        return FolderListing(path, here, shown, tuple(notes), kinds() if is_bare and entries else ())

    def _below_root(self, path: str) -> str:
        """The path for browsers of a path on this computer, as it is written: links and `..` are for `find`."""
        for root, name in self.roots() if path.startswith("/") else ():
            if Path(path).is_relative_to(root):
                return "/".join((name, *Path(path).relative_to(root).parts))
        return path

    def roots(self) -> tuple[tuple[Path, str], ...]:
        """The roots with their names, nested ones first."""
        nested_first = sorted(self._roots.items(), key=lambda entry: -len(entry[1].parts))
        return tuple((root, name) for name, root in nested_first)

    def find(self, path: str) -> Path:
        """The real path of a file or folder below a root."""
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


def _names(path: str, folder: Path) -> list[str]:
    try:
        return sorted(child.name for child in folder.iterdir() if not child.name.startswith("."))
    except OSError as error:
        raise NotFoundError(f"{path}: cannot be read ({error.strerror})") from error


def _on_files(folder: Path, files: Sequence[str]) -> list[str]:
    """What to say about the files of a folder that are no recordings."""
    if not files:
        return []
    suffixes = Counter(Path(name).suffix.lower() or "without a suffix" for name in files)
    counted = ", ".join(f"{number} {suffix}" for suffix, number in suffixes.most_common(MOST_NAMED))
    told = dict.fromkeys(ADVICE[suffix] for suffix in suffixes if suffix in ADVICE)
    return [f"{amount(len(files), 'file is', 'files are')} no recording: {counted}", *told]


def _nearest(folder: Path) -> list[str]:
    """Which kinds of recording a folder looks like; none if it may not be looked into."""
    with suppress(OSError):
        return nearest_formats(folder)
    return []


def _on_links(names: Sequence[str]) -> list[str]:
    if not names:
        return []
    lead = "leads" if len(names) == 1 else "lead"
    return [
        f"{amount(len(names), 'link')} ({first_few(names, MOST_NAMED)}) {lead} to a place that this server does not "
        "offer, or to nothing; whoever runs the server can offer that folder, too"
    ]


def _entry(name: str, path: str, place: Path) -> FolderEntry:
    try:
        recording = detect_format(place)
    except RecordingError:  # a known format, but without frames or unreadable
        recording = None
    return FolderEntry(name, path, recording, place.is_dir())


def _is_unsafe(part: str) -> bool:
    return not part.isprintable() or "\\" in part or "\0" in part


def _missing(path: str) -> NotFoundError:
    return NotFoundError(f"there is no folder or recording {path!r} in the folders that this server offers")


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


# Younger files may be in use, although one is written in moments; folders have locks.
OLD_S = 3600.0

# As `files.write_atomic` and `project.create_project` name them.
_UNFINISHED = re.compile(r"\..+\.[0-9a-f]{32}\.(tmp|unfinished)")


def clear_leftovers(projects_root: Path) -> None:
    """Removes half-written files and half-created projects of killed processes, as far as it may, and logs it."""
    oldest_s = time.time() - OLD_S
    for path in _unfinished(projects_root):
        with suppress(OSError):
            if path.is_dir() and not path.is_symlink():
                if not remove_abandoned(path):
                    continue
            elif path.lstat().st_mtime < oldest_s:
                path.unlink()
            else:
                continue
            LOG.warning("%s: removed, a process that was killed had left it", path)


def _unfinished(projects_root: Path) -> Iterator[Path]:
    for folder in (projects_root, *_children(projects_root), *_children(projects_root / BACKUPS)):
        for path in _children(folder):
            if _UNFINISHED.fullmatch(path.name):
                yield path
            elif path.name == "views" and folder != projects_root:
                yield from (image for image in _children(path) if _UNFINISHED.fullmatch(image.name))


def _children(folder: Path) -> list[Path]:
    try:
        return [] if folder.is_symlink() else list(folder.iterdir())
    except OSError:
        return []


# Within the projects folder: what the server keeps, for its own user only. Hidden, thus not a project.
JOBS_FOLDER = ".jobs"
LOCK = Path(JOBS_FOLDER) / "lock"


@contextmanager
def hold_server_lock(projects_root: Path) -> Iterator[None]:
    """Holds the lock of a projects folder: a second server would mark the jobs of the first one as failed.

    The system releases it when the process ends. On a file system without locks, or for a folder that cannot be
    written, it logs a warning instead.
    """
    try:
        import fcntl
    except ImportError:  # not a POSIX system: no lock
        yield
        return
    path = projects_root / LOCK
    require_own_files(path.parent)
    if projects_root.is_dir() and not os.access(projects_root, os.W_OK):
        LOG.warning("%s: cannot be written: its projects can be read and exported, but not changed", projects_root)
        yield
        return
    try:
        private_folder(path.parent)
        file = path.open("w")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error}; choose another folder with --projects") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                LOG.warning(
                    "%s: the file system does not support locks (%s); make sure that only one `annotator serve` uses "
                    "these projects",
                    projects_root,
                    error.strerror,
                )
            else:
                raise ConfigError(
                    f"{projects_root}: another `annotator serve` uses these projects; use its page, or stop it first"
                ) from error
        yield
