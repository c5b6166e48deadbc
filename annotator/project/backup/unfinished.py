"""Folders that are filled under a hidden name; what killed processes have left of them is removed."""

from __future__ import annotations

import glob
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from annotator.files import lock_folder, locked_folder


@contextmanager
def unfinished_folder(root: Path, name: str) -> Iterator[Path]:
    """Yields a new hidden folder in `root`, for its owner only; it is removed at the end if still there.

    Also removes folders that killed processes have left for the same name.

    Raises:
        OSError: the folder cannot be created.
    """
    root.mkdir(parents=True, exist_ok=True)
    for left in root.glob(f".{glob.escape(name)}.*.unfinished"):
        remove_abandoned(left)

    def make() -> Path:
        folder = root / f".{name}.{uuid.uuid4().hex}.unfinished"
        # no step follows its creation: another process may take it for a leftover until it is locked
        folder.mkdir(mode=0o700)
        return folder

    folder, lock = locked_folder(make)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def remove_abandoned(folder: Path) -> bool:
    """Removes a folder if no process holds its lock; returns whether it is gone.

    Without locks, as on Windows, it stays.
    """
    lock = lock_folder(folder)
    if lock is None:
        return False
    try:
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)
    return not folder.exists()
