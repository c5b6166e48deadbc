"""One server a folder of projects: two would take each other's jobs for dead, and remove their files."""

from __future__ import annotations

import errno
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from annotator.types.errors import ConfigError

LOG = logging.getLogger("annotator.web")

LOCK = Path(".jobs") / "lock"


@contextmanager
def sole_server(projects_root: Path) -> Iterator[None]:
    """Holds the folder of projects while it lasts; a killed process gives it back. Where its file system keeps no locks
    nobody holds it, and the log says so.

    Raises:
        ConfigError: another server holds it, or it cannot be written.
    """
    try:
        import fcntl
    except ImportError:  # not a POSIX system: nothing to hold it with
        yield
        return
    path = projects_root / LOCK
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error}; choose another folder with --projects") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                LOG.warning(
                    "%s: its file system keeps no locks (%s); see to it that no second `annotator serve` works on "
                    "these projects",
                    projects_root,
                    error.strerror,
                )
            else:
                raise ConfigError(
                    f"{projects_root}: another `annotator serve` works on these projects; use its page, or stop it "
                    "first"
                ) from error
        yield
