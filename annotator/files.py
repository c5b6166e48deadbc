"""The one door to files: bounded reading of regular files, and atomic writing.

Reading never hangs or fills the memory: pipes, sockets and devices (also behind links) and files that are too large are
refused, with the OSError of `open_file`. All modules read through `read_file`, `read_text_file` and `open_file`; before
a library opens a path by itself, `check_file` does. Writing: a reader sees either the old or the new content, never a
part of it.
"""

from __future__ import annotations

import errno
import glob
import hashlib
import io
import logging
import lzma
import os
import shutil
import stat
import struct
import tempfile
import uuid
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, BinaryIO

from annotator.text import MARK_BYTES, decoded, encoding_of, is_within
from annotator.types.errors import FormatError

LOG = logging.getLogger("annotator.files")

CHUNK_BYTES = 2**20
# Settings, calibrations, records, and labels of one frame.
DOCUMENT_BYTES = 2**24
# Tables with a line for each frame: 64 bytes for each of a million.
TABLE_BYTES = 2**26
# Weights of a detector, and what they were converted to.
NETWORK_BYTES = 2**30
# Limit of an archive's list of files, each of which becomes a Python object.
MOST_DIRECTORY_BYTES = 2**25
# The record at the end of an archive, with the longest comment, after the records of large archives.
LONGEST_ARCHIVE_END = 22 + 0xFFFF + 76
# Errors that zipfile raises on archives that are damaged, encrypted (RuntimeError) or compressed with an unsupported
# method (NotImplementedError).
ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    LookupError,
    ArithmeticError,
    NotImplementedError,
    RuntimeError,
)


def why_missing(path: Path) -> str | None:
    """The reason why `path` is missing or inaccessible; None if it exists.

    Unlike `Path.exists`, this does not raise for a lost mount, a folder without read permission, or a name that is too
    long or has a null byte.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return "no such file or folder"
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    except ValueError:
        return "is not a valid name"
    return None


def link_out(folder: Path, unvisited: str = "") -> Path | None:
    """The first link below a folder that leads out of it, also a broken one; None if there is none.

    A subfolder of the name `unvisited` is not searched.
    """
    left = [str(folder)]
    while left:
        place = left.pop()
        # another process may remove temporary files meanwhile; no file is reached through a folder that may not be read
        with suppress(FileNotFoundError, PermissionError), os.scandir(place) as entries:
            for entry in entries:
                if entry.is_symlink():
                    if not is_within(folder, Path(entry.path)):
                        return Path(entry.path)
                elif entry.is_dir() and (place != str(folder) or entry.name != unvisited):
                    left.append(entry.path)
    return None


def write_atomic(path: Path, content: bytes, *, private: bool = False) -> None:
    """Replaces or creates `path` atomically, even if the process is killed or the power fails.

    If an OSError is raised, `path` is unchanged. `private`: only its owner may read it; otherwise the umask decides.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        if private:
            make_private(temporary)
        with temporary.open("wb" if private else "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)  # noqa: PTH105 - the usual name of an atomic replacement
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def open_file(path: Path, most_bytes: int | None = None, *, buffering: int = -1) -> BinaryIO:
    """Opens a regular file for reading, without waiting for the other end of a pipe.

    Raises:
        OSError: it cannot be opened, is not a regular file (EINVAL) or is larger than `most_bytes` (EFBIG).
    """
    # the descriptor is examined, since the path may lead to another file a moment later
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)
    descriptor = os.open(path, flags)
    try:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(errno.EISDIR, "is a folder", str(path))
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        if most_bytes is not None and found.st_size > most_bytes:
            raise _too_large(path, most_bytes)
        return os.fdopen(descriptor, "rb", buffering)
    except BaseException:
        os.close(descriptor)
        raise


def open_text_file(path: Path, most_bytes: int, newline: str | None = None) -> io.TextIOWrapper:
    """Opens a regular file for reading text, as `decoded` has it."""
    file = open_file(path, most_bytes)
    head = file.read(MARK_BYTES)
    file.seek(0)
    return io.TextIOWrapper(file, encoding_of(head), newline=newline)


