"""Tells other processes that a project is open: its folder is locked, shared by all who have it open."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from annotator.files import lock_folder
from annotator.types.errors import InUseError


def mark_in_use(opened: object, folder: Path) -> Callable[[], object]:
    """Marks the project in `folder` as open until the returned function is called, or `opened` is gone.

    Waits while another process renames or removes it. Without locks, as on Windows and some network disks, nothing is
    marked.
    """
    lock = lock_folder(folder, is_shared=True, waits=True)
    return (lambda: None) if lock is None else weakref.finalize(opened, os.close, lock)


@contextmanager
def not_in_use(folder: Path) -> Iterator[None]:
    """In the block, nobody has the project in `folder` open.

    Raises:
        InUseError: another process has it open.
    """
    try:
        lock = lock_folder(folder, is_told=True)
    except BlockingIOError:
        raise InUseError(
            f"{folder}: another process has this project open; if it is a server, use its start page, or stop it; "
            "if it is a command, wait until it is done"
        ) from None
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)
