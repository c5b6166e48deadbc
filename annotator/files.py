"""Files and folders that appear all at once: a reader sees the old content or the new one, never a part."""

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
from contextlib import contextmanager
from pathlib import Path

from annotator.types.errors import FormatError

CHUNK_BYTES = 2**20
# What zipfile is seen to raise on archives that are damaged, encrypted (RuntimeError), or of a compression that Python
# does not know (NotImplementedError).
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
    """Why there is nothing at `path` that could be used, in words; None where there is something.

    What cannot be looked at counts as missing: it lies on a mount that is gone, in a folder that nobody may read, or
    its name is too long. `Path.exists` raises there.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return "no such file or folder"
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return None


def is_within(folder: Path, name: str | Path) -> bool:
    """Whether a name, links followed, stays in a folder and can be asked for; there need be no such file."""
    try:
        place = (folder / name).resolve()
        # a name that is too long tells only now
        place.exists()
        return place.is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):
        # too long, a link to itself, a zero byte
        return False


def write_atomic(path: Path, content: bytes) -> None:
    """Replace or create `path` in one step that survives a kill and a power cut.

    Raises:
        OSError: the folder is missing or not writable, or the disk is full; `path` is unchanged.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)  # noqa: PTH105 - named as in every text about atomic writes
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def read_at_most(path: Path, limit: int) -> bytes:
    """The content of a file; of one that is longer than `limit`, its first `limit` + 1 bytes.

    Raises:
        OSError: it cannot be read, or is no file, such as a pipe that might never end.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is no file")
    parts, left = [], limit + 1
    with path.open("rb") as stream:
        # a buffer for all that may come would be made before anything has come
        while left > 0 and (part := stream.read(min(left, CHUNK_BYTES))):
            parts.append(part)
            left -= len(part)
    return b"".join(parts)


def sync_folder(folder: Path) -> None:
    """Make renames inside `folder` durable, where the system can (a folder cannot be opened on Windows)."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def new_folder(out: Path, may_replace: Callable[[Path], bool]) -> Iterator[Path]:
    """Gives a temporary sibling of `out` to fill; it becomes `out` if the block ends well, else it is removed.

    Args:
        out: the folder to make; missing, empty, or one that `may_replace` allows to replace. The old one stays
            until the new one is complete.
        may_replace: asked for a folder that holds something.

    Raises:
        FormatError: `out` may not be replaced, or nothing can be written beside it.
    """
    # a relative path must mean the same folder at the end, and a link stays a link to what it names
    out = out.resolve()
    _require_free(out, may_replace)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{out.name}.part-", dir=out.parent))
    except OSError as error:
        raise FormatError(out, f"cannot be made ({error.strerror})") from error
    try:
        yield part
        # somebody else may have filled it meanwhile
        _require_free(out, may_replace)
        _put_in_place(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _require_free(out: Path, may_replace: Callable[[Path], bool]) -> None:
    if out.exists() and not out.is_dir():
        raise FormatError(out, "exists and is no folder; name another folder")
    if out.is_dir() and any(out.iterdir()) and not may_replace(out):
        raise FormatError(out, "exists and is not empty; name another folder, or say that a dataset may be overwritten")


def _put_in_place(part: Path, out: Path) -> None:
    """Renames `part` to `out`; what was there is moved aside first, and back if that fails."""
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
        raise FormatError(out, f"cannot be made ({error.strerror})") from error