def read_file(path: Path, most_bytes: int = DOCUMENT_BYTES) -> bytes:
    parts, size = [], 0
    with open_file(path, most_bytes) as stream:
        # in chunks, since read(n) allocates n bytes in advance; the file may grow meanwhile
        while part := stream.read(CHUNK_BYTES):
            parts.append(part)
            size += len(part)
            if size > most_bytes:
                raise _too_large(path, most_bytes)
    return b"".join(parts)


def sha256_of(path: Path) -> str:
    """SHA-256 of a regular file of any size, in hexadecimal digits."""
    digest = hashlib.sha256()
    with open_file(path) as file:
        while part := file.read(CHUNK_BYTES):
            digest.update(part)
    return digest.hexdigest()


def read_text_file(path: Path, most_bytes: int = DOCUMENT_BYTES, errors: str = "strict") -> str:
    """Returns the content of a text file, as `decoded` has it; lines end with a line feed."""
    return io.IncrementalNewlineDecoder(None, translate=True).decode(
        decoded(read_file(path, most_bytes), errors), final=True
    )


def end_of_file(path: Path, most_bytes: int) -> str:
    """Returns the end of a text file, such as a log."""
    with open_file(path) as stream:
        stream.seek(max(stream.seek(0, os.SEEK_END) - most_bytes, 0))
        return stream.read(most_bytes).decode("utf-8", "replace")


def check_file(path: Path, most_bytes: int | None = None) -> None:
    """Checks a file that a library will open by its path."""
    open_file(path, most_bytes).close()


def open_archive(file: IO[bytes] | io.BufferedIOBase) -> zipfile.ZipFile:
    """Opens a zip archive whose list of files has a sensible length; `zipfile` reads all of it.

    Raises:
        zipfile.BadZipFile: not an archive, or its list of files is too long; or another of `ARCHIVE_ERRORS`.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - LONGEST_ARCHIVE_END, 0))
    end = file.read(LONGEST_ARCHIVE_END)
    # the record at the end, and that of archives of more than 4 GiB (APPNOTE 4.3.14 and 4.3.16)
    for mark, at, length in ((b"PK\5\6", 12, 4), (b"PK\6\6", 40, 8)):
        place = end.rfind(mark) + at
        declared = int.from_bytes(end[place : place + length], "little") if place >= at else 0
        if declared > MOST_DIRECTORY_BYTES and declared != 0xFFFFFFFF:
            raise zipfile.BadZipFile(f"its list of files has {declared} bytes; at most {MOST_DIRECTORY_BYTES} are read")
    return zipfile.ZipFile(file)


def _too_large(path: Path, most_bytes: int) -> OSError:
    return OSError(errno.EFBIG, f"larger than {most_bytes / 2**20:.6g} MiB, the limit for such a file", str(path))


def sync_folder(folder: Path) -> None:
    """Makes renames inside `folder` durable; does nothing on Windows, where folders cannot be opened."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_private(path: Path) -> None:
    """Makes a file, created empty if it is missing, one that only its owner may read and write."""
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | getattr(os, "O_NONBLOCK", 0), 0o600))
    path.chmod(0o600)


def private_folder(path: Path) -> None:
    """Makes a folder, created if it is missing, one that only its owner may enter."""
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    # somebody else's folder stays as they made it
    with suppress(PermissionError):
        path.chmod(0o700)


@contextmanager
def new_folder(out: Path, may_replace: Callable[[Path], bool]) -> Iterator[Path]:
    """Yields a temporary sibling of `out` to fill; it becomes `out` if the block succeeds, else it is removed.

    A folder that is not empty is replaced if `may_replace` allows it; it stays until the new one is complete. What a
    killed process left in this place is put right first.

    Raises:
        FormatError: `out` may not be replaced, or the folder cannot be created.
    """
    # resolved now, because the working directory may change; if `out` is a link, its target is replaced
    out = out.resolve()
    with ExitStack() as stack:
        try:
            _clear_leftovers(out)
            _require_free(out, may_replace)
            part = stack.enter_context(unfinished_folder(out.parent, out.name)) / out.name
            # with the rights of new folders, unlike the hidden one around it
            part.mkdir()
        except OSError as error:
            raise FormatError(out, f"cannot be created ({error.strerror}); choose another folder") from error
        yield part
        # another process may have filled `out` meanwhile
        _require_free(out, may_replace)
        _put_in_place(part, out)


