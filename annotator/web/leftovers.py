"""Removes what killed processes left in a projects folder: half-written files, and projects that were half created."""

from __future__ import annotations

import logging
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from annotator.project.backup.unfinished import is_abandoned

LOG = logging.getLogger("annotator.web")

# Younger ones may be in use: a file is written in moments, a project created in less than a second.
OLD_S = 3600.0

# As `files.write_atomic` and `project.create_project` name them.
_UNFINISHED = re.compile(r"\..+\.[0-9a-f]{32}\.(tmp|unfinished)")


def clear_leftovers(projects_root: Path) -> None:
    """Removes them, and logs it; what may not be removed stays."""
    oldest_s = time.time() - OLD_S
    for path in _unfinished(projects_root):
        with suppress(OSError):
            if path.lstat().st_mtime > oldest_s:
                continue
            if path.is_dir() and not path.is_symlink():
                if not is_abandoned(path):
                    continue
                shutil.rmtree(path)
            else:
                path.unlink()
            LOG.warning("%s: removed, a process that was killed had left it", path)


def _unfinished(projects_root: Path) -> Iterator[Path]:
    for folder in (projects_root, *_children(projects_root)):
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
