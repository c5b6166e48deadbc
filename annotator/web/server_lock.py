"""A lock that permits one server per projects folder: a second one would mark the first one's jobs as failed."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from annotator.files import private_folder
from annotator.types.errors import ConfigError
from annotator.web.jobs.records import require_own_files

LOG = logging.getLogger("annotator.web")

# Within the projects folder: what the server keeps, for its own user only. Hidden, thus not a project.
JOBS_FOLDER = ".jobs"
LOCK = Path(JOBS_FOLDER) / "lock"


@contextmanager
def hold_server_lock(projects_root: Path) -> Iterator[None]:
    """Holds the lock of a projects folder within the `with` block; the system releases it when the process ends.

    On a file system without locks, or for a folder that cannot be written, it logs a warning instead.

    Raises:
        ConfigError: another server holds the lock, or the lock file cannot be written or is reached by a link.
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
