"""Where workers read recordings: at the project's path, or at another path or URL.

On a worker's machine, the driver's `/data/room` may be `/mnt/data/room`, or `s3://bucket/room` in an object storage.
URLs are read through fsspec (`annotator.recordings.mirror`).
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from annotator.recordings import stored_options
from annotator.types.errors import ConfigError, WorkerError
from annotator.workflows.frame_source import OpenedRecording, open_stored
from annotator.workflows.proposing.engines.tasks import RecordingSpec

CACHE_MB = 4000
# Maximum number of open recordings of a worker: each holds its frame names and a share of the cache.
MAX_OPEN = 2


@dataclass(frozen=True)
class Storage:
    """Where a worker reads recordings.

    Attributes:
        elsewhere: pairs of a folder on the driver, and its path or URL for workers; the first match is used.
        cache_mb: size of a worker's disk cache for recordings at URLs, MB.
    """

    elsewhere: tuple[tuple[Path, str], ...] = ()
    cache_mb: int = CACHE_MB

    def __post_init__(self) -> None:
        if self.cache_mb < 1:
            raise ConfigError(f"--cache-mb {self.cache_mb} is too small; give 1 or more")

    def place(self, path: Path) -> str:
        """Returns the workers' path or URL of a path of the project."""
        for folder, other in self.elsewhere:
            if path.is_relative_to(folder):
                below = PurePosixPath(path.relative_to(folder))
                return other.rstrip("/") + (f"/{below}" if below.parts else "")
        return str(path)

    def open(self, recording: RecordingSpec) -> OpenedRecording:
        """Opens a recording at the workers' path or URL.

        Raises:
            RecordingError: it is missing or cannot be read.
            MissingExtraError: its URL needs a package that is not installed.
        """
        place = self.place(recording.path)
        if not is_url(place):
            return open_stored(
                Path(place), recording.name, recording.project, recording.up, recording.options, recording.correction
            )
        from annotator.recordings.mirror import open_mirror

        limit_bytes, options = self.cache_mb * 10**6 // MAX_OPEN, stored_options(recording.options)
        mirror = open_mirror(place, scratch_folder() / "recordings", limit_bytes, options)
        return OpenedRecording(mirror, recording.up, recording.correction)


def is_url(place: str) -> bool:
    """Returns True for a URL, False for a path."""
    return "://" in place


def parse_elsewhere(words: Sequence[str]) -> tuple[tuple[Path, str], ...]:
    """Parses options of the form FOLDER=PLACE.

    Raises:
        ConfigError: an option has another form.
    """
    pairs = []
    for word in words:
        folder, equals, other = word.partition("=")
        if not folder or not equals or not other:
            raise ConfigError(f"{word!r} is not of the form FOLDER=PLACE; write e.g. /data=s3://bucket/data")
        pairs.append((Path(folder).resolve(), other))
    return tuple(pairs)


def scratch_folder() -> Path:
    """Creates and returns the user's own temporary folder, which only the user can write to.

    It holds unpacked weights and cached recordings.

    Raises:
        WorkerError: it cannot be created, or other users can write to it.
    """
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"annotator-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise WorkerError(f"{folder}: cannot be created ({error.strerror}); set TMPDIR to another folder") from error
    is_own = stat.S_ISDIR(status.st_mode) and (os.name == "nt" or status.st_uid == user)
    if not is_own or (os.name != "nt" and stat.S_IMODE(status.st_mode) & 0o022):
        raise WorkerError(f"{folder}: other users can write to it; remove it, or set TMPDIR to another folder")
    return folder
