"""Atomic writing of files and folders: a reader sees either the old or the new content, never a part of it."""

from __future__ import annotations

import errno
import lzma
import os
import shutil
import struct
import tempfile
import uuid
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from annotator.types.errors import FormatError

CHUNK_BYTES = 2**20
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
    long.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return "no such file or folder"
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return None


def is_within(folder: Path, name: str | Path) -> bool:
    """True if a name is a valid path inside a folder after resolving links; the file may be missing."""
    try:
        place = (folder / name).resolve()
        # raises for a name that is too long
        place.exists()
        return place.is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):
        # too long, a circular link, a null byte
        return False


def write_atomic(path: Path, content: bytes, *, private: bool = False) -> None:
    """Replaces or creates `path` atomically, even if the process is killed or the power fails.

    Args:
        private: only its owner may read it; otherwise the umask decides.

    Raises:
        OSError: the folder is missing or not writable, or the disk is full; `path` is unchanged.
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


def read_at_most(path: Path, limit: int) -> bytes:
    """The content of a file; at most its first `limit` + 1 bytes.

    Raises:
        OSError: it cannot be read, or is not a regular file (a pipe, for example).
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a regular file")
    parts, left = [], limit + 1
    with path.open("rb") as stream:
        # in chunks, since read(n) allocates n bytes in advance
        while left > 0 and (part := stream.read(min(left, CHUNK_BYTES))):
            parts.append(part)
            left -= len(part)
    return b"".join(parts)


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
    """Makes a file, created empty if it is missing, one that only its owner may read and write.

    Raises:
        OSError: it cannot be created, or belongs to somebody else.
    """
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | getattr(os, "O_NONBLOCK", 0), 0o600))
    path.chmod(0o600)


def private_folder(path: Path) -> None:
    """Makes a folder, created if it is missing, one that only its owner may enter.

    Raises:
        OSError: it cannot be created.
    """
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    # somebody else's folder stays as they made it
    with suppress(PermissionError):
        path.chmod(0o700)


@contextmanager
def new_folder(out: Path, may_replace: Callable[[Path], bool]) -> Iterator[Path]:
    """Yields a temporary sibling of `out` to fill; it becomes `out` if the block succeeds, else it is removed.

    Args:
        out: the folder to create; missing, empty, or one that `may_replace` allows to replace. The old folder stays
            until the new one is complete.
        may_replace: decides on a folder that is not empty.

    Raises:
        FormatError: `out` may not be replaced, or the folder cannot be created.
    """
    # resolved now, because the working directory may change; if `out` is a link, its target is replaced
    out = out.resolve()
    _require_free(out, may_replace)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{out.name}.part-", dir=out.parent))
    except OSError as error:
        raise FormatError(out, f"cannot be created ({error.strerror})") from error
    try:
        yield part
        # another process may have filled `out` meanwhile
        _require_free(out, may_replace)
        _put_in_place(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _require_free(out: Path, may_replace: Callable[[Path], bool]) -> None:
    if out.exists() and not out.is_dir():
        raise FormatError(out, "exists and is not a folder; choose another folder")
    if out.is_dir() and any(out.iterdir()) and not may_replace(out):
        raise FormatError(
            out, "exists and is not empty; choose another folder, or allow overwriting an existing dataset"
        )


def _put_in_place(part: Path, out: Path) -> None:
    """Renames `part` to `out`. An existing `out` is moved aside first, and restored if the renaming fails."""
    try:
        part.chmod(0o755)
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
        raise FormatError(out, f"cannot be created ({error.strerror})") from error