def _clear_leftovers(out: Path) -> None:
    """Puts right what a killed `new_folder` left: unfinished folders, and an old `out` that was moved aside.

    Does nothing while another process fills a folder that is to become `out`.
    """
    if not all(remove_abandoned(part) for part in _unfinished(out.parent, out.name)):
        return
    # mkdtemp appends eight characters
    olds = [*out.parent.glob(f".{glob.escape(out.name)}.old-????????")]
    filled = [old for old in olds if any(old.iterdir())]
    if filled and not out.exists():
        newest = max(filled, key=lambda old: old.stat().st_mtime_ns)
        newest.rename(out)
        olds.remove(newest)
        LOG.warning("%s: put back from %s, where an interrupted run had moved it", out, newest.name)
    for path in olds:
        shutil.rmtree(path)
        LOG.warning("%s: removed, an interrupted run had left it", path)


@contextmanager
def unfinished_folder(root: Path, name: str) -> Iterator[Path]:
    """Yields a new hidden folder in `root`, for its owner only; it is removed at the end if still there.

    Also removes folders that killed processes have left for the same name.
    """
    root.mkdir(parents=True, exist_ok=True)
    for left in _unfinished(root, name):
        remove_abandoned(left)
    while True:
        folder = root / f".{name}.{uuid.uuid4().hex}.unfinished"
        folder.mkdir(mode=0o700)
        with lock_folder(folder, waits=True) as lock:
            lock.callback(shutil.rmtree, folder, ignore_errors=True)
            # another process may have taken it for a leftover, and removed it, before it was locked
            if folder.exists():
                yield folder
                return


def _unfinished(root: Path, name: str) -> list[Path]:
    found = root.glob(f".{glob.escape(name)}.*.unfinished")
    # those of other names, such as NAME.v2, have more dots
    return [folder for folder in found if folder.name.count(".") == name.count(".") + 3]


def remove_abandoned(folder: Path) -> bool:
    """Removes a folder if no process holds its lock; returns whether it is gone.

    Without locks, as on Windows, it stays.
    """
    with lock_folder(folder) as lock:
        if lock.is_held:
            shutil.rmtree(folder, ignore_errors=True)
        return lock.is_held and not folder.exists()


class FolderLock(ExitStack):
    """The lock of a folder, until it is closed; not held if another one holds it, or if there are no locks here."""

    is_held = False


def lock_folder(folder: Path, *, waits: bool = False, is_shared: bool = False, is_told: bool = False) -> FolderLock:
    """Takes the lock of a folder.

    Args:
        waits: whether to wait for the lock.
        is_shared: hold it with others that share it, but not while one holds it alone.
        is_told: raise BlockingIOError if another one holds it.
    """
    lock = FolderLock()
    try:
        import fcntl

        descriptor = os.open(folder, os.O_RDONLY)
        lock.callback(os.close, descriptor)
        kind = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
        fcntl.flock(descriptor, kind if waits else kind | fcntl.LOCK_NB)
        lock.is_held = True
    except (ImportError, OSError) as error:  # only POSIX systems have fcntl
        lock.close()
        if is_told and isinstance(error, BlockingIOError):
            raise
    return lock


def _require_free(out: Path, may_replace: Callable[[Path], bool]) -> None:
    if out.exists() and not out.is_dir():
        raise FormatError(out, "exists and is not a folder; choose another folder")
    if out.is_dir() and any(out.iterdir()) and not may_replace(out):
        raise FormatError(
            out,
            "exists and is not empty; choose another folder, or remove what is in it (only an older export of the same "
            "format can be overwritten)",
        )


def _put_in_place(part: Path, out: Path) -> None:
    """Renames `part` to `out`. An existing `out` is moved aside first, and restored if the renaming fails."""
    try:
        if not out.exists():
            part.rename(out)
            return
        aside = Path(tempfile.mkdtemp(prefix=f".{out.name}.old-", dir=out.parent))
        out.replace(aside)
        try:
            part.rename(out)
        except OSError:
            aside.replace(out)
            raise
        shutil.rmtree(aside, ignore_errors=True)
    except OSError as error:
        raise FormatError(out, f"cannot be created ({error.strerror}); choose another folder") from error
