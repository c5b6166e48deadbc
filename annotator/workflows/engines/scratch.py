"""A folder on a worker's machine for what can be made again: unpacked weights, copies of stored recordings."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

from annotator.types.errors import WorkerError


def scratch_folder() -> Path:
    """The user's own folder among the machine's temporary ones; nobody else can put anything there.

    Raises:
        WorkerError: it cannot be made, or belongs to somebody else.
    """
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"annotator-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise WorkerError(f"{folder}: cannot be made ({error.strerror}); name another place in TMPDIR") from error
    is_own = stat.S_ISDIR(found.st_mode) and (os.name == "nt" or found.st_uid == user)
    if not is_own or (os.name != "nt" and stat.S_IMODE(found.st_mode) & 0o022):
        raise WorkerError(f"{folder}: others may write there; remove it, or name another place in TMPDIR")
    return folder
