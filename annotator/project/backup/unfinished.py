"""Folders that are filled under a hidden name; what killed processes have left of them is removed."""

from __future__ import annotations

import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from annotator.files import private_folder

# A folder without a lock is left alone for this long: it may be one whose process is about to lock it.
YOUNG_S = 10.0


@contextmanager
def unfinished_folder(root: Path, name: str) -> Iterator[Path]:
    """Yields a new hidden folder in `root`, for its owner only; it is removed at the end if still there.

    Also removes folders that killed processes have left for the same name.

    Raises:
        OSError: the folder cannot be created.
    """
    root.mkdir(parents=True, exist_ok=True)
    for left in root.glob(f".{name}.*.unfinished"):
        if is_abandoned(left):
            shutil.rmtree(left, ignore_errors=True)
    folder = root / f".{name}.{uuid.uuid4().hex}.unfinished"
    private_folder(folder)
    lock = _lock(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def is_abandoned(folder: Path) -> bool:
    """True if no process holds the folder's lock."""
    with suppress(OSError):
        if time.time() - folder.stat().st_mtime < YOUNG_S:
            return False
    lock = _lock(folder)
    if lock is None:
        return False
    os.close(lock)
    return True


def _lock(folder: Path) -> int | None:
    """The descriptor that holds the folder's lock until it is closed; None if it is taken, or if there are no locks."""
    try:
        import fcntl
    except ImportError:  # not a POSIX system
        return None
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor
