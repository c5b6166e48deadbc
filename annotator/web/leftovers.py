"""Removes what killed processes left in a projects folder: half-written files, and projects that were half created."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from annotator.project.backup.snapshot import remove_abandoned
from annotator.project.config import BACKUPS

LOG = logging.getLogger("annotator.web")

# Younger files may be in use, although one is written in moments; folders have locks.
OLD_S = 3600.0

# As `files.write_atomic`, `project.create_project` and `keep_replaced` name them; SQLite may have files beside one.
_UNFINISHED = re.compile(r"\..+\.[0-9a-f]{32}\.(tmp(-wal|-shm|-journal)?|unfinished)")


def clear_leftovers(projects_root: Path) -> None:
    """Removes them, and logs it; what may not be removed stays."""
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
